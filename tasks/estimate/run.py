"""Directions from spectra, by an estimator that a run of tasks.aoa trained."""

from __future__ import annotations

from pathlib import Path

import torch

from augment.estimators import SavedEstimator
from swiftwrf import InputError, load
from swiftwrf.errors import with_article
from swiftwrf.locate import MatchedField
from swiftwrf.metrics import angle_errors
from tasks.directory import check_new_file
from tasks.environment import stamp
from tasks.estimate.options import EstimateConfig
from tasks.records import rounded, write_table
from tasks.source import observed_spectra, reading


def run(config: EstimateConfig) -> None:
    """Write one row for each spectrum: azimuth and elevation [deg] and, where positions are known, the truth and the error.

    Raises:
        InputError: no such estimator, spectra that cannot be read or are not like those it was trained on, or `out` exists.
    """
    out = Path(config.out or f"directions-{stamp()}.csv")
    check_new_file(out, "--out ")
    estimator = load(config.estimator)
    if not isinstance(estimator, SavedEstimator | MatchedField):
        raise InputError(
            f"{config.estimator} holds {with_article(estimator.kind)}; give an estimator that tasks.aoa trained"
        )
    store, known = observed_spectra(config.source, reading(config), estimator.grid, "estimator")
    estimate = torch.cat([estimator.predict(part) for part in store.batches()])
    columns = {"azimuth_deg": estimate[:, 0].rad2deg(), "elevation_deg": estimate[:, 1].rad2deg()}
    if known is not None:
        truth = known.label.rad2deg()
        columns |= {"truth_azimuth_deg": truth[:, 0], "truth_elevation_deg": truth[:, 1]}
        columns["great_circle_deg"] = angle_errors(estimate, known.label)["great_circle"].rad2deg()
    index = torch.arange(len(store)) if known is None else known.index
    rows = zip(index.tolist(), *(column.tolist() for column in columns.values()), strict=True)
    write_table(out, rounded(dict(zip(("index", *columns), row, strict=True)) for row in rows))
    error = ""
    if known is not None:
        median = columns["great_circle_deg"].median()
        error = f", median error {median:.2f} degrees, too low if these spectra trained the estimator"
    print(f"{len(store)} directions{error}: {out}")
