"""A fitted model applied to new positions or measurements: fields at positions, or positions and directions as a table."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from pandas import DataFrame
from torch import Tensor

from swiftwrf.data import Rssi, Spectra, Stations
from swiftwrf.data.coordinates import Floors, degree_columns
from swiftwrf.data.dataset import Numbers
from swiftwrf.data.rooms import Rooms
from swiftwrf.data.store import Store
from swiftwrf.errors import InputError, with_article
from swiftwrf.locate import MatchedField, Posterior, RssiLocator, smoothed
from swiftwrf.locate.rssi import BATCH_ROWS
from swiftwrf.metrics import angle_errors
from swiftwrf.models.base import FieldModel
from swiftwrf.models.prediction import Prediction
from swiftwrf.rssi.base import RssiPredictor
from swiftwrf.runtime.checkpoint import load

MAX_STEP_S = 1000.0  # between rows of a walk
MAX_TRACKED = 20_000_000  # candidate positions of a walk that are in memory together

Columns = dict[str, Any]  # of tensors, and arrays of names


def predict(
    model: Any,
    new: Numbers | Rssi | Spectra | Stations | Store,
    *,
    track: float | None = None,
    truth: bool = True,
    rooms: Rooms | None = None,
) -> Prediction | DataFrame:
    """Apply a fitted model to new positions or measurements.

    Args:
        model: The model, or its file. Models of spectra and RSSI take positions (n, 3) [m], an `RssiLocator` takes `Rssi` at
            its receivers, a `MatchedField` and estimators of the direction take `Spectra`, or a store of unknown positions.
            A `MatchedField` of several stations takes `Stations`.
        new: Positions or measurements.
        track: Speed [m/s] of a walk, along which positions are smoothed: the standard deviation of each component.
        truth: Compare with the positions of the measurements.
        rooms: Rooms whose probability is given for each located row.

    Returns:
        Mean and standard deviation at positions. Otherwise a table with a row for each measurement: positions with standard
        deviations and 80 % radius [m], directions [deg], and truth and error where positions are known. Rows of RSSI that
        no receiver detected are left out.

    Raises:
        InputError: Measurements of other receivers, of another link or grid, or nothing detected; rows without time or a
            walk that is too long; or a model that predicts nothing.

    Example:
        >>> import swiftwrf
        >>> train, test = swiftwrf.rssi_room(n=60).split()
        >>> locator = swiftwrf.RssiLocator(n_cells=300).fit(train)
        >>> predict(locator, test)[["x_m", "y_m", "position_error_m"]].shape
        (12, 3)
    """
    if isinstance(model, str | Path):
        model = load(model)
    if track is not None and not isinstance(model, RssiLocator | MatchedField):
        raise InputError(
            f"a walk smooths positions, and {with_article(getattr(model, 'kind', 'model'))} locates nothing"
        )
    if rooms is not None and not isinstance(model, RssiLocator | MatchedField):
        raise InputError(
            f"rooms are of located rows, and {with_article(getattr(model, 'kind', 'model'))} locates nothing"
        )
    if isinstance(model, FieldModel | RssiPredictor):
        prediction: Prediction = model.predict(new)
        return prediction
    if isinstance(model, RssiLocator):
        if not isinstance(new, Rssi):
            raise InputError(f"an RSSI locator takes Rssi, got {type(new).__name__}")
        columns = _positions_of_rssi(model, new, track, truth, rooms)
    elif not hasattr(model, "predict"):
        raise InputError(f"expected a fitted model or its file, got {type(model).__name__}")
    elif isinstance(new, Stations):
        if not isinstance(model, MatchedField):
            raise InputError(f"{with_article(model.kind)} takes the spectra of one station; give data.of(station)[1]")
        columns = _positions_of_stations(model, new, track, truth, rooms)
    else:
        known = new if isinstance(new, Spectra) else None
        store = (
            new if isinstance(new, Store) else new.store if isinstance(new, Spectra) else Store(torch.as_tensor(new))
        )
        if isinstance(model, MatchedField):
            columns = _positions_of_spectra(model, store, known, track, rooms)
        else:
            estimate = torch.cat([model.predict(part) for part in store.batches()])
            index = torch.arange(len(store)) if known is None else known.index
            columns = {"index": index} | _directions(estimate, known)
    return DataFrame({name: np.asarray(column) for name, column in columns.items()})


def _positions_of_rssi(
    locator: RssiLocator, data: Rssi, track: float | None, truth: bool, rooms: Rooms | None
) -> Columns:
    data = locator.model.aligned(data, located=truth)
    data = data.subset(data.detected.any(dim=1))
    if not len(data):
        raise InputError(f"no receiver detected the transmitter in any row of {data.name}")
    posteriors: Iterable[Posterior] = map(locator.locate, data.rssi_dbm.split(BATCH_ROWS))
    if track is not None:
        posteriors = _tracked(posteriors, _times(data), track)
    position = data.transmitter_position if truth else None
    columns = _located(posteriors, data.index, position, locator.region.floors, rooms)
    degrees = degree_columns(locator.model.origin, torch.stack([columns["x_m"], columns["y_m"]], dim=1).numpy())
    return columns | {name: torch.from_numpy(values.copy()) for name, values in degrees.items()}


def _positions_of_spectra(
    locator: MatchedField, store: Store, known: Spectra | None, track: float | None, rooms: Rooms | None
) -> Columns:
    directions: list[Tensor] = []
    index = torch.arange(len(store)) if known is None else known.index
    rows = torch.arange(len(store)).split(BATCH_ROWS)
    posteriors: Iterable[Posterior] = (locator.locate(store[part] if known is None else known[part]) for part in rows)
    if track is not None:
        posteriors = _tracked(posteriors, index.double(), track)

    def with_direction(posterior: Posterior) -> Posterior:
        directions.append(locator.direction(posterior))
        return posterior

    position = None if known is None else known.position
    columns = _located(map(with_direction, posteriors), index, position, rooms=rooms)
    return columns | _directions(torch.cat(directions), known)


def _positions_of_stations(
    locator: MatchedField, data: Stations, track: float | None, truth: bool, rooms: Rooms | None
) -> Columns:
    data = data.subset(data.received.any(dim=1))
    rows = torch.arange(len(data)).split(BATCH_ROWS)
    posteriors: Iterable[Posterior] = (locator.locate(data.subset(part)) for part in rows)
    if track is not None:
        posteriors = _tracked(posteriors, data.index.double(), track)
    columns = _located(posteriors, data.index, data.position if truth else None, rooms=rooms)
    received = {f"received_{name}": column for name, column in zip(data.names, data.received.T, strict=True)}
    return columns | received


def _directions(estimate: Tensor, known: Spectra | None) -> Columns:
    columns = {"azimuth_deg": estimate[:, 0].rad2deg(), "elevation_deg": estimate[:, 1].rad2deg()}
    if known is None or bool(known.label.isnan().all()):  # positions without the pose of the array give no directions
        return columns
    truth = known.label.rad2deg()
    columns |= {"truth_azimuth_deg": truth[:, 0], "truth_elevation_deg": truth[:, 1]}
    return columns | {"great_circle_deg": angle_errors(estimate, known.label)["great_circle"].rad2deg()}


def _times(data: Rssi) -> Tensor:
    """Return the times (n,) [s] of rows of RSSI: one second a row of the file without a column of times.

    Raises:
        InputError: A row without time.
    """
    if data.time is None:
        return data.index.double()
    missing = data.time.isnan()
    if bool(missing.any()):
        raise InputError(
            f"{data.name} row {int(data.index[missing][0])} (counted from 0) has no time [s] or date, which a walk needs"
        )
    step = float(data.time.sort().values.diff().median()) if len(data) > 1 else 0.0
    if step >= MAX_STEP_S:
        raise InputError(
            f"{data.name} has steps of {step:.0f} s, too long for a walk; if its times are in milliseconds, call their "
            "column time_ms"
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
        if sum(each.log_weight.numel() for each in parts) > MAX_TRACKED:
            most = MAX_TRACKED // part.log_weight.shape[1]
            raise InputError(
                f"a walk has at most {most} rows with this locator; split it, or fit the locator with fewer cells"
            )
    walk = smoothed(Posterior.cat(parts), time, speed_m_s)
    for start in range(0, len(walk), BATCH_ROWS):
        rows = slice(start, start + BATCH_ROWS)
        position = walk.position if len(walk.position) == 1 else walk.position[rows]
        yield replace(walk, position=position, log_weight=walk.log_weight[rows])


def _located(
    posteriors: Iterable[Posterior],
    index: Tensor,
    truth: Tensor | None,
    floors: Floors | None = None,
    rooms: Rooms | None = None,
) -> Columns:
    """Return the columns of a table with the positions of observations, batch by batch."""
    parts = (
        (
            each.median,
            each.std,
            each.credible_radius(),
            each.ambiguous,
            each.floor_probability.amax(dim=1),
            torch.empty(len(each), 0) if rooms is None else rooms.probability(each.position, each.weight),
        )
        for each in posteriors
    )
    if not len(index):
        raise InputError("there is no row to locate")
    position, std, radius, ambiguous, probability, of_rooms = (torch.cat(values) for values in zip(*parts, strict=True))
    columns: Columns = {"index": index}
    columns |= dict(zip(("x_m", "y_m", "z_m"), position.T, strict=True))
    columns |= dict(zip(("std_x_m", "std_y_m", "std_z_m"), std.T, strict=True))
    columns |= {"credible_radius_80_m": radius, "ambiguous": ambiguous}
    if floors is not None:
        columns |= {"floor": np.array(floors.named(position)), "floor_probability": probability}
    columns |= {} if rooms is None else rooms.columns(of_rooms)
    if truth is not None:
        columns |= dict(zip(("truth_x_m", "truth_y_m", "truth_z_m"), truth.T, strict=True))
        columns["position_error_m"] = (position - truth).norm(dim=1)
    return columns
