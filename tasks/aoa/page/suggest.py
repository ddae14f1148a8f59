"""The report's section on where to measure next."""

from __future__ import annotations

from pandas import DataFrame

from tasks.aoa.share import Share
from tasks.page import figures
from tasks.page.page import Plot, Section

MEASURED, SUGGESTED = "#4477aa", "#cc3311"
NUMBERED = 30  # suggestions whose rank is written beside them; more would hide each other


def suggestion_section(share: Share) -> Section | None:
    """A plan of the suggested positions, and what measuring there is expected to bring; None where none were asked for."""
    name = f"suggested-mix{share.key}"
    if not share.run.holds(name):
        return None
    measured, suggested, left = (share.run.arrays(name)[key] for key in ("measured", "suggested", "left"))
    figure, (plan, gain) = figures.new_figure(1, 2, 11, 4.2)
    plan.plot(*measured[:, :2].T, ".", color=MEASURED, markersize=3, label="measured")
    plan.plot(*suggested[:, :2].T, "o", color=SUGGESTED, markersize=4, label="to measure next")
    for rank, (x, y) in enumerate(suggested[:NUMBERED, :2], start=1):
        plan.annotate(str(rank), (x, y), xytext=(3, 3), textcoords="offset points", fontsize=7)
    plan.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    figures.legend_below(figure, plan)
    gain.plot(range(len(left)), 100 * left, color=SUGGESTED)
    gain.set(xlabel="suggested positions measured", ylabel="variance left in the region [%]", ylim=(0, None))
    text = (
        f"Measuring at {len(suggested)} more positions (suggested-mix{share.key}.csv, the most telling first) would lower "
        f"the variance of spectra over the region from {left[0]:.0%} to {left[-1]:.0%} of what they vary by, as far as the "
        "Gaussian process between the measured positions can tell. Variance that hardly falls says that spectra change "
        "faster than so many positions can follow."
    )
    caption = "Left: in plan, numbered by rank. Right: expected variance over the region, averaged."
    title = f"Where to measure next ({share.title})"
    data = DataFrame(suggested, columns=["x_m", "y_m", "z_m"]).assign(variance_left=left[1:])
    return Section(title, [text], plots=[Plot(f"suggested-{share.file_name}", figure, caption, data)])
