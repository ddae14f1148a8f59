"""A page to explore a run or a saved model in the browser, served on this machine."""

from __future__ import annotations

from collections.abc import Sequence
from os.path import isdir, isfile  # unlike methods of Path, they are False for names that are too long
from pathlib import Path
from typing import Any

import numpy as np
import torch

from augment import withhold
from augment.choices import fraction_key
from augment.cross_validation import LOCATOR as MATCHED_FIELD
from augment.turbo.artifacts import model_file
from swiftwrf import FieldModel, GeometryModel, InputError, Rssi, RssiModel, load
from swiftwrf.contrib.comparison.steps import LOCATOR, MODEL
from swiftwrf.errors import with_article
from swiftwrf.locate import RssiLocator
from swiftwrf.models import FIELD_MODELS
from swiftwrf.models.geometry import Plane
from swiftwrf.rssi.base import RssiPredictor
from swiftwrf.runtime.checkpoint import refusing
from tasks.aoa.experiment import measurements as spectra_of
from tasks.command_line import parse
from tasks.configs import AoaConfig, LocateConfig, ViewConfig
from tasks.locate.experiment import measurements as rssi_of
from tasks.records import CONFIG, ENVIRONMENT, Row, read_json
from tasks.terminal import terminal
from tasks.update.record import FollowedView
from tasks.view.locating import RssiLocating
from tasks.view.rssi import RssiView, rows_of_model, rows_of_run
from tasks.view.spectra import LoadedModel, SpectraView

EXPECTED = "give the directory of a run of aoa, rssi, locate or update, or a saved model of spectra or RSSI"


def run(config: ViewConfig) -> None:
    """Serve the page until the process is interrupted.

    Raises:
        InputError: The source holds no model, the port is in use, or the optional extra is not installed.
    """
    try:
        from tasks.view.page import FollowedPage, free_port, serve
        from tasks.view.rssi_page import RssiPage
        from tasks.view.spectra_page import SpectraPage
    except ModuleNotFoundError as error:
        if error.name != "nicegui":
            raise
        raise InputError("swiftwrf view needs the optional extra: pip install 'swiftwrf-tasks[view]'") from None
    port = free_port(config.host, config.port)
    view = open_source(Path(config.source))
    page: Any = {SpectraView: SpectraPage, RssiView: RssiPage, FollowedView: FollowedPage}[type(view)]
    serve(view.title, lambda: page(view), config.host, port, terminal.options.open)


def open_source(source: Path) -> SpectraView | RssiView | FollowedView:
    """Open the directory of a run or the file of a saved model.

    Raises:
        InputError: The source holds no model that predicts spectra or RSSI.
    """
    if isfile(source):
        return _saved_model(source)
    if not isfile(source / CONFIG):
        reason = f"is no run: it has no {CONFIG}" if isdir(source) else "does not exist or cannot be read"
        raise InputError(f"{source} {reason}; {EXPECTED}")
    content = read_json(source / CONFIG)
    match content.get("task"):
        case "aoa":
            return _aoa_run(source, content)
        case "rssi":
            model = _opened(source / MODEL, RssiModel)
            with refusing(f"the maps in {source} are not those of a run"):
                return RssiView(source.name, model, rows_of_run(source / "maps.npz", model), folder=source)
        case "locate":
            return _locate_run(source, content)
        case "update":
            return FollowedView(source)
        case other:
            raise InputError(f"{source} is a run of tasks.{other}; {EXPECTED}")


def _saved_model(file: Path) -> SpectraView | RssiView:
    model = _opened(file, RssiModel, RssiLocator, FieldModel)
    if isinstance(model, RssiModel):
        return RssiView(file.name, model, rows_of_model(model))
    if isinstance(model, RssiLocator):
        return _located(file.name, RssiLocating.of_training(model))
    return SpectraView(file.name, [LoadedModel(model.kind, model, _planes(model))])


