"""Update a fitted model with new measurements, from files or line by line."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch

from swiftwrf import FieldModel, InputError, Rssi, Spectra, load
from swiftwrf.data import ReadOptions, Snapshots
from swiftwrf.data.formats import RSSI_FORMATS, SNAPSHOT_FORMATS, SPECTRA_FORMATS, read
from swiftwrf.errors import with_article
from swiftwrf.online import Follower, MonitorConfig
from swiftwrf.rssi import RssiModel
from swiftwrf.runtime import checkpoint
from tasks.claim import CONFIG, MODEL, Claim
from tasks.directory import new_directory
from tasks.environment import invocation
from tasks.locate.observations import aligned
from tasks.options import plain
from tasks.page.page import write_page
from tasks.records import write_json
from tasks.source import reading
from tasks.terminal import console, terminal
from tasks.update.lines import answer, measurements
from tasks.update.options import UpdateConfig
from tasks.update.page import page
from tasks.update.record import Record, resumed


def run(config: UpdateConfig) -> None:
    """Write the updated model, a table of the measurements and a page; with --follow, the model after each line.

    Raises:
        InputError: No such model, or measurements that cannot be read or do not fit it.
    """
    if config.follow:
        follow(config)
        return
    with new_directory(Path(config.out), "an update") as folder:
        model = _model(config.model)
        options = reading(config)
        new, train = _read(config.source, options, model), _training(config, options, model)
        follower = Follower(model, train, MonitorConfig(false_alarm_rate=config.false_alarm_rate))
        record = Record(config.source, _unit(model))
        for i, index in enumerate(new.index.tolist()):
            record.add(index, follower.step(new.subset(torch.tensor([i]))))
        _save(follower, folder / MODEL, {})
        record.write(folder)
        _write_config(config, folder)
        write_page(folder, page(record, new.name))
    terminal.page(record.summary(), "\n".join(record.sentences()), Path(config.out) / "report.html")


def follow(config: UpdateConfig) -> None:
    """Print the answer to each line, then record it and replace the model; a line lost with a kill is answered again."""
    folder = Path(config.out)
    folder.mkdir(parents=True, exist_ok=True)
    claim = Claim(folder, new=False)
    file = folder / MODEL
    model = _model(str(file) if file.exists() else config.model)
    train = None if file.exists() else _training(config, reading(config), model)
    follower = Follower(model, train, MonitorConfig(false_alarm_rate=config.false_alarm_rate))
    source, skipped = "" if config.source == "-" else str(Path(config.source).resolve()), 0
    record = Record(config.source, _unit(model))
    if file.exists():
        _, _, header = checkpoint.read(file, model.kind)
        with checkpoint.refusing(f"{file} is no model that a followed source continues"):
            follower.resume(json.loads(header["provenance"]["followed"]))
            record = resumed(folder, follower.count) or record
            skipped = int(header["provenance"].get("lines", 0)) * (source == header["provenance"].get("source"))
    record.write(folder)
    _write_config(config, folder)
    for number, parse in enumerate(measurements(config, model), start=1):
        if source and number <= skipped:
            continue
        before = follower.model
        try:
            new = parse(number, before)
            step = follower.step(new)
        except InputError as error:  # one bad line does not end a run of days
            console.print(f"error: {error}", markup=False)
            continue
        print(answer(follower.count, new, before, step), flush=True)
        record.append(folder, record.add(follower.count - 1, step))
        if not follower.is_waiting:  # after a kill, lines since the last update are answered again
            _save(follower, file, {"source": source, "lines": str(number)})
    claim.release()


def _save(follower: Follower, file: Path, read: dict[str, str]) -> None:
    follower.model.save(file, {"followed": json.dumps(follower.state()), **read})


def _write_config(config: UpdateConfig, folder: Path) -> None:
    write_json(folder / CONFIG, {"task": "update", "command": invocation("update"), "config": plain(config)})


def _unit(model: FieldModel | RssiModel) -> str:
    """Return the unit of the errors of a model, in brackets."""
    return " [dB]" if isinstance(model, RssiModel) else ""


def _model(path: str) -> FieldModel | RssiModel:
    model = load(path)
    if isinstance(model, RssiModel) or (isinstance(model, FieldModel) and model.updates):
        return model
    raise InputError(
        f"{path} holds {with_article(model.kind)}, which cannot be updated; fit it again to all measurements"
    )


def _training(config: UpdateConfig, options: ReadOptions, model: FieldModel | RssiModel) -> Spectra | Rssi | None:
    return None if config.data is None else _read(config.data, options, model)


def _read(source: str, options: ReadOptions, model: FieldModel | RssiModel) -> Spectra | Rssi:
    """Return measurements of the kind that a model predicts."""
    if isinstance(model, RssiModel):
        rssi: Any = read(source, options, RSSI_FORMATS)
        return aligned(rssi.about(model.origin), model.receiver_names)
    data: Any = read(source, options, SPECTRA_FORMATS, SNAPSHOT_FORMATS)
    return data.spectra(model.grid, options.beamformer or "phase") if isinstance(data, Snapshots) else data
