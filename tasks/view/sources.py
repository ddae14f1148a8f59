"""Open a run or a saved model for the page."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch

from augment import withhold
from augment.cross_validation import LOCATOR as MATCHED_FIELD
from augment.turbo.artifacts import model_file
from swiftwrf import FieldModel, InputError, RssiModel, Spectra, load
from swiftwrf.choices import fraction_key
from swiftwrf.errors import with_article
from swiftwrf.locate import RssiLocator
from swiftwrf.models import FIELD_MODELS
from swiftwrf.models.geometry import Plane
from swiftwrf.rssi.base import RssiPredictor
from swiftwrf.runtime.checkpoint import Saved, refusing
from tasks.aoa.experiment import measurements as spectra_of
from tasks.aoa.options import AoaConfig
from tasks.claim import CONFIG, ENVIRONMENT, LOCATOR, MODEL
from tasks.command_line import parse
from tasks.locate.experiment import measurements as rssi_of
from tasks.locate.options import LocateConfig
from tasks.records import Row, read_json
from tasks.view.followed import FollowedView, open_followed
from tasks.view.locating import RssiLocating
from tasks.view.rssi import RssiView, rows_of_model, rows_of_run
from tasks.view.spectra import LoadedModel, SpectraView

EXPECTED = "give the directory of a run of aoa, rssi, locate or update, or a saved model of spectra or RSSI"


def open_source(source: Path) -> SpectraView | RssiView | FollowedView:
    """Open the directory of a run or the file of a saved model.

    Raises:
        InputError: The source holds no model that predicts spectra or RSSI.
    """
    try:
        is_file, is_folder = source.is_file(), source.is_dir()
    except OSError as error:
        raise InputError(f"{source} cannot be read ({error.strerror}); {EXPECTED}") from None
    if is_file:
        return _saved_model(source)
    if not is_folder:
        raise InputError(f"{source} does not exist; {EXPECTED}")
    if not (source / CONFIG).is_file():
        raise InputError(f"{source} is no run: it has no {CONFIG}; {EXPECTED}")
    content = read_json(source / CONFIG)
    match content.get("task"):
        case "aoa":
            return _aoa_run(source, content)
        case "rssi":
            return _rssi_run(source)
        case "locate":
            return _locate_run(source, content)
        case "update":
            return open_followed(source)
        case other:
            raise InputError(f"{source} is a run of tasks.{other}; {EXPECTED}")


def _saved_model(file: Path) -> SpectraView | RssiView:
    model = load(file)
    if isinstance(model, RssiModel):
        return RssiView(file.name, model, rows_of_model(model))
    if isinstance(model, RssiLocator):
        return _located(file.name, RssiLocating.of_training(model))
    field_model = _field_model(file, model)
    return SpectraView(file.name, [LoadedModel(model.kind, field_model, _planes(field_model))])


def _field_model(file: Path, model: Saved) -> FieldModel:
    if not isinstance(model, FieldModel):
        raise _not_shown(file, model)
    return model


def _not_shown(file: Path, model: Saved) -> InputError:
    instead = "the report of its run shows its maps" if isinstance(model, RssiPredictor) else EXPECTED
    return InputError(f"{file} holds {with_article(model.kind)}, which cannot be shown; {instead}")


def _planes(model: FieldModel) -> list[dict[str, Any]]:
    planes: list[dict[str, Any]] = [] if model.room is None else model.room.to_json()["planes"]
    return planes


def _aoa_run(folder: Path, content: Row) -> SpectraView:
    with refusing(f"the records in {folder} are not those of a run"):
        config = parse(AoaConfig, [], "tasks.view", content["config"], folder)
        data, train, notes = _measured(folder, config)
        models = []
        for fraction in config.mix:
            in_training = None
            if data is not None and train is not None:
                measured, _ = withhold(train, fraction, config.seed)
                in_training = np.isin(data.index.numpy(), measured.index.numpy())
            located_by = model_file(folder, MATCHED_FIELD, fraction_key(fraction))
            locator_file = located_by if located_by.is_file() else None
            files = {name: model_file(folder, name, fraction_key(fraction)) for name in FIELD_MODELS}
            for name in (name for name, file in files.items() if file.is_file()):
                model = _field_model(files[name], load(files[name]))
                planes = _planes(model) or _planes_of_run(folder, fraction)
                models.append(
                    LoadedModel(f"{name}, {100 * fraction:g}% measured", model, planes, in_training, locator_file)
                )
    if not models:
        raise InputError(f"{folder} holds no model; run tasks.aoa with a --synthesizer that can be saved")
    return SpectraView(folder.name, models, data, notes)


def _planes_of_run(folder: Path, fraction: float) -> list[dict[str, Any]]:
    """Return the planes that another model of the run found from the same spectra."""
    file = folder / f"geometry-mix{fraction_key(fraction)}.json"
    planes = read_json(file)["planes"] if file.is_file() else []
    return [asdict(Plane(**plane | {"normal": tuple(plane["normal"])})) for plane in planes]


def _measured(folder: Path, config: AoaConfig) -> tuple[Spectra | None, Spectra | None, list[str]]:
    """Read the spectra of a run again: return all spectra, the training part, and remarks on them."""
    try:
        data = spectra_of(config)
        _expect_unchanged(data.source, folder)
        return data, data.split(config.split, config.seed)[0], list(data.notes)
    except InputError as error:
        return None, None, [f"The measured spectra are not shown: {error}."]


def _expect_unchanged(source: dict[str, str], folder: Path) -> None:
    """Refuse data whose checksums differ from those in the records of a run."""
    recorded = read_json(folder / ENVIRONMENT).get("input_sha256", {})  # may contain more: a scene to trace in
    if {name: recorded.get(name) for name in source} != source:
        raise InputError("they have changed since the run")


def _locate_run(folder: Path, content: Row) -> RssiView:
    file = folder / LOCATOR
    if not file.is_file():
        raise InputError(f"{folder} holds no model: it has no {LOCATOR}; the run did not end")
    locator = load(file)
    if not isinstance(locator, RssiLocator):
        raise InputError(f"{file} holds {with_article(locator.kind)}, expected {with_article(RssiLocator.kind)}")
    with refusing(f"the records in {folder} are not those of a run"):
        config = parse(LocateConfig, [], "tasks.view", content["config"], folder)
        try:
            data = rssi_of(config)
            _expect_unchanged(data.source, folder)
            train, _ = data.split(config.split, config.seed)
            locating = RssiLocating(locator, data, torch.isin(data.index, train.index))
        except InputError as error:
            note = f"The measured rows are not shown, but the training rows in the locator: {error}."
            return _located(folder.name, RssiLocating.of_training(locator), [note], folder)
    return _located(folder.name, locating, folder=folder)


def _located(
    title: str, locating: RssiLocating, notes: list[str] | None = None, folder: Path | None = None
) -> RssiView:
    return RssiView(title, locating.locator.model, locating.rows, None, locating, notes or [], folder)


def _rssi_run(folder: Path) -> RssiView:
    file = folder / MODEL
    if not file.is_file():
        raise InputError(f"{folder} holds no model: it has no {MODEL}; the run did not end")
    model = load(file)
    if not isinstance(model, RssiModel):
        raise _not_shown(file, model)
    with refusing(f"the maps in {folder} are not those of a run"):
        rows, plan = rows_of_run(folder / "maps.npz", model.receiver_names)
        return RssiView(folder.name, model, rows, plan, folder=folder)
