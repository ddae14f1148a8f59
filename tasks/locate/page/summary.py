"""The summary of a report: three numbers, a picture, their meaning and the next steps."""

from __future__ import annotations

from pandas import DataFrame

from tasks.environment import command
from tasks.metrics import LocateMetrics
from tasks.page.page import Number, Plot, Summary
from tasks.page.records import Records, notes
from tasks.summarise import comparison_sentence, coverage_warning
from tasks.terminal import Answer

LocateRecords = Records[LocateMetrics]
OWN = "posterior"  # the localizer that all others are compared with
NEIGHBOURS = ("knn", "knn_difference")
LEVEL = 0.8  # probability of the credible regions in the summary


def summary(run: LocateRecords, picture: Plot) -> Summary:
    """Return the summary of one run."""
    error = {name: entry["position_error_m"] for name, entry in run.metrics["overall"].items()}
    own, nearest = error[OWN], min(NEIGHBOURS, key=lambda name: error[name]["median"])
    best = error[nearest]
    numbers = [
        Number(
            f"{own['median']:.2f} m",
            f"the posterior's median position error, 95 % interval [{own['low']:.2f}, {own['high']:.2f}]; 90 % of the "
            f"errors are below {own['p90']:.1f} m",
        ),
        Number(
            f"{best['median']:.2f} m",
            f"the best nearest-neighbour fingerprinting, {nearest}, 95 % interval [{best['low']:.2f}, {best['high']:.2f}]; "
            f"90 % are below {best['p90']:.1f} m",
        ),
        Number(
            f"{run.metrics['calibration'][str(LEVEL)]:.0%}",
            f"of the true positions lie in the {LEVEL:.0%} credible region that comes with each estimate",
        ),
    ]
    receivers = run.metrics["n_receivers"]
    meaning = [
        f"On {run.scene}: {run.metrics['n_train']} training rows and {run.metrics['n_test']} test rows at {receivers} "
        f"{'receiver' if receivers == 1 else 'receivers'}.",
    ]
    return Summary(numbers, [picture], meaning, _next_steps(run), conclusion(run), notes=notes(run))


def answer(run: LocateRecords) -> Answer:
    """Return what the terminal shows of a run."""
    overall = sorted(run.metrics["overall"].items(), key=lambda item: item[1]["position_error_m"]["median"])
    rows = [({"localizer": name}, entry["position_error_m"]) for name, entry in overall]
    return Answer("m", rows, conclusion(run), _next_steps(run))


def conclusion(run: LocateRecords) -> str:
    """Return a sentence that compares the posterior with the best other localizer."""
    error = {name: entry["position_error_m"]["median"] for name, entry in run.metrics["overall"].items() if name != OWN}
    best = min(error, key=lambda name: error[name])
    n_test = run.metrics["n_test"]
    return comparison_sentence(by_method(run), OWN, best, name="the posterior", unit="m", rows="rows", n_test=n_test)


def _next_steps(run: LocateRecords) -> list[str]:
    steps = [
        f"Explore posteriors and maps: `{command('view', run.path)}`.",
        f"Locate new observations: `{command('predict', run.path, 'SOURCE')}`.",
    ]
    coverage = run.metrics["calibration"][str(LEVEL)]
    if warning := coverage_warning("credible regions", coverage, LEVEL, run.metrics["n_test"]):
        steps.append(warning)
    if run.metrics["split"] == "random":
        steps.append("Run `--split block`: it shows the error in a region where nothing was measured.")
    return steps


def by_method(run: LocateRecords) -> DataFrame:
    """Return the position errors, one row for each test row and one column for each localizer."""
    errors: DataFrame = run.table("errors").pivot_table(
        index=["index", "place"], columns="method", values="position_error_m"
    )
    return errors
