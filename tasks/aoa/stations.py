"""Runs at several stations together: positions by least squares of the directions that each recommends."""

from __future__ import annotations

from collections.abc import Mapping

import torch

from swiftwrf import Stations
from swiftwrf.locate.triangulation import bearings, triangulated
from tasks.aoa.records import FractionRecords
from tasks.records import Records, Row


def triangulation(train: Stations, test: Stations, runs: Mapping[str, Records]) -> dict[str, Row]:
    """Return position errors [m] by measured fraction, of the directions that each run recommends in its first repeat.

    Args:
        train: Training transmissions, whose mean position decides the side of each array's plane.
        test: Test transmissions.
        runs: Finished run at each station.
    """
    mean, errors = train.position.mean(dim=0), dict[str, Row]()
    for number, key in enumerate(next(iter(runs.values())).metrics["mixes"]):
        directions = {}
        for name, run in runs.items():
            fraction = FractionRecords.of(run)[number]
            table = fraction.table("errors")
            table = table[(table["method"] == fraction.chosen) & (table["repeat"] == 0)].set_index("index")
            angles = table.loc[test.of(name)[1].index.tolist(), ["estimate_azimuth_deg", "estimate_elevation_deg"]]
            directions[name] = torch.from_numpy(angles.to_numpy(float)).deg2rad()
        away = (triangulated(*bearings(test, directions, mean), start=mean) - test.position).norm(dim=1)
        errors[key] = {"median_m": float(away.quantile(0.5)), "p90_m": float(away.quantile(0.9)), "n_test": len(test)}
    return errors


def sentence(errors: Mapping[str, Row], n_stations: int) -> str:
    """Return position errors in words.

    Example:
        >>> sentence({"0.3": {"median_m": 0.12, "p90_m": 0.4, "n_test": 60}}, 3)
        'Directions at 3 stations give positions by least squares: median 0.12 m, 90 % below 0.40 m (0.3 measured).'
    """
    parts = (
        f"median {e['median_m']:.2f} m, 90 % below {e['p90_m']:.2f} m ({key} measured)" for key, e in errors.items()
    )
    return f"Directions at {n_stations} stations give positions by least squares: {'; '.join(parts)}."
