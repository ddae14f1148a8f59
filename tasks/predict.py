"""A saved model applied to new measurements or positions; the answers as a table."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from os.path import isfile  # unlike Path.is_file, it is False for names that are too long
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from augment.estimators import SavedEstimator
from swiftwrf import FieldModel, InputError, Rssi, Spectra, load
from swiftwrf.data import ReadOptions
from swiftwrf.data.coordinates import Floors, PlanFrame, degree_columns
from swiftwrf.data.files import TABLES, read_table
from swiftwrf.data.formats import RSSI_FORMATS, read
from swiftwrf.data.receivers import read_places
from swiftwrf.data.survey import has_positions
from swiftwrf.errors import with_article
from swiftwrf.locate import MatchedField, Posterior, RssiLocator, smoothed
from swiftwrf.locate.baselines import BATCH_ROWS
from swiftwrf.metrics import angle_errors
from swiftwrf.rssi.base import RssiPredictor
from tasks.aoa.records import FractionRecords
from tasks.configs import PredictConfig
from tasks.convert import write_file
from tasks.directory import check_new_file, model_file
from tasks.environment import stamp
from tasks.options import given
from tasks.page.records import Records
from tasks.records import CONFIG, Row, rounded, write_table
from tasks.source import aligned, located, observed_spectra, reading
from tasks.terminal import console, terminal

MEDIANS = {"great_circle_deg": "degrees", "position_error_m": "m"}  # columns of errors and their units


Columns = dict[str, Any]  # of tensors, and arrays of names
MAX_STEP_S = 1000.0  # between rows of a walk
MAX_TRACKED = 20_000_000  # candidate positions of a walk that are in memory together


def run(config: PredictConfig) -> None:
    """Write one row for each measurement or position, with truth and error where they are known.

    Raises:
        InputError: No model, a source that cannot be read or is not like what the model was fitted to, options that do not
            apply to the model, or `out` exists.
    """
    out = Path(config.out or f"predicted-{stamp()}.csv")
    check_new_file(out, "--out ")
    file = saved_file(Path(config.model))
    model = load(file)
    at_positions = isinstance(model, FieldModel | RssiPredictor)
    for kinds, options in (("RSSI", config.table), ("spectra", config.spectra)):
        is_read = not at_positions and isinstance(model, RssiLocator) == (kinds == "RSSI")
        if not is_read and (unused := given(options)):
            raise InputError(
                f"--{next(iter(unused))} is for reading {kinds}, and {file} holds {with_article(model.kind)}"
            )
    if config.track is not None and not isinstance(model, RssiLocator | MatchedField):
        raise InputError(
            f"--track smooths positions, and {file} holds {with_article(model.kind)}, which locates nothing"
        )
    if isinstance(model, FieldModel | RssiPredictor):
        origin = model.origin if isinstance(model, RssiPredictor) else None
        frame = PlanFrame(config.table.scale, config.table.y_down, config.table.up)
        prediction = model.predict(read_places(Path(config.source), origin, frame))
        terminal.page({"table": str(out)}, f"{write_file(prediction, out)}: {out}")
        return
    if isinstance(model, RssiLocator):
        columns = positions_of_rssi(model, config)
    elif isinstance(model, MatchedField):
        columns = positions_of_spectra(model, config)
    elif isinstance(model, SavedEstimator):
        columns = directions(model, config)
    else:
        raise InputError(
            f"{file} holds {with_article(model.kind)}, which no command applies; load it with swiftwrf.load in Python"
        )
    rows = zip(*(column.tolist() for column in columns.values()), strict=True)
    write_table(out, rounded(dict(zip(columns, row, strict=True)) for row in rows))
    values: Row = {"n": len(columns["index"]), "table": str(out)}
    values |= {f"median_{name}": float(np.median(columns[name])) for name in MEDIANS if name in columns}
    errors = " and ".join(f"{values[f'median_{name}']:.2f} {MEDIANS[name]}" for name in MEDIANS if name in columns)
    what = "positions" if "x_m" in columns else "directions"
    said = f", median error {errors}, too low if these rows trained the model" if errors else ""
    terminal.page(values, f"{values['n']} {what}{said}: {out}")


def saved_file(model: Path) -> Path:
    """Return the file of a model: the given one, or the one that a run's directory recommends.

    Raises:
        InputError: A run that recommends no file.
    """
    if not isfile(model / CONFIG):
        return model
    if kept := model_file(model):
        return kept
    records = Records(model)
    fractions = FractionRecords.of(records) if "mixes" in records.metrics else []
    chosen = max(fractions, key=lambda fraction: float(fraction.key)).chosen_file if fractions else None
    if chosen is None:
        raise InputError(f"{model} is a run whose choice has no file; name one of its models, {model}/....safetensors")
    console.print(f"applied: {chosen}")
    return chosen


def positions_of_rssi(locator: RssiLocator, config: PredictConfig) -> Columns:
    """Return positions with their uncertainty, and truth and error where rows have positions.

    Raises:
        InputError: RSSI that cannot be read, receivers that moved or that the locator does not have, or nothing detected.
    """
    source, options = config.source, reading(config.spectra, config.table)
    offsets = locator.model.offsets
    if offsets is not None and _is_table(source) and offsets.column in read_table(Path(source)).columns:
        options = replace(options, offset_by=offsets.column)
    data, is_known = read_rssi(source, options)
    origin = locator.model.origin
    if is_known and data.origin is not None and origin is None:
        raise InputError(f"{source} has positions in degrees, {config.model} was fitted to metres; give metres")
    if offsets is not None:
        if data.groups is None:
            console.print(f"{data.name}: rows count as those of {offsets.column} {offsets.reference}")
        data = offsets.removed(data)
    data = aligned(data.about(origin), locator.receiver_names, config.ignore_receivers)
    locator.model.check_measurements(data)
    kept = data.detected.any(dim=1)
    if not bool(kept.any()):
        raise InputError(f"no receiver of {config.model} detected the transmitter in any row of {source}")
    if not bool(kept.all()):
        console.print(f"{data.name}: rows that no receiver detected are left out: {int((~kept).sum())}")
    data = data.subset(kept)
    posteriors: Iterable[Posterior] = map(locator.locate, data.rssi_dbm.split(BATCH_ROWS))
    if config.track is not None:
        posteriors = _tracked(posteriors, _times(source, data), config.track)
    truth = data.transmitter_position if is_known else None
    columns = _located(posteriors, data.index, truth, locator.region.floors)
    degrees = degree_columns(origin, torch.stack([columns["x_m"], columns["y_m"]], dim=1).numpy())
    return columns | {name: torch.from_numpy(values.copy()) for name, values in degrees.items()}


def read_rssi(source: str, options: ReadOptions) -> tuple[Rssi, bool]:
    """Read RSSI, and return it with True if its positions are known. A survey table may have none.

    Raises:
        InputError: RSSI that cannot be read.
    """
    if _is_table(source):
        file = Path(source)
        frame = read_table(file)
        if not has_positions(frame, options.columns or {}):
            somewhere = frame.assign(x=0.0, y=0.0, z=0.0)
            names = ("columns", "filler", "offset_by", "pool_by", "window")
            data = Rssi.from_frame(somewhere, **{name: getattr(options, name) for name in names}, name=file.stem)
            return data, False
    return read(located(source), options, RSSI_FORMATS), True


def _is_table(source: str) -> bool:
    return Path(source).is_file() and Path(source).suffix.lower() in TABLES


def directions(estimator: SavedEstimator, config: PredictConfig) -> Columns:
    """Return azimuth and elevation [deg], and truth and error where spectra have positions.

    Raises:
        InputError: Spectra that cannot be read, or on another grid.
    """
    store, known = observed_spectra(config.source, reading(config.spectra, config.table), estimator.grid, "estimator")
    estimate = torch.cat([estimator.predict(part) for part in store.batches()])
    return {"index": torch.arange(len(store)) if known is None else known.index} | _directions(estimate, known)


def positions_of_spectra(locator: MatchedField, config: PredictConfig) -> Columns:
    """Return positions with their uncertainty and directions, and truth and errors where spectra have positions.

    Raises:
        InputError: Spectra that cannot be read, on another grid or of another array.
    """
    store, known = observed_spectra(config.source, reading(config.spectra, config.table), locator.grid, "locator")
    if known is not None and known.array is not None and known.array != locator.room.array:
        raise InputError(f"{config.source} has spectra of another array than those that {config.model} was fitted to")
    found: list[Tensor] = []
    index = torch.arange(len(store)) if known is None else known.index
    batches: Iterable[Tensor] = (part for batch in store.batches() for part in batch.split(BATCH_ROWS))
    if known is not None and known.channel is not None:
        batches = known.channel.split(BATCH_ROWS) if locator.n_snapshots else batches
    posteriors: Iterable[Posterior] = map(locator.locate, batches)
    if config.track is not None:
        posteriors = _tracked(posteriors, index.double(), config.track)

    def with_direction(posterior: Posterior) -> Posterior:
        found.append(locator.direction(posterior))
        return posterior

    columns = _located(map(with_direction, posteriors), index, None if known is None else known.position)
    return columns | _directions(torch.cat(found), known)


def _directions(estimate: Tensor, known: Spectra | None) -> Columns:
    columns = {"azimuth_deg": estimate[:, 0].rad2deg(), "elevation_deg": estimate[:, 1].rad2deg()}
    if known is None or bool(known.label.isnan().all()):  # positions without the pose of the array give no directions
        return columns
    truth = known.label.rad2deg()
    columns |= {"truth_azimuth_deg": truth[:, 0], "truth_elevation_deg": truth[:, 1]}
    return columns | {"great_circle_deg": angle_errors(estimate, known.label)["great_circle"].rad2deg()}


def _times(source: str, data: Rssi) -> Tensor:
    """Return the times (n,) [s] of rows of RSSI: one second a row of the file without a column of times.

    Raises:
        InputError: A row without time.
    """
    if data.time is None:
        return data.index.double()
    missing = data.time.isnan()
    if bool(missing.any()):
        raise InputError(
            f"{source} row {int(data.index[missing][0])} (counted from 0) has no time [s] or date, which --track needs"
        )
    step = float(data.time.sort().values.diff().median()) if len(data) > 1 else 0.0
    if step >= MAX_STEP_S:
        raise InputError(
            f"{source} has steps of {step:.0f} s, too long for --track; if its times are in milliseconds, call their column "
            "time_ms"
        )
    return data.time


def _tracked(posteriors: Iterable[Posterior], time: Tensor, speed_m_s: float) -> Iterator[Posterior]:
    """Yield the posteriors of a walk in groups, smoothed along it.

    Raises:
        InputError: A walk that is too long, or times or a speed that are none.
    """
    parts: list[Posterior] = []
    for part in posteriors:
        parts.append(part)
        if sum(some.log_weight.numel() for some in parts) > MAX_TRACKED:
            most = MAX_TRACKED // part.log_weight.shape[1]
            raise InputError(f"--track takes {most} rows with this locator; split SOURCE, or fit it with fewer --cells")
    whole = smoothed(Posterior.cat(parts), time, speed_m_s)
    for start in range(0, len(whole), BATCH_ROWS):
        rows = slice(start, start + BATCH_ROWS)
        position = whole.position if len(whole.position) == 1 else whole.position[rows]
        yield replace(whole, position=position, log_weight=whole.log_weight[rows])


def _located(
    posteriors: Iterable[Posterior], index: Tensor, truth: Tensor | None, floors: Floors | None = None
) -> Columns:
    """Return the columns of a table with the positions of observations, batch by batch."""
    parts = (
        (each.median, each.std, each.credible_radius(0.8), each.ambiguous, each.floor_probability.amax(dim=1))
        for each in posteriors
    )
    position, std, radius, ambiguous, probability = (torch.cat(values) for values in zip(*parts, strict=True))
    columns: Columns = {"index": index}
    columns |= dict(zip(("x_m", "y_m", "z_m"), position.T, strict=True))
    columns |= dict(zip(("std_x_m", "std_y_m", "std_z_m"), std.T, strict=True))
    columns |= {"credible_radius_80_m": radius, "ambiguous": ambiguous}
    if floors is not None:
        columns |= {"floor": np.array(floors.named(position)), "floor_probability": probability}
    if truth is not None:
        columns |= dict(zip(("truth_x_m", "truth_y_m", "truth_z_m"), truth.T, strict=True))
        columns["position_error_m"] = (position - truth).norm(dim=1)
    return columns
