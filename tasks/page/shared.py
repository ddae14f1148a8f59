"""Parts of several reports: errors of methods, next steps, comparison of runs, positions to measure next."""

from __future__ import annotations

import math
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from pandas import DataFrame
from torch import Tensor

from swiftwrf.contrib.comparison.errors import ErrorSummary, paired_difference
from swiftwrf.runtime.durable import write_npz
from tasks.environment import command
from tasks.page import figures
from tasks.page.figures import MAX_CURVES, Colours
from tasks.page.page import Plot, Section, Summary, Table, number
from tasks.records import SUGGESTED, Records, write_table
from tasks.terminal import Answer, NextStep

MEASURED, NEXT = "#3a7fd5", "#cf4a4a"
MIN_REDUCTION = 0.1  # of the variance, below which more positions are not worth it
NOT_WORTH = "no further position is worth measuring for the coverage: its uncertainty would hardly fall"
MAX_NUMBERED = 30  # suggestions with their rank beside them; more would hide each other
MAX_COVERAGE_ERROR = 0.05  # difference from the nominal coverage below which intervals count as calibrated
MIN_RELEVANT = 0.02  # difference of mean errors, relative to them, below which methods are equal in practice
NONE = (np.nan, np.nan, np.nan)
INDEPENDENT = (
    "95 % intervals take test places as independent: all errors at one place count together. Neighbouring places along a "
    "path are not independent, so there the intervals are too narrow."
)


def errors_section(
    answer: Answer,
    errors: DataFrame,
    colours: Colours,
    *,
    name: str,
    quantity: str,
    caption: str,
    paragraphs: Sequence[str] = (),
    panels: Sequence[Figure] = (),
) -> Section:
    """Return the table of all methods, and figures of those of the short table.

    Args:
        answer: Errors of the methods.
        errors: Errors in long form: `method`, the error in the last column, and what identifies a test row in the others.
        colours: Colours of the methods.
        name: End of the name of the figure.
        quantity: Name of the errors.
        caption: What the cells beside the errors mean.
        paragraphs: Sentences before the table.
        panels: Errors against the number of measured positions, if they are known.
    """
    unit, short = answer.unit, [one for block in answer.short() for one in block]
    further = list(dict.fromkeys(column for one in answer.methods for column in one.cells))
    rows = [
        [
            one.name,
            with_interval(one.error),
            number(one.error["p90"]),
            *(one.cells.get(column, "") for column in further),
            " + ".join(number(seconds) for seconds in one.seconds),
        ]
        for one in answer.methods
    ]
    columns = ["method", f"median [{unit}]", f"90 % below [{unit}]", *further, "fit + apply [s]"]
    caption = (
        f"{quantity.capitalize()} on the test rows; medians with their 95 % intervals. Shaded: {answer.chosen}, which is "
        f"recommended. {caption}"
    ).strip()
    values = {"error": [interval(one.error) for one in short]}
    names = [one.name for one in short]
    dots = figures.dots(names, values, {"error": MEASURED}, f"median {quantity} [{unit}]", log=True)
    figure, axes = figures.panel(5.1, 3.2)
    groups = {one: errors[errors["method"] == one].iloc[:, -1] for one in [*dict.fromkeys([answer.chosen, *names])]}
    limit = max((float(part.quantile(0.9)) for part in groups.values() if len(part)), default=1.0)
    shown = dict(list(groups.items())[:MAX_CURVES])
    figures.cdf(axes, colours, shown, f"{quantity} [{unit}]", max(limit, 1e-3))
    cost, axes = figures.panel(5.1, 3.0 + 0.2 * len(short))
    points = {one.name: (sum(one.seconds), one.error["median"]) for one in short if one.error["n"]}
    figures.speed(axes, colours, points, "seconds to fit and apply", f"median {quantity} [{unit}]")
    text = (
        "Medians with 95 % intervals; the distribution of the errors, with a thin line at the median; the median against "
        f"the time that it takes{'; and the error against the number of measured positions' if panels else ''}."
    )
    plot = Plot(f"errors-{name}", [dots, figure, cost, *panels], text, errors)
    return Section("", list(paragraphs), [Table(columns, rows, caption, frozenset([answer.chosen]))], [plot])


def by_method(errors: DataFrame) -> DataFrame:
    """Return errors in long form, as in `errors_section`, with a row for each test row and a column for each method."""
    *rows, error = errors.columns.drop("method")
    found: DataFrame = errors.pivot_table(index=rows, columns="method", values=error)
    return found


def limits(run: Records, *texts: str) -> Section:
    """Return the section on what a report does not show, with a sentence about simulated data."""
    if run.metrics["data"].startswith("simulated-"):
        texts += (
            "These data are simulated. They show that the software works, and not how accurate it is on measurements.",
        )
    return Section("What this does not show", [*texts, INDEPENDENT])


def difference(errors: DataFrame, own: str, other: str) -> str:
    """Return the mean difference of the errors of two methods on the same rows, with its interval; empty for one method."""
    if own == other:
        return ""
    mean, low, high = paired_difference(errors, own, other)
    return f"{mean:+.2f}" + ("" if math.isnan(low) else f" [{low:+.2f}, {high:+.2f}]")


