"""The report of angle-of-arrival runs, one or several."""

from __future__ import annotations

import numpy as np

from augment import SYNTHESIZERS
from tasks.aoa import arms
from tasks.aoa.estimators import ESTIMATORS
from tasks.aoa.page_room import advice_sentence, choice_section, room_section
from tasks.aoa.page_suggest import suggestion_section
from tasks.aoa.share import AoaRecords, Share, first_history, fits, place, scene
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
        sections.insert(0, _over_shares(shares))
    for share in shares:
        sections += [
            section for section in (choice_section(share), room_section(share), suggestion_section(share)) if section
        ]
    sections += [_synthesis(shares, several), *(_examples(share) for share in shares), *_size(runs)]
    sections += [*(_speed(share) for share in shares), _training(runs)]
    sections += [_time(shares, several), _limits(runs[0]), provenance(runs)]
    names = ", ".join(dict.fromkeys(place(run) for run in runs))
    return Page(f"Angle of arrival: {names}", _lead(shares[0]), sections)


def _lead(share: Share) -> str:
    metrics, mix = share.run.metrics, share.mix
    median = {name: arm["great_circle_deg"]["median"] for name, arm in mix["methods"].items()}
    turbo = min((name for name in median if arms.is_turbo(name) and _is_network(name)), key=lambda name: median[name])
    lower, upper = median[arms.LOWER.name], median[arms.UPPER.name]
    best = min(median, key=lambda name: median[name])
    sentences = [
        f"On {share.scene}, with {mix['n_measured']} of {metrics['n_train']} training spectra measured ({share.percent}), "
        f"turbo learning ({turbo}) changes the network's median great-circle error by {median[turbo] / lower - 1:+.0%}: "
        f"{median[turbo]:.2f} degrees against {lower:.2f} on the measured share alone and {upper:.2f} with everything "
        "measured.",
        f"The best of all arms is {best} with {median[best]:.2f}. {metrics['n_test']} test spectra.",
    ]
    return " ".join([*sentences, *filter(None, [advice_sentence(share)])])


def _is_network(name: str) -> bool:
    return arms.estimator_of(name) == arms.NETWORK


def _results(share: Share, several: bool) -> Section:
    title = f"{share.percent} measured" + (f" - {share.scene}, seed {share.run.metrics['seed']}" if several else "")
    rows = [
        [name, *(_with_interval(arm[column]) for column in ERRORS), number(arm["great_circle_deg"]["p90"])]
        for name, arm in share.mix["methods"].items()
    ]
    columns = ["method", *(f"{name} [deg]" for name in ERRORS.values()), "great circle, 90 %"]
    strong = frozenset(name for name in share.mix["methods"] if arms.is_turbo(name))
    paragraphs = [arms.meaning()]
    if share.key in PAPER:
        elevation, azimuth = PAPER[share.key]
        paragraphs.append(
            f"For orientation: the paper reports medians of {elevation} (elevation) and {azimuth} degrees (azimuth) at this "
            "share, on its own 6,123 spectra and an unnamed split; the numbers are not comparable with these."
        )
    table = Table(columns, rows, "Median error with its 95 % interval over the test spectra.", strong)
    parts = [[name, *(str(n) for n in counts.values())] for name, counts in share.mix["counts"].items()]
    origin = Table(["training set", "measured", "withheld positions", "further positions"], parts, "Spectra by origin.")
    return Section(title, paragraphs, [table, origin], [_cdf(share), *_turbo_cdf(share)])


def _with_interval(summary: ErrorSummary) -> str:
    return f"{number(summary['median'])} [{number(summary['low'])}, {number(summary['high'])}]"


def _cdf(share: Share) -> Plot:
    table = share.run.table("errors")
    own = table[table["mix"] == float(share.key)]
    own = own[[_is_network(name) or name in arms.baselines() for name in own["method"]]]  # more would hide each other
    figure, axes = figures.new_figure(1, 3, 10, 3.3)
    for ax, (column, name) in zip(axes, ERRORS.items(), strict=True):
        groups = {str(method): part[column] for method, part in own.groupby("method", sort=False)}
        shown = [float(part.quantile(0.95)) for method, part in groups.items() if method != OFF_SCALE]
        figures.cdf(ax, arms.palette(), groups, f"{name} error [deg]", limit=max(*shown, 1e-3))
    axes[1].set_ylabel("")
    axes[2].set_ylabel("")
    figures.legend_below(figure, axes[0])
    caption = "Distribution of the errors; full lines are networks, dashed ones baselines."
    return Plot(f"cdf-{share.file_name}", figure, caption)


def _turbo_cdf(share: Share) -> list[Plot]:
    """The paper's figure: the network between its bounds, one curve a synthesizer, where there are several."""
    turbo = [name for name in share.mix["methods"] if name in map(arms.turbo, SYNTHESIZERS)]
    if len(turbo) < 2:
        return []
    table = share.run.table("errors")
    own = table[table["mix"] == float(share.key)]
    figure, axes = figures.new_figure(1, 2, 8, 3.3)
    for ax, (column, name) in zip(axes, ERRORS.items(), strict=False):  # azimuth and elevation
        groups = {arm: own[own["method"] == arm][column] for arm in (arms.LOWER.name, *turbo, arms.UPPER.name)}
        limit = max(*(float(part.quantile(0.95)) for part in groups.values()), 1e-3)
        figures.cdf(ax, arms.palette(), groups, f"{name} error [deg]", limit=limit)
    axes[1].set_ylabel("")
    figures.legend_below(figure, axes[0])
    caption = "The network with spectra of each synthesizer at the withheld positions, between its bounds."
    return [Plot(f"turbo-{share.file_name}", figure, caption)]


