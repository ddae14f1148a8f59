"""Cost of a run: speed against error, sizes tried, losses over the steps, seconds."""

from __future__ import annotations

from pandas import DataFrame, concat

from swiftwrf.models import FIELD_MODELS
from swiftwrf.models.swiftwrf import MIN_GAIN
from tasks.aoa.page.overview import essential
from tasks.aoa.page.records import AoaRecords, FractionRecords, first_history, fits
from tasks.page import figures
from tasks.page.figures import MAX_CURVES
from tasks.page.page import Plot, Section, Table, number
from tasks.summarise import SHORTEST, rms_of_psnr


def speed_section(fraction: FractionRecords) -> Section:
    """Return the time of each field model and of each estimator against its error."""
    return Section("", plots=[_synthesizer_speed(fraction), _estimator_speed(fraction)])


def _synthesizer_speed(fraction: FractionRecords) -> Plot:
    synthesis = {name: scores for name, scores in fraction.mix["synthesis"].items() if name in FIELD_MODELS}
    points = {
        stage: {
            name: (max(scores["seconds"][stage], SHORTEST), rms_of_psnr(scores["psnr_db"]["median"]))
            for name, scores in synthesis.items()
        }
        for stage in ("fit", "synthesize")
    }
    caption = "Synthesizers: seconds to fit and to predict the test spectra. The line is the Pareto front."
    return _speed(f"speed-{fraction.file_name}", fraction, points, "RMS error of a spectrum", caption)


def _estimator_speed(fraction: FractionRecords) -> Plot:
    """Return the figure of the essential methods."""
    methods = {name: fraction.mix["methods"][name] for name in essential(fraction)}
    count = {"train": 1, "estimate a spectrum": fraction.run.metrics["n_test"]}
    points = {
        stage: {
            name: (
                max(method["seconds"][stage.partition(" ")[0]] / n, SHORTEST),
                method["great_circle_deg"]["median"],
            )
            for name, method in methods.items()
        }
        for stage, n in count.items()
    }
    caption = (
        "Estimators: seconds to train, without the synthesizer's time, and to estimate the direction of one spectrum. The "
        "line is the Pareto front."
    )
    return _speed(f"estimators-{fraction.file_name}", fraction, points, "median angular error [deg]", caption)


def _speed(
    name: str,
    fraction: FractionRecords,
    points: dict[str, dict[str, tuple[float, float]]],
    error: str,
    caption: str,
) -> Plot:
    """Return a figure of seconds against error, one panel for each stage."""
    panels = []
    for stage, of_stage in points.items():
        figure, ax = figures.panel(5, 3.6)
        figures.speed(ax, fraction.palette, of_stage, f"seconds to {stage}", error, also=[*of_stage])
        panels.append(figure)
    rows = [(method, stage, *point) for stage, of_stage in points.items() for method, point in of_stage.items()]
    return Plot(name, panels, caption, DataFrame(rows, columns=["name", "stage", "seconds", "error"]))


def sizes(runs: list[AoaRecords]) -> list[Plot]:
    """Return plots of the held-out loss against the number of primitives that the fits of SwiftWRF tried."""
    plots = []
    for run in runs:
        search, final = fits(run)
        if not len(search):
            continue
        figure, ax = figures.panel(5, 3)
        by_size = search.sort_values("n_primitives")
        ax.plot(by_size["n_primitives"], by_size["validation"], "o-", markersize=4)
        n = int(final["n_primitives"].iloc[0])
        ax.axvline(n, color=figures.RULE, linewidth=1)
        ax.set_xscale("log", base=2)
        ax.xaxis.set_major_formatter("{x:g}")
        ax.set(xlabel="primitives", ylabel="loss on held-out spectra")
        caption = (
            f"First measured fraction of {run.scene}. Loss on held-out measured spectra at coarse resolution. The model has "
            f"the smallest number within {MIN_GAIN:.1%} of the best: {n} primitives (line)."
        )
        data = by_size[["n_primitives", "validation"]]
        plots.append(Plot(f"size-{FractionRecords.of(run)[0].file_name}", [figure], caption, data))
    return plots


def trainings(runs: list[AoaRecords]) -> list[Plot]:
    """Return plots of the loss of networks, and of field models that are fitted by gradient."""
    plots = []
    for run in runs:
        history = first_history(run)
        palette = FractionRecords.of(run)[0].palette
        by_method = history.groupby("method", sort=False) if "method" in history else ()
        networks = {str(name): (part["step"], part["loss"]) for name, part in by_method}
        # fits by gradient; others have no steps
        descents = history[(history["stage"] == "final") & (history["steps"] > 0)] if "steps" in history else None
        by_fit = () if descents is None else descents.groupby("synthesizer", sort=False)
        fitted = {str(name): (part["step"], part["loss"] / part["loss"].iloc[0]) for name, part in by_fit}
        panels = {"loss of the network": networks, "loss of the field model, over its first": fitted}
        drawn = []
        for label, lines in panels.items():
            for start in range(0, len(lines), MAX_CURVES):
                names = list(lines)[start : start + MAX_CURVES]
                figure, ax = figures.panel(5.4, 3.2)
                ax.set_yscale("log")
                figures.curves(ax, palette, {name: lines[name] for name in names}, "step", label)
                drawn.append(figure)
        if not drawn:
            continue
        caption = f"First measured fraction and repeat of {run.scene}: networks, and synthesizers fitted by gradient."
        curves = {f"network, {name}": line for name, line in networks.items()}
        curves |= {f"synthesizer, {name}": line for name, line in fitted.items()}
        parts = [DataFrame({"what": what, "step": steps, "loss": loss}) for what, (steps, loss) in curves.items()]
        plots.append(Plot(f"training-{FractionRecords.of(run)[0].file_name}", drawn, caption, concat(parts)))
    return plots


def time_section(fractions: list[FractionRecords]) -> Section:
    """Return the seconds by measured fraction and stage."""
    rows = []
    for fraction in fractions:
        seconds = fraction.mix["seconds"]
        cells = (number(value, 1) for value in (seconds["fit"], seconds["synthesize"], seconds["train"]))
        rows.append([fraction.scene, *cells])
    caption = "Seconds on the machine named below; train: all networks together."
    return Section("Where the time went", tables=[Table(["fraction", "fit", "synthesize", "train"], rows, caption)])
