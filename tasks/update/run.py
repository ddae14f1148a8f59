"""Update a fitted model with new measurements, from files or line by line."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch

from swiftwrf import FieldModel, InputError, Rssi, Spectra, load
from swiftwrf.data import ReadOptions, Snapshots
from swiftwrf.data.formats import RSSI_FORMATS, SNAPSHOT_FORMATS, SPECTRA_FORMATS, read
from swiftwrf.online import Follower, MonitorConfig, ObstacleMonitor
from swiftwrf.rssi import RssiModel
from swiftwrf.runtime import checkpoint
from tasks.directory import new_directory
from tasks.locate.observations import aligned
from tasks.page.page import write_page
from tasks.records import write_json, write_table
from tasks.source import reading
from tasks.terminal import console, terminal
from tasks.update.lines import answer, lines, measurement
from tasks.update.options import UpdateConfig
from tasks.update.page import Followed, page

MODEL = "model.safetensors"


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
        followed = Followed(config.source, new, [follower.step(new.subset(torch.tensor([i]))) for i in range(len(new))])
        room = model.room if isinstance(model, FieldModel) else None
        obstacles = None
        if room is not None and isinstance(new, Spectra) and isinstance(train, Spectra):
            obstacles = ObstacleMonitor(room, train, config.false_alarm_rate)
            obstacles.observe(new)
        _save(follower, folder / MODEL)
        write_table(folder / "measurements.csv", followed.rows())
        write_json(folder / "update.json", followed.summary(obstacles))
        write_page(folder, page(followed, obstacles))
    terminal.page(
        followed.summary(obstacles), "\n".join(followed.sentences(obstacles)), Path(config.out) / "report.html"
    )


def follow(config: UpdateConfig) -> None:
    """Print the answer to each line, then replace the model; a line whose answer was lost with a kill is answered again."""
    folder = Path(config.out)
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / MODEL
    model = _model(str(file) if file.exists() else config.model)
    train = None if file.exists() else _training(config, reading(config), model)
    follower = Follower(model, train, MonitorConfig(false_alarm_rate=config.false_alarm_rate))
    if file.exists():
        _, _, header = checkpoint.read(file, model.kind)
        with checkpoint.refusing(f"{file} is no model that a followed source continues"):
            follower.resume(json.loads(header["provenance"]["followed"]))
    skipped = follower.count if config.source != "-" else 0
    for number, line in enumerate(lines(config.source), start=1):
        if number <= skipped:
            continue
        try:
            new = measurement(line, number, follower.model)
        except InputError as error:  # one bad line does not end a run of days
            console.print(f"error: {error}", markup=False)
            if config.source != "-":
                raise
            continue
        before = follower.model
        step = follower.step(new)
        print(answer(follower.count, new, before, step), flush=True)
        _save(follower, file)


def _save(follower: Follower, file: Path) -> None:
    follower.model.save(file, {"followed": json.dumps(follower.state())})


def _model(path: str) -> FieldModel | RssiModel:
    model = load(path)
    if isinstance(model, RssiModel) or (isinstance(model, FieldModel) and model.updates):
        return model
    raise InputError(f"{path} holds a {model.kind}, which cannot be updated; fit it again to all measurements")


def _training(config: UpdateConfig, options: ReadOptions, model: FieldModel | RssiModel) -> Spectra | Rssi | None:
    return None if config.data is None else _read(config.data, options, model)


def _read(source: str, options: ReadOptions, model: FieldModel | RssiModel) -> Spectra | Rssi:
    """Return measurements of the kind that a model predicts."""
    if isinstance(model, RssiModel):
        rssi: Any = read(source, options, RSSI_FORMATS)
        return aligned(rssi.about(model.origin), model.receiver_names)
    data: Any = read(source, options, SPECTRA_FORMATS, SNAPSHOT_FORMATS)
    return data.spectra(model.grid, options.beamformer or "phase") if isinstance(data, Snapshots) else data
