"""The answer of a localization run: errors of all localizers, the conclusion, the next steps."""

from __future__ import annotations

from pandas import DataFrame

from tasks.answer import Answer, Method, NextStep
from tasks.metrics import LocateMetrics
from tasks.page.page import number
from tasks.page.records import Records
from tasks.page.shared import again, difference, next_steps
from tasks.summarise import comparison_sentence, coverage_warning

LocateRecords = Records[LocateMetrics]
OWN = "posterior"  # the localizer that all others are compared with
NEIGHBOURS = ("knn", "knn_difference")
LEVEL = 0.8  # probability of the credible regions in the summary


def answer(run: LocateRecords) -> Answer:
    """Return the answer of a run."""
    errors, methods = by_method(run), []
    for name, entry in run.metrics["overall"].items():
        cells = {"median in plan [m]": number(entry["horizontal_error_m"]["median"])}
        cells |= {"floors right": f"{entry['floor_hit_rate']:.1%}"} if "floor_hit_rate" in entry else {}
        cells |= {f"{OWN} minus it [m]": difference(errors, OWN, name)}
        seconds = entry["seconds"]["fit"], entry["seconds"]["predict"]
        methods.append(Method(name, entry["position_error_m"], name == "mean", seconds, cells))
    return Answer("m", methods, OWN, conclusion(run), _steps(run), NEIGHBOURS)


def conclusion(run: LocateRecords) -> list[str]:
    """Return the position error, how sure it is, and how the posterior compares with the best other localizer."""
    error = {name: entry["position_error_m"] for name, entry in run.metrics["overall"].items()}
    best = min((name for name in error if name != OWN), key=lambda name: error[name]["median"])
    own, receivers, n_test = error[OWN], run.metrics["n_receivers"], run.metrics["n_test"]
    return [
        f"Positions are found within {own['median']:.2f} m (median error; 90 % within {own['p90']:.1f} m).",
        f"The median's 95 % interval is {own['low']:.2f} to {own['high']:.2f} m, and "
        f"{run.metrics['calibration'][str(LEVEL)]:.0%} of the true positions lie in the {LEVEL:.0%} region that comes with "
        f"each estimate. Tested on {n_test} rows, fitted to {run.metrics['n_train']} rows at {receivers} "
        f"{'receiver' if receivers == 1 else 'receivers'}; {run.scene}.",
        comparison_sentence(by_method(run), OWN, best, name="the posterior", unit="m", rows="rows", n_test=n_test),
    ]


def _steps(run: LocateRecords) -> list[NextStep]:
    own, coverage = [], run.metrics["calibration"][str(LEVEL)]
    if warning := coverage_warning("credible regions", coverage, LEVEL, run.metrics["n_test"]):
        own.append(NextStep(warning))
    if run.metrics["split"] == "random":
        own.append(again(run, "Test a region where nothing was measured", "block"))
    return next_steps(run, "Explore posteriors and maps", "Locate new observations", "SOURCE", own)


def by_method(run: LocateRecords) -> DataFrame:
    """Return the position errors, one row for each test row and one column for each localizer."""
    errors: DataFrame = run.table("errors").pivot_table(
        index=["index", "place"], columns="method", values="position_error_m"
    )
    return errors
