"""What it cost: speed against error, sizes tried, losses over the steps, seconds."""

from __future__ import annotations

from pandas import DataFrame, concat

from augment import SYNTHESIZERS
from swiftwrf.models.swiftwrf.fit import MIN_GAIN
from tasks.aoa import arms
from tasks.aoa.estimators import ESTIMATORS
from tasks.aoa.share import AoaRecords, Share, first_history, fits
from tasks.page import figures
from tasks.page.page import Plot, Section, Table
from tasks.page.provenance import number
from tasks.summarise import SHORTEST, rms_of_psnr


def speed_section(share: Share) -> Section:
    """What each synthesizer and estimator takes against how wrong it is."""
    synthesis = {name: scores for name, scores in share.mix["synthesis"].items() if name in SYNTHESIZERS}
    methods = {n: a for n, a in share.mix["methods"].items() if arms.is_network(n) or n in ESTIMATORS}
    error = {name: rms_of_psnr(scores["psnr_db"]["median"]) for name, scores in synthesis.items()}
    fit = {name: max(scores["seconds"]["fit"], SHORTEST) for name, scores in synthesis.items()}
    draw = {name: max(scores["seconds"]["synthesize"], SHORTEST) for name, scores in synthesis.items()}
    estimators = {
        name: (max(arm["seconds"]["train"] + arm["seconds"]["estimate"], SHORTEST), arm["great_circle_deg"]["median"])
        for name, arm in methods.items()
    }
    palette = arms.palette()
    figure, axes = figures.new_figure(1, 3, 12, 4.2)
    for ax, stage, seconds in zip(axes, ("fit", "synthesize"), (fit, draw), strict=False):
        points = {name: (seconds[name], error[name]) for name in synthesis}
        figures.speed(ax, palette, points, f"seconds to {stage}", "RMS error of a spectrum", also=["swiftwrf"])
    figures.speed(axes[2], palette, estimators, "seconds to train and estimate", "median great-circle error [deg]")
    caption = (
        "Left and middle: synthesizers, seconds to fit and to draw the test spectra. Right: estimators, "
        "the synthesizer's time not counted. The line is the Pareto front: what is not on it is beaten in both."
    )
    figures.legend_of(figure, palette, [*synthesis, *methods])
    data = concat(
        [
            DataFrame({"name": name, "stage": stage, "seconds": seconds[name], "rms_error": error[name]}, index=[0])
            for stage, seconds in (("fit", fit), ("synthesize", draw))
            for name in synthesis
        ]
        + [
            DataFrame({"name": name, "stage": "train and estimate", "seconds": cost, "error_deg": wrong}, index=[0])
            for name, (cost, wrong) in estimators.items()
        ]
    )
    plot = Plot(f"speed-{share.file_name}", figure, caption, data)
    return Section(f"Speed against error ({share.title})", plots=[plot])


def sizes(runs: list[AoaRecords]) -> list[Plot]:
    """Quality against size: what the fit of SwiftWRF tried, and what it took."""
    plots = []
    for run in runs:
        search, final = fits(run)
        if not len(search):
            continue
        figure, axes = figures.new_figure(1, 1, 6, 3)
        by_size = search.sort_values("n_primitives")
        axes[0].plot(by_size["n_primitives"], by_size["validation"], "o-", markersize=4)
        n = int(final["n_primitives"].iloc[0])
        axes[0].axvline(n, color=figures.RULE, linewidth=1)
        axes[0].set_xscale("log", base=2)
        axes[0].xaxis.set_major_formatter("{x:g}")
        axes[0].set(xlabel="primitives", ylabel="loss on held-out spectra")
        caption = (
            f"First share of {run.scene}. Loss on measured spectra that each size did not see, at coarse resolution; the "
            f"model took the smallest within {MIN_GAIN:.1%} of the best: {n} primitives (line)."
        )
        data = by_size[["n_primitives", "validation"]]
        plots.append(Plot(f"size-{Share.of(run)[0].file_name}", figure, caption, data))
    return plots


def trainings(runs: list[AoaRecords]) -> list[Plot]:
    """Loss of what was trained by steps."""
    plots = []
    for run in runs:
        history = first_history(run)
        by_arm = history.groupby("method", sort=False) if "method" in history else ()
        networks = {str(name): (part["step"], part["loss"]) for name, part in by_arm}
        # fits by gradient; others have no steps
        descents = history[(history["stage"] == "final") & (history["steps"] > 0)] if "steps" in history else None
        by_fit = () if descents is None else descents.groupby("synthesizer", sort=False)
        fitted = {str(name): (part["step"], part["loss"] / part["loss"].iloc[0]) for name, part in by_fit}
        panels = {"loss of the network": networks, "loss of the synthesizer, over its first": fitted}
        panels = {label: lines for label, lines in panels.items() if lines}
        figure, axes = figures.new_figure(1, max(len(panels), 1), 6 * max(len(panels), 1), 3.2)
        for ax, (label, lines) in zip(axes, panels.items(), strict=False):
            figures.curves(ax, arms.palette(), lines, "step", label)
        caption = f"First share and repeat of {run.scene}: the networks, and synthesizers that are fitted by gradient."
        curves = {f"network, {name}": line for name, line in networks.items()}
        curves |= {f"synthesizer, {name}": line for name, line in fitted.items()}
        parts = [DataFrame({"what": what, "step": steps, "loss": loss}) for what, (steps, loss) in curves.items()]
        data = concat(parts) if parts else DataFrame(columns=["what", "step", "loss"])
        plots.append(Plot(f"training-{Share.of(run)[0].file_name}", figure, caption, data))
    return plots


def time_section(shares: list[Share], several: bool) -> Section:
    """Seconds by share and stage."""
    rows = []
    for share in shares:
        seconds = share.mix["seconds"]
        cells = (number(value, 1) for value in (seconds["fit"], seconds["synthesize"], seconds["train"]))
        rows.append([share.percent + (f", {share.run.scene}" if several else ""), *cells])
    caption = "Seconds on the machine named below; train: the networks of all arms together."
    return Section("Where the time went", tables=[Table(["share", "fit", "synthesize", "train"], rows, caption)])
