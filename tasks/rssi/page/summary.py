"""The answer of an RSSI run: errors of all methods, the conclusion, the next steps."""

from __future__ import annotations

import numpy as np
from pandas import DataFrame

from tasks.answer import Answer, Method, NextStep
from tasks.page.page import number
from tasks.page.shared import again, difference, next_steps
from tasks.rssi.page.maps import CERTAINTY, COVERED_DBM, MIN_RATIO, Maps, RssiRecords
from tasks.summarise import comparison_sentence, coverage_warning

REFERENCES = ("mean", "mri_pooled")  # which explain no place
WIDTH_OF_80_PERCENT = 2.563  # of an interval, in standard deviations of a normal distribution
MIN_REPEATS = 10  # of measurements at one place
MAX_RATIO_TO_SCATTER = 1.3  # of an interval to the one of repeated measurements, which then explain it


def answer(run: RssiRecords) -> Answer:
    """Return the answer of a run."""
    own, errors, methods = model_of(run), by_method(run), []
    scored = any(entry.get("detection") for entry in run.metrics["overall"].values())
    for name, entry in run.metrics["overall"].items():
        detection = entry.get("detection")
        cells = {f"{own} minus it [dB]": difference(errors, own, name)}
        cells |= {"detection": number(None if detection is None else sum(detection) / 2)} if scored else {}
        seconds = entry["seconds"]["fit"], entry["seconds"]["predict"]
        methods.append(Method(name, entry["abs_error_db"], name in REFERENCES and name != own, seconds, cells))
    return Answer("dB", methods, own, conclusion(run), steps(run), (best_baseline(run),))


def model_of(run: RssiRecords) -> str:
    """Return the predictor that all others are compared with, whose maps and intervals the run contains."""
    return run.metrics["model"]


def best_baseline(run: RssiRecords) -> str:
    """Return the name of the baseline with the lowest median error."""
    own = model_of(run)
    error = {name: entry["abs_error_db"]["median"] for name, entry in run.metrics["overall"].items() if name != own}
    return min(error, key=lambda name: error[name])


def conclusion(run: RssiRecords) -> list[str]:
    """Return coverage and error, how sure they are, and how the model compares with the best baseline."""
    best, n_test, interval = best_baseline(run), run.metrics["n_test"], run.metrics["interval"]
    own, floors, names = model_of(run), Maps.of_floors(run), list(run.metrics["receivers"])
    who = f"one of {len(names)} receivers" if len(names) > 1 else names[0]
    covered = [f"{maps.covered:.0%} of {maps.place}" for maps in floors]
    error = run.metrics["overall"][own]["abs_error_db"]
    sure = (
        f"90 % of the errors are below {error['p90']:.1f} dB, and {interval['coverage']:.0%} of the measurements lie in "
        f"their {interval['nominal']:.0%} intervals. Tested on {error['n']} measurements, fitted to "
        f"{run.metrics['n_train']} rows ({run.scene})."
    )
    compared = comparison_sentence(by_method(run), own, best, name=own, unit="dB", rows="pairs", n_test=n_test)
    return [
        f"{', '.join(covered)} {'has' if len(covered) == 1 else 'have'} {who} above {COVERED_DBM:g} dBm with "
        f"{CERTAINTY:.0%} certainty; predictions are within {error['median']:.1f} dB (median error).",
        sure,
        compared,
    ]


def steps(run: RssiRecords) -> list[NextStep]:
    """Return what to do next."""
    interval = run.metrics["interval"]
    pairs = model_of(run) == "pairs"  # its maps depend on both ends, and the page shows one
    own = [NextStep(where_next(run))]
    if unknown := int(np.isnan(run.arrays("maps")["receiver"]).any(axis=1).sum()):
        text = (
            f"Give the positions of the {unknown} access points that are unknown, in `receivers.csv` beside the table"
        )
        own.insert(0, NextStep(text, "receiver,x,y,z"))
    # the receivers of a row are not independent
    n_test = min(run.metrics["n_test"], run.metrics["overall"][model_of(run)]["abs_error_db"]["n"])
    if warning := coverage_warning("intervals", interval["coverage"], interval["nominal"], n_test):
        own.append(NextStep(warning))
    if pairs and run.metrics["split"] != "place":
        own.append(again(run, "Test receivers at positions where they measured nothing", "place"))
    elif run.metrics["split"] == "random":
        own.append(again(run, "Test a region where nothing was measured", "block"))
    explore = "" if pairs else "Explore maps and coverage"
    return next_steps(run, explore, "Predict at other positions, with intervals", "positions.csv", own)


def where_next(run: RssiRecords) -> str:
    """Return where to measure next, inside the measured positions, or that more positions hardly help."""
    most = int(np.bincount(run.arrays("maps")["floor_of_row"]).argmax())
    maps, known = Maps(run, most).arrays, Maps(run, most).inside
    width = maps["width"].mean(axis=0)
    if not known.any():
        return "Measure in a second dimension: the measured positions lie on a line."
    typical = float(np.median(width[known]))
    row, column = np.unravel_index(np.argmax(np.where(known, width, -np.inf)), width.shape)
    if width[row, column] < MIN_RATIO * typical:
        scatter = scatter_of_repeats(run)
        reason = "and the model explains no more"
        if scatter is not None and typical < MAX_RATIO_TO_SCATTER * scatter:
            reason = "which is the scatter of repeated measurements at one place"
        elif scatter is not None:
            reason += f", though repeated measurements at one place lie within {scatter:.0f} dB"
        return (
            f"More positions inside the measured area are not worth it: the 80 % interval is about {typical:.0f} dB wide "
            f"everywhere in it, {reason}."
        )
    return (
        f"Measure around x = {maps['x'][column]:.1f} m, y = {maps['y'][row]:.1f} m: inside the measured area the 80 % "
        f"interval is widest there, {width[row, column]:.0f} dB instead of {typical:.0f} dB."
    )


def scatter_of_repeats(run: RssiRecords) -> float | None:
    """Return the width of the 80 % interval of repeated measurements at one place [dB], None if there are too few."""
    same = run.table("predictions").groupby(["x", "y", "z", "receiver"])["measured"]
    repeats = same.count() - 1
    n = int(repeats.clip(lower=0).sum())
    return float(WIDTH_OF_80_PERCENT * np.sqrt((same.var() * repeats).sum() / n)) if n >= MIN_REPEATS else None


def by_method(run: RssiRecords) -> DataFrame:
    """Return the absolute errors, one row for each pair and one column for each method."""
    errors: DataFrame = run.table("errors").pivot_table(
        index=["index", "receiver"], columns="method", values="abs_error_db"
    )
    return errors