def _opened(file: Path, *kinds: Any) -> Any:
    """Return the saved model in a file if it is of one of these kinds."""
    if not file.is_file():
        raise InputError(f"{file.parent} holds no model: it has no {file.name}; the run did not end")
    model = load(file)
    if not isinstance(model, kinds):
        instead = "the report of its run shows its maps" if isinstance(model, RssiPredictor) else EXPECTED
        raise InputError(f"{file} holds {with_article(model.kind)}, which cannot be shown; {instead}")
    return model


def _planes(model: FieldModel) -> list[dict[str, Any]]:
    planes: list[dict[str, Any]] = [] if model.room is None else model.room.to_json()["planes"]
    return planes


def _training_part(folder: Path, config: Any, data: Any) -> Any:
    """Return the training part of the measurements of a run, which were read again.

    Raises:
        InputError: Their checksums differ from those in the records of the run.
    """
    recorded = read_json(folder / ENVIRONMENT).get("input_sha256", {})  # may contain more: a scene to trace in
    if {name: recorded.get(name) for name in data.source} != data.source:
        raise InputError("they have changed since the run")
    return data.split(config.split, config.seed)[0]


def _aoa_run(folder: Path, content: Row) -> SpectraView:
    with refusing(f"the records in {folder} are not those of a run"):
        config, models = parse(AoaConfig, [], "tasks.view", content["config"], folder), []
        data = train = None
        try:
            found = spectra_of(config)
            data, train = found, _training_part(folder, config, found)
            notes = list(data.notes)
        except InputError as error:
            notes = [f"The measured spectra are not shown: {error}."]
        for fraction in config.measured:
            key, in_training = fraction_key(fraction), None
            if data is not None and train is not None:
                measured, _ = withhold(train, fraction, config.seed)
                in_training = np.isin(data.index.numpy(), measured.index.numpy())
            names = (MATCHED_FIELD, *FIELD_MODELS)
            files = {name: file for name in names if (file := model_file(folder, name, key)).is_file()}
            locator_file = files.pop(MATCHED_FIELD, None)
            for name, file in files.items():
                model = _opened(file, FieldModel)
                planes = _planes(model) or _planes_of_run(folder / f"geometry-mix{key}.json")
                title = f"{name}, {100 * fraction:g}% measured"
                models.append(LoadedModel(title, model, planes, in_training, locator_file))
    if not models:
        raise InputError(f"{folder} holds no model; run swiftwrf aoa with --models that can be saved")
    return SpectraView(folder.name, models, data, notes)


def _planes_of_run(file: Path) -> list[dict[str, Any]]:
    """Return the planes that another model of the run found from the same spectra."""
    planes = read_json(file)["planes"] if file.is_file() else []
    return [Plane.from_json(plane).to_json() for plane in planes]


def _locate_run(folder: Path, content: Row) -> RssiView | SpectraView:
    if len(rooms := sorted(folder.glob("room-*.safetensors"))):
        models = [(file.stem.removeprefix("room-"), _opened(file, GeometryModel)) for file in rooms]
        return SpectraView(
            folder.name, [LoadedModel(f"at {name}", room, _planes(room)) for name, room in models], None, []
        )
    locator, notes = _opened(folder / LOCATOR, RssiLocator), []
    with refusing(f"the records in {folder} are not those of a run"):
        config = parse(LocateConfig, [], "tasks.view", content["config"], folder)
        try:
            data, _ = rssi_of(config)
            assert isinstance(data, Rssi)
            train = _training_part(folder, config, data)
            locating = RssiLocating(locator, data, torch.isin(data.index, train.index))
        except InputError as error:
            notes = [f"The measured rows are not shown, but the training rows in the locator: {error}."]
            locating = RssiLocating.of_training(locator)
    return _located(folder.name, locating, notes, folder)


def _located(title: str, locating: RssiLocating, notes: Sequence[str] = (), folder: Path | None = None) -> RssiView:
    return RssiView(title, locating.locator.model, locating.rows, locating, list(notes), folder)
