"""The report of angle-of-arrival runs, one or several."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from pandas import DataFrame, concat

from augment import SYNTHESIZERS
from tasks.aoa import arms
from tasks.aoa.estimators import ESTIMATORS, learners
from tasks.aoa.page_field import field_section
from tasks.aoa.page_room import choice_section, room_section
from tasks.aoa.page_suggest import suggestion_section
from tasks.aoa.page_summary import summary
from tasks.aoa.share import AoaRecords, Share, first_history, fits
from tasks.metrics import Angle, ErrorSummary
from tasks.page import figures
from tasks.page.page import Page, Plot, Section, Table
from tasks.page.provenance import number, provenance
from tasks.summarise import SHORTEST, rms_of_psnr

ERRORS: dict[Angle, str] = {
    "azimuth_deg": "azimuth",
    "elevation_deg": "elevation",
    "great_circle_deg": "great circle",
}
# median elevation and azimuth errors in degrees by measured share (paper, table of the AoA case study)
PAPER = {"0.1": (0.592, 1.769), "0.3": (0.5527, 1.7369), "0.5": (0.410, 1.498), "0.7": (0.370, 1.173)}
OFF_SCALE = "peak"  # so far off in multipath that it would hide the differences of the others


def page(runs: list[AoaRecords]) -> Page:
    """The page of these runs."""
    several = len(runs) > 1
    shares = [share for run in runs for share in Share.of(run)]
    sections = [_results(share, several) for share in shares]
    if len(shares) > 1:
        sections.insert(0, Section("Error against the measured share", plots=[_over_shares(shares, "shares")]))
    for share in shares:
        sections += [
            section for section in (choice_section(share), room_section(share), suggestion_section(share)) if section
        ]
    sections += [_synthesis(shares, several), *(_examples(share) for share in shares)]
    sections += [section for share in shares if (section := field_section(share))]
    sections += [
        *(_speed(share) for share in shares),
        Section("Training and size", plots=[*_size(runs), *_training(runs)]),
    ]
    sections += [_time(shares, several), _limits(runs[0]), provenance(runs)]
    names = ", ".join(dict.fromkeys(run.place for run in runs))
    picture = _over_shares(shares, "summary") if len(shares) > 1 else _estimators(shares[0])
    return Page(f"Angle of arrival: {names}", summary(shares[0], picture), sections)


def _results(share: Share, several: bool) -> Section:
    title = f"{share.percent} measured" + (f" - {share.run.scene}, seed {share.run.metrics['seed']}" if several else "")
    rows = [
        [name, *(_with_interval(arm[column]) for column in ERRORS), number(arm["great_circle_deg"]["p90"])]
        for name, arm in share.mix["methods"].items()
    ]
    columns = ["method", *(f"{name} [deg]" for name in ERRORS.values()), "great circle, 90 %"]
    strong = frozenset(name for name in share.mix["methods"] if arms.is_turbo(name))
    paragraphs = []
    if share.key in PAPER:
        elevation, azimuth = PAPER[share.key]
        paragraphs.append(
            f"For orientation: the paper reports medians of {elevation} (elevation) and {azimuth} degrees (azimuth) at this "
            "share, on its own 6,123 spectra and an unnamed split; the numbers are not comparable with these."
        )
    table = Table(columns, rows, "Median error with its 95 % interval over the test spectra.", strong)
    parts = [[name, *(str(n) for n in counts.values())] for name, counts in share.mix["counts"].items()]
    origin = Table(["training set", "measured", "withheld positions", "further positions"], parts, "Spectra by origin.")
    return Section(title, paragraphs, [table, origin], [_cdf(share), *_turbo_cdf(share)], arms.terms())


def _with_interval(summary: ErrorSummary) -> str:
    return f"{number(summary['median'])} [{number(summary['low'])}, {number(summary['high'])}]"


def _cdf(share: Share) -> Plot:
    table = share.run.table("errors")
    own = table[table["mix"] == float(share.key)]
    own = own[
        [arms.is_network(name) or name in arms.baselines() for name in own["method"]]
    ]  # more would hide each other
    figure, axes = figures.new_figure(1, 3, 12, 3.8)
    for ax, (column, name) in zip(axes, ERRORS.items(), strict=True):
        groups = {str(method): part[column] for method, part in own.groupby("method", sort=False)}
        shown = [float(part.quantile(0.95)) for method, part in groups.items() if method != OFF_SCALE]
        figures.cdf(ax, arms.palette(), groups, f"{name} error [deg]", limit=max(*shown, 1e-3))
    axes[1].set_ylabel("")
    axes[2].set_ylabel("")
    figures.legend_below(figure, axes[0])
    caption = "Distribution of the errors; full lines are networks, dashed ones baselines."
    return Plot(f"cdf-{share.file_name}", figure, caption, own[["repeat", "index", "method", *ERRORS]])


def _turbo_cdf(share: Share) -> list[Plot]:
    """The paper's figure: the network between its bounds, one curve a synthesizer, where there are several."""
    turbo = [name for name in share.mix["methods"] if name in map(arms.turbo, SYNTHESIZERS)]
    if len(turbo) < 2:
        return []
    table = share.run.table("errors")
    own = table[table["mix"] == float(share.key)]
    figure, axes = figures.new_figure(1, 2, 12, 3.8)
    for ax, (column, name) in zip(axes, ERRORS.items(), strict=False):  # azimuth and elevation
        groups = {arm: own[own["method"] == arm][column] for arm in (arms.LOWER.name, *turbo, arms.UPPER.name)}
        limit = max(*(float(part.quantile(0.95)) for part in groups.values()), 1e-3)
        figures.cdf(ax, arms.palette(), groups, f"{name} error [deg]", limit=limit)
    axes[1].set_ylabel("")
    figures.legend_below(figure, axes[0])
    caption = "The network with spectra of each synthesizer at the withheld positions, between its bounds."
    shown = own[own["method"].isin([arms.LOWER.name, *turbo, arms.UPPER.name])]
    return [Plot(f"turbo-{share.file_name}", figure, caption, shown[["repeat", "index", "method", *ERRORS]])]