def next_steps(
    run: Records, explore: str, predict: str, source: str, own: Sequence[NextStep] = (), model: str = ""
) -> list[NextStep]:
    """Return what to do next with a run: explore it, predict a source by its model, and the steps of its task."""
    steps = [NextStep(explore, command("view", run.path))] if explore else []
    return [*steps, NextStep(predict, command("predict", model or run.path, source)), *own]


def again(run: Records, text: str, split: str) -> NextStep:
    """Return the step to repeat a run on another split, into a new directory."""
    words = shlex.split(run.config["command"])
    for option in ("--out", "--split"):
        if option in words:
            at = words.index(option)
            del words[at : at + 2]
    unwanted = ("--out=", "--split=", "--quiet", "--json", "--open")
    return NextStep(text, shlex.join([*(word for word in words if not word.startswith(unwanted)), "--split", split]))


def compared(
    answers: Mapping[str, Answer],
    runs: Sequence[Records],
    colours: Colours,
    quantity: str,
    steps: Sequence[NextStep] = (),
) -> Summary:
    """Return the first screen of several answers, by unique short names: the methods of their short tables, a column each.

    The next steps are by default a look at each run.
    """
    unit, names = next(iter(answers.values())).unit, list(answers)
    short = [{one.name: one.error for block in answer.short() for one in block} for answer in answers.values()]
    methods = list(
        dict.fromkeys([*(answer.chosen for answer in answers.values()), *(name for of in short for name in of)])
    )
    rows = [[name, *(with_interval(of[name]) if name in of else "" for of in short)] for name in methods]
    table = Table(["method", *names], rows, f"Median {quantity} [{unit}] with its 95 % interval.")
    values = {name: [interval(of[name]) if name in of else NONE for of in short] for name in methods[:MAX_CURVES]}
    figure = figures.dots(names, values, colours, f"median {quantity} [{unit}]", log=True)
    caption = f"Median {quantity} of each run; whiskers: 95 % intervals."
    plot = Plot("summary", [figure], caption, figures.dots_data("run", names, values, unit.lower()))
    explore = [NextStep(f"Explore run {run.number}", command("view", run.path)) for run in runs]
    sentences = [f"{name}: {answer.conclusion[0]}" for name, answer in answers.items()]
    return Summary([], [plot], sentences, steps or explore, table=table)


def interval(error: ErrorSummary) -> tuple[float, float, float]:
    """Return the median and its interval."""
    return error["median"], error["low"], error["high"]


def with_interval(error: Mapping[str, Any], digits: int = 2) -> str:
    """Return the median and its interval as text.

    Example:
        >>> with_interval({"median": 1.0, "low": 0.5, "high": 2.0})
        '1.00 [0.50, 2.00]'
    """
    median, low, high = (number(error[name], digits) for name in ("median", "low", "high"))
    return f"{median} [{low}, {high}]"


def write_suggestion(
    file: Path, measured: Tensor, position: Tensor, variance: Tensor, columns: Mapping[str, NDArray[Any]] | None = None
) -> None:
    """Write suggested positions as a table, with further columns, and as arrays for the report, in files of one name.

    The variance (1 + k,) is the relative one after measuring at 0 to k of the positions (k, 3) [m].
    """
    table = DataFrame(position.numpy(), columns=["x_m", "y_m", "z_m"]).assign(**(columns or {}))
    table = table.assign(variance_left=variance[1:].numpy())
    write_table(file.with_name(f"{file.name}.csv"), table.to_dict("records"))
    arrays = {"measured": measured, "suggested": position, "left": variance}
    write_npz(file.with_name(f"{file.name}.npz"), {name: values.numpy() for name, values in arrays.items()})


def maps_suggestion(run: Records, how: str) -> Section | None:
    """Return the plan of positions that lower the variance of the radio maps of a run, see `suggestion_section`."""
    return suggestion_section(
        "",
        run.arrays(SUGGESTED),
        SUGGESTED,
        run.file_name,
        what="the variance of the radio maps",
        whole="the field's variance",
        how=how,
        label="weighted variance left [%]",
    )


def suggestion_section(
    title: str,
    arrays: Mapping[str, NDArray[Any]],
    table: str,
    name: str,
    *,
    what: str,
    whole: str,
    how: str,
    label: str,
) -> Section | None:
    """Return a plan of suggested positions, from arrays of `write_suggestion`, and the variance after measuring there.

    The text names the table, what falls, the whole that it is a fraction of, and how it is estimated. The axis of the
    variance [%] has the label.
    """
    if not arrays:
        return None
    measured, suggested, left = (arrays[key] for key in ("measured", "suggested", "left"))
    first, plan = figures.panel(5, 4.2)
    plan.plot(*measured[:, :2].T, ".", color=MEASURED, markersize=3, label="measured")
    plan.plot(*suggested[:, :2].T, "D", color=NEXT, markersize=4, label="to measure next")
    for rank, (x, y) in enumerate(suggested[:MAX_NUMBERED, :2], start=1):
        plan.annotate(str(rank), (x, y), xytext=(3, 3), textcoords="offset points", fontsize=7)
    plan.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    figures.legend_below(plan)
    second, gain = figures.panel(4.6, 3.4)
    gain.plot(range(len(left)), 100 * left, color=NEXT)
    gain.set(xlabel="suggested positions measured", ylabel=label, ylim=(0, None))
    text = (
        f"Measuring at {len(suggested)} more positions ({table}.csv, the most useful first) would reduce {what} from "
        f"{left[0]:.0%} to {left[-1]:.0%} of {whole}. {how} {worth(left)}"
    )
    caption = "Suggested positions in plan, numbered by rank, and the expected variance over the region, averaged."
    data = DataFrame(suggested, columns=["x_m", "y_m", "z_m"]).assign(variance_left=left[1:])
    return Section(title, [text], plots=[Plot(f"suggested-{name}", [first, second], caption, data)])


