"""Sentences of the RSSI report and of the terminal: the conclusion and the next steps."""

from __future__ import annotations

import numpy as np
from pandas import DataFrame

from tasks.environment import command
from tasks.rssi.page.maps import CERTAINTY, COVERED_DBM, Maps, RssiRecords
from tasks.summarise import comparison_sentence, coverage_warning
from tasks.terminal import Answer

WIDTH_OF_80_PERCENT = 2.563  # of an interval, in standard deviations of a normal distribution
MIN_REPEATS = 10  # of measurements at one place
MAX_RATIO_TO_SCATTER = 1.3  # of an interval to the one of repeated measurements, which then explain it
MIN_RATIO = 1.2  # of the widest interval inside to the median one, for which more positions are proposed


def answer(run: RssiRecords) -> Answer:
    """Return what the terminal shows of a run."""
    overall = sorted(run.metrics["overall"].items(), key=lambda item: item[1]["abs_error_db"]["median"])
    rows = [({"model": name}, entry["abs_error_db"]) for name, entry in overall]
    return Answer("dB", rows, conclusion(run), next_steps(run))


def model_of(run: RssiRecords) -> str:
    """Return the predictor that all others are compared with, whose maps and intervals the run contains."""
    return run.metrics["model"]


def title(run: RssiRecords) -> str:
    """Return the name of that predictor in sentences."""
    return {"swiftwrf": "SwiftWRF"}.get(model_of(run), model_of(run))


def best_baseline(run: RssiRecords) -> str:
    """Return the name of the baseline with the lowest median error."""
    own = model_of(run)
    error = {name: entry["abs_error_db"]["median"] for name, entry in run.metrics["overall"].items() if name != own}
    return min(error, key=lambda name: error[name])


def conclusion(run: RssiRecords) -> str:
    """Return coverage, error and intervals of the model, and how it compares with the best baseline."""
    best, n_test, interval = best_baseline(run), run.metrics["n_test"], run.metrics["interval"]
    own, name, floors = model_of(run), title(run), Maps.of_floors(run)
    who = "a receiver" if len(run.metrics["receivers"]) > 1 else "the receiver"
    covered = [f"{maps.covered:.0%} of {maps.place}" for maps in floors]
    error = run.metrics["overall"][own]["abs_error_db"]["median"]
    compared = comparison_sentence(by_method(run), own, best, name=name, unit="dB", rows="pairs", n_test=n_test)
    return (
        f"{', '.join(covered)} {'has' if len(covered) == 1 else 'have'} {who} above {COVERED_DBM:g} dBm with "
        f"{CERTAINTY:.0%} certainty. Half of the errors at new positions are below {error:.1f} dB, and "
        f"{interval['coverage']:.0%} of the measurements lie in their {interval['nominal']:.0%} intervals. {compared}"
    )


def next_steps(run: RssiRecords) -> list[str]:
    """Return what to do next, a sentence each."""
    interval = run.metrics["interval"]
    pairs = model_of(run) == "pairs"  # its maps depend on both ends, and the page shows one
    steps = [] if pairs else [f"Explore maps and coverage: `{command('view', run.path)}`."]
    if unknown := int(np.isnan(run.arrays("maps")["receiver"]).any(axis=1).sum()):
        steps.insert(
            0,
            "Give the positions of the access points in `receivers.csv` (columns receiver, x, y, z) beside the table: "
            f"{unknown} are unknown, so that the distance from them explains nothing.",
        )
    steps.append(where_next(run))
    steps.append(
        f"Predict anywhere: `swiftwrf.load({f'{run.path}/model.safetensors'!r}).predict(positions)`, with intervals."
    )
    # the receivers of a row are not independent
    n_test = min(run.metrics["n_test"], run.metrics["overall"][model_of(run)]["abs_error_db"]["n"])
    if warning := coverage_warning("intervals", interval["coverage"], interval["nominal"], n_test):
        steps.append(warning)
    if pairs and run.metrics["split"] != "place":
        steps.append("Run `--split place`: it shows the error of a receiver at positions where it measured nothing.")
    elif run.metrics["split"] == "random":
        steps.append("Run `--split block`: it shows the error in a region where nothing was measured.")
    return steps


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