def _over_shares(shares: list[Share], name: str) -> Plot:
    every = (arm for share in shares for arm in share.mix["methods"])
    names = dict.fromkeys(
        arm for arm in every if arm != OFF_SCALE and (arms.is_network(arm) or arm in arms.baselines())
    )
    labels = [share.percent for share in shares]
    if len({share.run.place for share in shares}) > 1:
        labels = [figures.plain(f"{s.percent}\n{s.run.metrics['data']}\n{s.run.metrics['split']}") for s in shares]
    heights = {arm: [_median_and_interval(share, arm) for share in shares] for arm in names}
    figure, axes = figures.new_figure(1, 1, 7.2, 4)
    figures.bars(axes[0], arms.palette(), labels, heights, "median great-circle error [deg]")
    figures.legend_below(figure, axes[0])
    caption = "Median error of each arm against the measured share; whiskers: 95 % intervals."
    return Plot(name, figure, caption, figures.bars_data("share", labels, heights, "deg"))


def _estimators(share: Share) -> Plot:
    """Of one share: each estimator on the measured spectra, with the synthetic ones, on everything."""
    trainings = dict.fromkeys(map(arms.training_of, share.mix["methods"]))
    estimators = [arms.NETWORK, *(name for name in learners() if name != arms.NETWORK)]
    heights = {
        training: [_median_and_interval(share, arms.arm(estimator, training)) for estimator in estimators]
        for training in trainings
    }
    figure, axes = figures.new_figure(1, 1, 7.2, 4)
    labels = [f"network ({name})" if name == arms.NETWORK else name.replace("_", " ") for name in estimators]
    figures.bars(axes[0], arms.palette(), labels, heights, "median great-circle error [deg]")
    figures.legend_below(figure, axes[0])
    caption = f"Median error of each estimator on each training set, {share.title}; whiskers: 95 % intervals."
    return Plot("summary", figure, caption, figures.bars_data("estimator", estimators, heights, "deg"))


def _median_and_interval(share: Share, arm: str) -> tuple[float, float, float]:
    """Of the great-circle errors; nan where the run has no such arm."""
    if arm not in share.mix["methods"]:
        return np.nan, np.nan, np.nan
    error = share.mix["methods"][arm]["great_circle_deg"]
    return error["median"], error["low"], error["high"]


def _synthesis(shares: list[Share], several: bool) -> Section:
    rows = []
    for share in shares:
        for name, scores in share.mix["synthesis"].items():
            what = f"{share.percent} {name}" + (f", {share.run.scene}" if several else "")
            db = scores["psnr_db"]
            interval = f"{number(db['median'], 1)} [{number(db['low'], 1)}, {number(db['high'], 1)}]"
            rows.append([what, number(scores["ssim"]["median"], 3), interval, number(scores["l1"]["mean"], 4)])
    caption = (
        "SSIM: scikit-image's default (7 x 7 uniform window, data range 1), median; PSNR: 10 log10(1 / MSE), median with "
        "its 95 % interval; L1: mean. Over the test spectra, which no synthesizer saw."
    )
    table = Table(["share and synthesizer", "SSIM", "PSNR [dB]", "L1"], rows, caption)
    names = dict.fromkeys(name for share in shares for name in share.mix["synthesis"])
    plots = [_ssim_cdf(share) for share in shares]
    return Section("How good are the synthetic spectra?", [], [table], plots, arms.synthesizers(names))


def _ssim_cdf(share: Share) -> Plot:
    table = share.run.table("synthesis")
    own = table[(table["mix"] == float(share.key)) & table["synthesizer"].isin(list(SYNTHESIZERS))]
    groups = {str(name): part["ssim"] for name, part in own.groupby("synthesizer", sort=False)}
    figure, axes = figures.new_figure(1, 1, 6, 3.3)
    figures.cdf(axes[0], arms.palette(), groups, "SSIM", limit=1)
    figures.legend_below(figure, axes[0])
    caption = f"Distribution of the SSIM over the test spectra, {share.title}."
    return Plot(f"ssim-{share.file_name}", figure, caption, own[["repeat", "index", "synthesizer", "ssim"]])