def is_worth(left: NDArray[Any]) -> bool:
    """Return whether the relative variance after 0 to k suggested positions, (1 + k,), falls by a tenth or more."""
    return bool(len(left) > 1 and left[-1] <= (1 - MIN_REDUCTION) * left[0])


def suggestions(position: NDArray[Any], left: NDArray[Any], most: int = 10) -> str:
    """Return the first suggested positions (k, 3) [m] as lines of text, with the relative variance after each.

    Example:
        >>> import numpy as np
        >>> print(suggestions(np.array([[1.0, 2.0, 1.5]]), np.array([0.2, 0.15])))
        where to measure next
        rank   x [m]   y [m]   z [m]  variance left
           1    1.00    2.00    1.50          75.0%
    """
    rows = zip(range(1, most + 1), position, left[1:] / left[0], strict=False)
    lines = [f"{rank:4d}{''.join(f'{x:8.2f}' for x in at)}{share:15.1%}" for rank, at, share in rows]
    more = [f"and {len(position) - most} more"] if len(position) > most else []
    return "\n".join(["where to measure next", "rank   x [m]   y [m]   z [m]  variance left", *lines, *more])


def worth(left: NDArray[Any]) -> str:
    """Return whether suggested positions are worth measuring, by the relative variance after 0 to k of them, (1 + k,).

    Example:
        >>> import numpy as np
        >>> worth(np.array([0.11, 0.105]))
        'This is not worth it: the variance hardly falls.'
    """
    if not is_worth(left):
        return "This is not worth it: the variance hardly falls."
    return "This is worth it where the variance falls most: begin with the first positions."


def comparison_sentence(errors: DataFrame, method: str, other: str, *, name: str, unit: str, rows: str) -> str:
    """Return one sentence that compares the mean errors of a method, under its name there, with those of another one.

    The errors are those of `by_method`; their rows have a word, e.g. pairs.
    """
    mean, low, high = paired_difference(errors, method, other)
    if math.isnan(low):
        n_places = errors.index.get_level_values("place").nunique()
        return f"{n_places} test places are too few to compare {name} with {other}."
    interval = f"{mean:+.2f} {unit} (95 % interval {low:+.2f} to {high:+.2f})"
    if max(abs(low), abs(high)) < MIN_RELEVANT * float(errors[other].mean()):
        return f"On the same {rows} {name} and {other} are equal in practice: mean errors differ by {interval}."
    if high < 0:
        return f"On the same {rows} {name}'s mean error is lower than that of {other}: {interval}."
    if low > 0:
        return (
            f"On the same {rows} {other} has the lower mean error: {name}'s differs by {interval}. {other} is the best of "
            "several on these rows, which favours it."
        )
    return f"On the same {rows} the errors of {name} and {other} do not differ significantly: {interval}."


def recommendation(run: Records, model: str, unit: str) -> tuple[str, list[str]]:
    """Return the model of a run, or `mean` with a sentence if that has the smaller mean error at held-out training rows."""
    held_out: Mapping[str, float] = run.metrics["held_out"]
    chosen = min(held_out, key=lambda name: held_out[name], default=model)
    if chosen == model:
        return model, []
    return chosen, [
        f"Recommended is {chosen} and not {model}: its mean error at held-out training rows is {held_out[chosen]:.2f} "
        f"{unit}, that of {model} {held_out[model]:.2f} {unit}. These rows do not show how measurements depend on the place."
    ]


def coverage_warning(name: str, coverage: float, nominal: float, n_places: int) -> str:
    """Return a warning if intervals or regions cover significantly more or less than they should, else nothing.

    Their name is in the plural. Test places are independent, rows of one place are not.

    Example:
        >>> coverage_warning("intervals", 0.87, 0.8, n_places=100)
        ''
        >>> coverage_warning("intervals", 0.6, 0.8, n_places=100)
        'The 80 % intervals contain 60 % of the test values: they are too narrow here.'
    """
    two_deviations = 2 * math.sqrt(nominal * (1 - nominal) / n_places)
    if abs(coverage - nominal) <= max(MAX_COVERAGE_ERROR, two_deviations):
        return ""
    size = "narrow" if coverage < nominal else "wide"
    return (
        f"The {100 * nominal:.0f} % {name} contain {100 * coverage:.0f} % of the test values: they are too {size} here."
    )
