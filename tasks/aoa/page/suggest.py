"""The report's section on where to measure next."""

from __future__ import annotations

from pandas import DataFrame

from tasks.aoa.page.records import FractionRecords
from tasks.page import figures
from tasks.page.page import Plot, Section

MEASURED, SUGGESTED = "#4477aa", "#cc3311"
MAX_NUMBERED = 30  # suggestions with their rank beside them; more would hide each other


def suggestion_section(fraction: FractionRecords) -> Section | None:
    """Return a plan of the suggested positions and the expected variance after measuring there; None without suggestions."""
    name = f"suggested-mix{fraction.key}"
    if not fraction.run.holds(name):
        return None
    measured, suggested, left = (fraction.run.arrays(name)[key] for key in ("measured", "suggested", "left"))
    figure, (plan, gain) = figures.new_figure(1, 2, 11, 4.2)
    plan.plot(*measured[:, :2].T, ".", color=MEASURED, markersize=3, label="measured")
    plan.plot(*suggested[:, :2].T, "o", color=SUGGESTED, markersize=4, label="to measure next")
    for rank, (x, y) in enumerate(suggested[:MAX_NUMBERED, :2], start=1):
        plan.annotate(str(rank), (x, y), xytext=(3, 3), textcoords="offset points", fontsize=7)
    plan.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    figures.legend_below(figure, plan)
    gain.plot(range(len(left)), 100 * left, color=SUGGESTED)
    gain.set(xlabel="suggested positions measured", ylabel="variance left in the region [%]", ylim=(0, None))
    text = (
        f"Measuring at {len(suggested)} more positions (suggested-mix{fraction.key}.csv, the most informative first) would "
        f"reduce the predictive variance over the region from {left[0]:.0%} to {left[-1]:.0%} of the variance of the "
        "spectra. The estimate is that of a Gaussian process on the measured spectra. If the variance hardly falls, spectra "
        "change faster than this number of positions can resolve."
    )
    caption = "Left: in plan, numbered by rank. Right: expected variance over the region, averaged."
    title = f"Where to measure next ({fraction.title})"
    data = DataFrame(suggested, columns=["x_m", "y_m", "z_m"]).assign(variance_left=left[1:])
    return Section(title, [text], plots=[Plot(f"suggested-{fraction.file_name}", figure, caption, data)])
