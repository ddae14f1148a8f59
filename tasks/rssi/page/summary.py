"""The summary of a report: three numbers, a picture, their meaning and the next steps."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pandas import DataFrame

from tasks.metrics import RssiMetrics
from tasks.page.page import Number, Plot, Summary
from tasks.page.records import Records, notes
from tasks.summarise import verdict_of_difference
from tasks.terminal import Answer

RssiRecords = Records[RssiMetrics]
MAX_EVEN_DB = 0.01  # difference of widths up to which an interval counts as equally wide everywhere
MAX_COVERAGE_ERROR = 0.05  # difference from the nominal coverage above which the report warns


def summary(run: RssiRecords, picture: Plot) -> Summary:
    """Return the summary of one run."""
    error = {name: entry["abs_error_db"] for name, entry in run.metrics["overall"].items()}
    own, best = error[model_of(run)], best_baseline(run)
    interval = run.metrics["interval"]
    shared = error.get("mri_pooled")
    also = f"; one path-loss model for all receivers: {shared['median']:.2f} dB" if shared else ""
    numbers = [
        Number(
            f"{own['median']:.2f} dB",
            f"median absolute error of {title(run)}, 95 % interval [{own['low']:.2f}, {own['high']:.2f}]; 90 % of the "
            f"errors are below {own['p90']:.1f} dB",
        ),
        Number(f"{error[best]['median']:.2f} dB", f"the best baseline, {best}{also}"),
        Number(
            f"{interval['coverage']:.0%}",
            f"of the test measurements lie in the {interval['nominal']:.0%} interval that comes with each prediction",
        ),
    ]
    receivers = len(run.metrics["receivers"])
    meaning = [
        f"On {run.scene}: {run.metrics['n_train']} training rows and {run.metrics['n_test']} test rows with {own['n']} "
        f"detected pairs at {receivers} {'receiver' if receivers == 1 else 'receivers'}.",
        *notes(run),
    ]
    return Summary(numbers, picture, meaning, _next_steps(run), verdict(run))


def answer(run: RssiRecords) -> Answer:
    """Return what the terminal shows of a run."""
    overall = sorted(run.metrics["overall"].items(), key=lambda item: item[1]["abs_error_db"]["median"])
    rows = [({"model": name}, entry["abs_error_db"]) for name, entry in overall]
    return Answer("dB", rows, verdict(run), _next_steps(run))


def model_of(run: RssiRecords) -> str:
    """Return the predictor that all others are compared with, whose maps and intervals the run contains."""
    return run.metrics.get("model", "swiftwrf")


def title(run: RssiRecords) -> str:
    """Return the name of that predictor in sentences."""
    return {"swiftwrf": "SwiftWRF"}.get(model_of(run), model_of(run))


def best_baseline(run: RssiRecords) -> str:
    """Return the name of the baseline with the lowest median error."""
    own = model_of(run)
    error = {name: entry["abs_error_db"]["median"] for name, entry in run.metrics["overall"].items() if name != own}
    return min(error, key=lambda name: error[name])


def verdict(run: RssiRecords) -> str:
    """Return a sentence that compares the model with the best baseline."""
    best = best_baseline(run)
    n_test = run.metrics["n_test"]
    own, name = model_of(run), title(run)
    return verdict_of_difference(by_method(run), own, best, name=name, unit="dB", rows="pairs", n_test=n_test)


def _next_steps(run: RssiRecords) -> list[str]:
    maps = run.arrays("maps")
    width = maps["width"].mean(axis=0)
    uneven = varies(maps["width"])
    steps = []
    if uneven:
        row, column = np.unravel_index(np.argmax(width), width.shape)
        of_several = " on average over the receivers" if len(maps["width"]) > 1 else ""
        steps.append(
            f"Measure around x = {maps['x'][column]:.1f} m, y = {maps['y'][row]:.1f} m: the 80 % interval is widest there "
            f"({width[row, column]:.0f} dB{of_several})."
        )
    steps.append("predictions.csv has every test row with its prediction and interval.")
    interval = run.metrics["interval"]
    if abs(interval["coverage"] - interval["nominal"]) > MAX_COVERAGE_ERROR:
        ranking = "take their widths as a ranking, not as a promise" if uneven else "do not rely on them"
        steps.append(f"The intervals are not calibrated on these rows; {ranking}.")
    if model_of(run) == "pairs" and run.metrics["split"] != "place":
        steps.append("Run --split place: it shows the error of a receiver at positions where it measured nothing.")
    elif run.metrics["split"] == "random":
        steps.append("Run --split block: it shows the error in a region where nothing was measured.")
    return steps


def varies(width: NDArray[np.float64]) -> bool:
    """Return True if an interval is wider at some positions than at others. Without a field it has one width everywhere."""
    return bool(np.ptp(width, axis=(1, 2)).max() > MAX_EVEN_DB)


def by_method(run: RssiRecords) -> DataFrame:
    """Return the absolute errors, one row for each pair and one column for each method."""
    errors: DataFrame = run.table("errors").pivot_table(
        index=["index", "receiver"], columns="method", values="abs_error_db"
    )
    return errors
