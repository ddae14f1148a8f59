"""Maps and coverage that a comparison records: each floor, at thresholds, of any, two and each receiver."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from pandas import DataFrame, concat

from swiftwrf.contrib.comparison.base import Values
from swiftwrf.data import Rssi
from swiftwrf.data.coordinates import degree_columns
from swiftwrf.data.rooms import Rooms
from swiftwrf.metrics import LEVEL
from swiftwrf.rssi.coverage import CERTAINTY, CLASSES, Coverage, classified, reach
from swiftwrf.rssi.maps import RssiMap
from swiftwrf.rssi.model import RssiModel
from swiftwrf.rssi.pairs import PairModel
from swiftwrf.rssi.scans import at_least, passing

ANY, TWO = "any receiver", "two receivers"  # of a scan, above the threshold; others are names of receivers
MAX_SPOTS = 100  # rows of a floor and threshold in the table of weak spots


def maps_and_coverage(
    model: RssiModel | PairModel,
    train: Rssi,
    test: Rssi,
    thresholds_dbm: Sequence[float],
    rooms: Rooms | None = None,
    below: bool = False,
) -> tuple[dict[str, NDArray[Any]], list[Values], dict[str, DataFrame]]:
    """Return maps of each floor, their coverage, and tables of it.

    Without floors there is one map, at the median height of the measurements.

    Args:
        model: Fitted model.
        train: Training rows, the scans.
        test: Test rows without offsets between groups, whose scans are counted.
        thresholds_dbm: Thresholds of the coverage. Maps are those of the first one.
        rooms: Rooms whose coverage is given in a table `rooms`, at any receiver.
        below: True where smaller is better; see `Coverage.of`.

    Returns:
        Arrays (floors, R, H, W) or (floors, H, W) by name; `Coverage.values` of each floor, at the first threshold and any
        receiver; tables `coverage`, with a row for each floor, threshold and receiver, `weak_spots`, and, with bands of the
        receivers, `bands`, with a row for each floor, threshold and band.

    Example:
        >>> import swiftwrf
        >>> train, test = swiftwrf.rssi_room(n=60).columns([0, 5]).split()
        >>> _, _, tables = maps_and_coverage(swiftwrf.RssiModel().fit(train), train, test, [-70.0])
        >>> tables["coverage"]["receiver"].tolist()
        ['any receiver', 'two receivers', 'receiver01', 'receiver06']
    """
    floors = train.floors
    names, heights = (floors.names, floors.height_m) if floors else ([""], [None])
    of_row, of_test = (
        floors.number(rows.transmitter_position) if floors else torch.zeros(len(rows), dtype=torch.int64)
        for rows in (train, test)
    )
    charts = [RssiMap.of_packets(model, height=height) for height in heights]
    found, tables, first, of_rooms = list[Values](), [], [], []
    for number, (name, (_, detected)) in enumerate(zip(names, charts, strict=True)):
        scans, held_out = train[of_row == number], test[of_test == number]
        for threshold in thresholds_dbm:
            best, *_ = of_floor = _coverages(model, detected, (scans, held_out), threshold, below)
            first += [best[0]] if threshold == thresholds_dbm[0] else []
            found += [{"floor": name} | row for _, row in of_floor]
            of_rooms += [] if rooms is None else _of_rooms(rooms, detected, best[0])
            spots = best[0].weak_spots(detected).head(MAX_SPOTS).round(3)
            degrees = degree_columns(train.origin, spots[["x_m", "y_m"]].to_numpy())
            tables.append(
                spots.assign(**degrees, floor=name, threshold_dbm=threshold, direction=best[0].values["direction"])
            )
    every = [chart for chart, _ in charts]
    lower, upper = zip(*(chart.prediction.interval(LEVEL) for chart in every), strict=True)
    maps: dict[str, NDArray[Any]] = {
        "x": every[0].x,
        "y": every[0].y,
        "predicted": np.stack([chart.mean for chart in every]),
        "width": (torch.stack(upper) - torch.stack(lower)).numpy(),
        "detection": np.stack([chart.detection for chart in every]),
        "above": np.stack([floor.probability for floor in first]),
        "inside": np.stack([floor.inside for floor in first]),
        "known": np.stack([floor.measured for floor in first]),
        "measured_position": train.transmitter_position.numpy(),
        "measured": train.rssi_dbm.numpy(),
        "receiver": train.receiver_position.numpy(),
        "receiver_names": np.array(train.receiver_names),
        "bands": np.array(train.bands or ()).astype(np.str_),
        "floor_names": np.array(names),
        "floor_of_row": of_row.numpy(),
    }
    maps = maps if train.origin is None else maps | {"origin": np.array(train.origin)}
    of_floors = [{"floor": name} | floor.values for name, floor in zip(names, first, strict=True)]
    of_receivers, of_bands = ([row for row in found if key in row] for key in ("receiver", "band"))
    of_all = {"coverage": DataFrame(of_receivers), "weak_spots": concat(tables, ignore_index=True)}
    of_all |= {"bands": DataFrame(of_bands)} if of_bands else {}
    return maps, of_floors, of_all if rooms is None else of_all | {"rooms": DataFrame(of_rooms)}


def _of_rooms(rooms: Rooms, chart: RssiMap, coverage: Coverage) -> list[Values]:
    """Return the coverage of each room that has cells on the floor of a map."""
    cells = np.stack([*np.meshgrid(chart.x, chart.y), np.full((len(chart.y), len(chart.x)), chart.height)], axis=-1)
    within = rooms.contain(torch.from_numpy(cells.reshape(-1, 3))).reshape(*cells.shape[:2], -1)
    of_cell = classified(coverage.probability, coverage.measured, coverage.values["certainty"])
    found = []
    for room, name in enumerate(rooms.names):
        of_room = of_cell[within[..., room]]
        if len(of_room):
            measured = of_room[of_room > 0]
            shares = {
                kind.replace(" ", "_"): float((measured == CLASSES.index(kind)).mean()) if len(measured) else None
                for kind in reversed(CLASSES[1:])
            }
            row: Values = {"room": name} | {key: coverage.values[key] for key in ("threshold_dbm", "direction")}
            row |= {"area_m2": len(of_room) * chart.cell**2, "not_measured": float((of_room == 0).mean())} | shares
            of_receiver = chart.mean[:, within[..., room]].mean(axis=1)
            best = of_receiver.argmin() if coverage.values["direction"] == "below" else of_receiver.argmax()
            found.append(row | {"best_receiver": chart.receiver_names[best]})
    return found


def _coverages(
    model: RssiModel | PairModel, chart: RssiMap, parts: tuple[Rssi, Rssi], threshold_dbm: float, below: bool
) -> list[tuple[Coverage, Values]]:
    """Return the coverage of any, of two and of each receiver and by band, with the predicted and counted test scans.

    The parts are the scans and the test rows on the floor. That of a band is that of any of its receivers.
    """
    names, found, fields, distance, (scans, held_out) = chart.receiver_names, [], None, reach(model), parts
    if len(held_out) and not held_out.receiver_moves:
        prediction, detection = model.predict_detected(held_out), model.predict_detection(held_out)
        assert prediction.std is not None
        fields = prediction.mean.T, prediction.std.T, detection.T
    every, limit = list(range(len(names))), (threshold_dbm, model.scan_correlation, below)
    chosen = [("receiver", ANY, every, 1), ("receiver", TWO, every, 2)] if len(names) > 1 else []
    chosen += [("receiver", name, [column], 1) for column, name in enumerate(names)]
    chosen += [("band", name, columns, 1) for name, columns in scans.receivers_by_band.items()]
    for kind, which, columns, number in chosen:
        part = chart if columns == every else chart.receivers([names[column] for column in columns])
        coverage = Coverage.of(part, scans.columns(columns), (threshold_dbm, CERTAINTY, number), distance, below)
        row: Values = {kind: which} | coverage.values
        if fields is not None:
            mean, std, detection = (field[columns] for field in fields)
            above = passing(held_out.rssi_dbm[:, columns], threshold_dbm, number, below)
            row |= {
                "n_test": len(held_out),
                "test_predicted": float(at_least(number, mean, std, detection, *limit).mean()),
                "test_above": float(above.double().mean()),
            }
        found.append((coverage, row))
    return found