def _over_shares(shares: list[Share]) -> Section:
    every = (name for share in shares for name in share.mix["methods"])
    names = dict.fromkeys(
        name for name in every if name != OFF_SCALE and (_is_network(name) or name in arms.baselines())
    )
    labels = [share.percent for share in shares]
    if len({place(share.run) for share in shares}) > 1:
        labels = [figures.plain(f"{s.percent}\n{s.run.metrics['data']}\n{s.run.metrics['split']}") for s in shares]
    heights = {name: [_median_and_interval(share, name) for share in shares] for name in names}
    figure, axes = figures.new_figure(1, 1, 8, 3.4)
    figures.bars(axes[0], arms.palette(), labels, heights, "median great-circle error [deg]")
    figures.legend_below(figure, axes[0])
    return Section("Error against the measured share", plots=[Plot("shares", figure, "Whiskers: 95 % intervals.")])


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
            what = f"{share.percent} {name}" + (f", {share.scene}" if several else "")
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
    return Section("How good are the synthetic spectra?", [arms.synthesizers(names)], [table], plots)


def _ssim_cdf(share: Share) -> Plot:
    table = share.run.table("synthesis")
    own = table[(table["mix"] == float(share.key)) & table["synthesizer"].isin(list(SYNTHESIZERS))]
    groups = {str(name): part["ssim"] for name, part in own.groupby("synthesizer", sort=False)}
    figure, axes = figures.new_figure(1, 1, 6, 3.3)
    figures.cdf(axes[0], arms.palette(), groups, "SSIM", limit=1)
    figures.legend_below(figure, axes[0])
    return Plot(f"ssim-{share.file_name}", figure, f"Distribution of the SSIM over the test spectra, {share.title}.")


def _examples(share: Share) -> Section:
    with np.load(share.run.folder / f"examples-mix{share.key}.npz") as file:
        example = dict(file)
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
        plots=[Plot(f"spectra-{share.file_name}", figure, text)],
    )


def _size(runs: list[AoaRecords]) -> list[Section]:
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
            f"{scene(run)}, first share. Loss on measured spectra that each size did not see, at coarse resolution; the "
            f"model took the smallest within 0.2 % of the best: {n} primitives (line)."
        )
        plots.append(Plot(f"size-{Share.of(run)[0].file_name}", figure, caption))
    return [Section("How large a model the scene needs", plots=plots)] if plots else []


def _training(runs: list[AoaRecords]) -> Section:
    plots = []
    for run in runs:
        history = first_history(run)
        by_arm = history.groupby("method", sort=False) if "method" in history else ()
        networks = {str(name): (part["step"], part["loss"]) for name, part in by_arm}
        # fits by gradient; others have no steps
        descents = history[(history["stage"] == "final") & (history["steps"] > 0)] if "steps" in history else None
        by_fit = () if descents is None else descents.groupby("synthesizer", sort=False)
        fitted = {str(name): (part["step"], part["loss"] / part["loss"].iloc[0]) for name, part in by_fit}
        figure, axes = figures.new_figure(1, 2, 9, 3)
        figures.curves(axes[0], arms.palette(), networks, "step", "loss of the network")
        figures.curves(axes[1], arms.palette(), fitted, "step", "loss of the synthesizer, over its first")
        axes[1].set_visible(bool(fitted))
        caption = f"{scene(run)}, first share and repeat: the networks, and synthesizers that are fitted by gradient."
        plots.append(Plot(f"training-{Share.of(run)[0].file_name}", figure, caption))
    return Section("Training", plots=plots)


def _speed(share: Share) -> Section:
    synthesis = {name: scores for name, scores in share.mix["synthesis"].items() if name in SYNTHESIZERS}
    methods = {n: a for n, a in share.mix["methods"].items() if _is_network(n) or n in ESTIMATORS}
    error = {name: rms_of_psnr(scores["psnr_db"]["median"]) for name, scores in synthesis.items()}
    fit = {name: max(scores["seconds"]["fit"], SHORTEST) for name, scores in synthesis.items()}
    draw = {name: max(scores["seconds"]["synthesize"], SHORTEST) for name, scores in synthesis.items()}
    estimators = {
        name: (max(arm["seconds"]["train"] + arm["seconds"]["estimate"], SHORTEST), arm["great_circle_deg"]["median"])
        for name, arm in methods.items()
    }
    palette = arms.palette()
    figure, axes = figures.new_figure(1, 3, 10.5, 4.2)
    for ax, stage, seconds in zip(axes, ("fit", "synthesize"), (fit, draw), strict=False):
        points = {name: (seconds[name], error[name]) for name in synthesis}
        figures.speed(ax, palette, points, f"seconds to {stage}", "RMS error of a spectrum")
    figures.speed(axes[2], palette, estimators, "seconds to train and estimate", "median great-circle error [deg]")
    caption = (
        "Left and middle: synthesizers, seconds to fit and to draw the withheld and the test spectra. Right: estimators, "
        "the synthesizer's time not counted. The line is the Pareto front: what is not on it is beaten in both."
    )
    figures.legend_of(figure, palette, [*synthesis, *methods])
    return Section(f"Speed against error ({share.title})", plots=[Plot(f"speed-{share.file_name}", figure, caption)])


def _time(shares: list[Share], several: bool) -> Section:
    rows = []
    for share in shares:
        seconds = share.mix["seconds"]
        cells = (number(value, 1) for value in (seconds["fit"], seconds["synthesize"], seconds["train"]))
        rows.append([share.percent + (f", {share.scene}" if several else ""), *cells])
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
