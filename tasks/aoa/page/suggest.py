"""The report's section on where to measure next."""

from __future__ import annotations

from tasks.aoa.page.records import FractionRecords
from tasks.page.page import Section
from tasks.page.suggestion import suggestion_plot, worth


def suggestion_section(fraction: FractionRecords) -> Section | None:
    """Return a plan of the suggested positions and the expected variance after measuring there; None without suggestions."""
    name = f"suggested-mix{fraction.key}"
    if not fraction.run.holds(name):
        return None
    arrays = fraction.run.arrays(name)
    suggested, left = arrays["suggested"], arrays["left"]
    text = (
        f"Measuring at {len(suggested)} more positions (suggested-mix{fraction.key}.csv, the most informative first) would "
        f"reduce the predictive variance over the region from {left[0]:.0%} to {left[-1]:.0%} of the variance of the "
        "spectra. The estimate is that of a Gaussian process on the measured spectra. "
        f"{worth(left)}"
    )
    plot = suggestion_plot(f"suggested-{fraction.file_name}", arrays, "variance left in the region [%]")
    return Section("Where to measure next", [text], plots=[plot])