def _examples(share: Share) -> Section:
    example = share.run.arrays(f"examples-mix{share.key}")
    captions = [f"no. {i + 1}\n{db:.1f} dB" for i, db in zip(example["index"], example["psnr_db"], strict=True)]
    deviation = example["deviation"] / 255.0 if "deviation" in example else None
    figure = figures.spectra(example["measured"] / 255.0, example["synthetic"] / 255.0, captions, deviation)
    text = "From the best to the worst of the test spectra by PSNR (quantiles 1, 0.8, ..., 0); angles in degrees."
    if deviation is not None:
        text += (
            " Expected deviation: the standard deviation by which the model expects to be wrong; intervals of 80 % cover "
            f"{float(example['coverage']):.0%} of the pixels of all test spectra."
        )
    return Section(
        f"Six spectra at positions nobody measured ({share.title}, {example.get('synthesizer', 'swiftwrf')})",
        plots=[Plot(f"spectra-{share.file_name}", figure, text, _pixels(example))],
    )


def _pixels(example: dict[str, NDArray[Any]]) -> DataFrame:
    """Spectra in 256 steps, a row of pixels each row; azimuth along the columns."""
    kinds = [kind for kind in ("measured", "synthetic", "deviation") if kind in example]
    images = np.stack([example[kind] for kind in kinds], axis=1)  # (n, kinds, H, W)
    n, _, rows, columns = images.shape
    names = {
        "index": np.repeat(example["index"], len(kinds) * rows),
        "kind": np.tile(np.repeat(kinds, rows), n),
        "row": np.tile(np.arange(rows), n * len(kinds)),
    }
    table = DataFrame(images.reshape(-1, columns), columns=[f"column_{i}" for i in range(columns)])
    return concat([DataFrame(names), table], axis=1)


def _size(runs: list[AoaRecords]) -> list[Plot]:
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
        axes[0].axvline(n, color="#aeb7c6", linewidth=1)
        axes[0].set_xscale("log", base=2)
        axes[0].xaxis.set_major_formatter("{x:g}")
        axes[0].set(xlabel="primitives", ylabel="loss on held-out spectra")
        caption = (
            f"{run.scene}, first share. Loss on measured spectra that each size did not see, at coarse resolution; the "
            f"model took the smallest within 0.2 % of the best: {n} primitives (line)."
        )
        data = by_size[["n_primitives", "validation"]]
        plots.append(Plot(f"size-{Share.of(run)[0].file_name}", figure, caption, data))
    return plots


def _training(runs: list[AoaRecords]) -> list[Plot]:
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
        caption = f"{run.scene}, first share and repeat: the networks, and synthesizers that are fitted by gradient."
        curves = {f"network, {name}": line for name, line in networks.items()}
        curves |= {f"synthesizer, {name}": line for name, line in fitted.items()}
        parts = [DataFrame({"what": what, "step": steps, "loss": loss}) for what, (steps, loss) in curves.items()]
        data = concat(parts) if parts else DataFrame(columns=["what", "step", "loss"])
        plots.append(Plot(f"training-{Share.of(run)[0].file_name}", figure, caption, data))
    return plots


def _speed(share: Share) -> Section:
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
        "Left and middle: synthesizers, seconds to fit and to draw the withheld and the test spectra. Right: estimators, "
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


def _time(shares: list[Share], several: bool) -> Section:
    rows = []
    for share in shares:
        seconds = share.mix["seconds"]
        cells = (number(value, 1) for value in (seconds["fit"], seconds["synthesize"], seconds["train"]))
        rows.append([share.percent + (f", {share.run.scene}" if several else ""), *cells])
    caption = "Seconds on the machine named below; train: the networks of all arms together."
    return Section("Where the time went", tables=[Table(["share", "fit", "synthesize", "train"], rows, caption)])


def _limits(run: AoaRecords) -> Section:
    texts = [
        "The test positions lie in the region and time of one measurement campaign; nothing here says how the network does "
        "in another room, after furniture moved, or with another array.",
        "The label is the geometric direction of the transmitter, computed from positions; where the direct path is blocked "
        "the spectrum may not contain it.",
        "Intervals treat test spectra as independent draws. Along a measured path they are not, so on such data the "
        "intervals are too narrow.",
    ]
    if run.metrics["split"] == "random":
        texts.append(
            "A random split of positions along a path tests look-up more than prediction: nearest neighbours are "
            "millimetres away. Use --split block for positions in a region without measurements."
        )
    if run.metrics["data"] == "simulated-room":
        texts.append(
            "These spectra are simulated: image sources in an idealised room. They show that the software works, no more."
        )
    return Section("What this does not show", texts)
