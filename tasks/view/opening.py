"""What a run or a saved model holds to be looked at."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from augment import SYNTHESIZERS, withhold
from swiftwrf import InputError, RssiModel, Spectra, load
from swiftwrf.runtime.checkpoint import Saved, refusing
from tasks.aoa.config import AoaConfig
from tasks.aoa.experiment import measurements
from tasks.claim import CONFIG, ENVIRONMENT
from tasks.records import Row, read_json
from tasks.rssi.experiment import MODEL
from tasks.run import configured
from tasks.view.fitted import Fitted, planes_of
from tasks.view.floor import Floor
from tasks.view.rssi import RssiScene
from tasks.view.spectra import SpectraScene


def opened(source: Path) -> SpectraScene | RssiScene:
    """What is in a run's directory or in the file of a saved model.

    Raises:
        InputError: nothing that can be looked at.
    """
    try:
        is_file, is_folder = source.is_file(), source.is_dir()
    except OSError as error:
        raise InputError(
            f"{source} cannot be read ({error.strerror}); give the directory of a run, or a saved model"
        ) from None
    if is_file:
        return _saved(source)
    if not is_folder:
        raise InputError(
            f"{source} is not there; give the directory of a run of tasks.aoa or tasks.rssi, or a saved model"
        )
    if not (source / CONFIG).is_file():
        raise InputError(f"{source} is no run: it has no {CONFIG}; give the directory of a run, or a saved model")
    content = read_json(source / CONFIG)
    match content.get("task"):
        case "aoa":
            return _aoa_run(source, content)
        case "rssi":
            return _rssi_run(source)
        case other:
            raise InputError(
                f"{source} is a run of tasks.{other}; only runs of tasks.aoa and tasks.rssi can be looked at"
            )


def _saved(file: Path) -> SpectraScene | RssiScene:
    model = load(file)
    if isinstance(model, RssiModel):
        return RssiScene(file.name, model, Floor.of(model))
    return SpectraScene(file.name, [Fitted(model.kind, model, planes_of(model))])


def _aoa_run(folder: Path, content: Row) -> SpectraScene:
    names = "|".join(map(re.escape, ("model", *SYNTHESIZERS)))  # estimators are kept beside them
    pattern = re.compile(rf"(?P<name>{names})-mix(?P<share>.+)\.safetensors")
    found = [(match, file) for file in sorted(folder.iterdir()) if (match := pattern.fullmatch(file.name))]
    if not found:
        raise InputError(
            f"{folder} holds no model: its synthesizers have none that can be saved; run tasks.aoa with --synthesizer "
            "swiftwrf, or another that has one"
        )
    with refusing(f"the records in {folder} are not those of a run"):
        data, rows, notes = _measured(folder, content)
        fitted = [
            Fitted(_title(match), model := load(file), _planes(folder, match["share"], model), rows.get(match["share"]))
            for match, file in found
        ]
    return SpectraScene(folder.name, fitted, data, notes)


def _title(match: re.Match[str]) -> str:
    name = "swiftwrf" if match["name"] == "model" else match["name"]
    return f"{name}, {float(match['share']):.0%} measured"


def _planes(folder: Path, share: str, model: Saved) -> list[dict[str, Any]]:
    """The room that the model found, or else another of the run on the same spectra."""
    own, file = planes_of(model), folder / f"geometry-mix{share}.json"
    if own or not file.is_file():
        return own
    planes: list[dict[str, Any]] = read_json(file)["planes"]
    return planes


def _measured(folder: Path, content: Row) -> tuple[Spectra | None, dict[str, Any], list[str]]:
    """The spectra of the run, the rows that its models learnt from by share, and what to say of them."""
    try:
        config = configured(AoaConfig, content["config"], folder)
        data = measurements(config)
        known = read_json(folder / ENVIRONMENT).get("input_sha256", {})  # a run may have read more: a scene to trace in
        if {name: known.get(name) for name in data.source} != data.source:
            raise InputError("they have changed since the run")
        train, _ = data.split(config.split, config.seed)
        rows = {}
        for share in config.mix:
            learnt, _ = withhold(train, share, config.seed)
            rows[f"{share:g}"] = np.isin(data.index.numpy(), learnt.index.numpy())
    except InputError as error:
        return None, {}, [f"The measured spectra are not shown: {error}."]
    return data, rows, list(data.notes)


def _rssi_run(folder: Path) -> RssiScene:
    file = folder / MODEL
    if not file.is_file():
        raise InputError(
            f"{folder} holds no model: it has no {MODEL}; it was stopped early or is of an older version, run it anew"
        )
    model = load(file)
    if not isinstance(model, RssiModel):
        raise InputError(f"{file} holds a {model.kind}, expected a {RssiModel.kind}")
    with refusing(f"the maps in {folder} are not those of a run"), np.load(folder / "maps.npz") as stored:
        floor = Floor.kept(dict(stored))
    return RssiScene(folder.name, model, floor)
