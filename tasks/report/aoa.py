"""The report of angle-of-arrival runs, one or several."""

from __future__ import annotations

from typing import Any

import numpy as np
from pandas import DataFrame

from tasks.report import figures
from tasks.report.page import Page, Plot, Section, Table
from tasks.report.provenance import number, provenance
from tasks.report.records import Records

ERRORS = {"azimuth_deg": "azimuth", "elevation_deg": "elevation", "great_circle_deg": "great circle"}
# median elevation and azimuth errors in degrees by measured share (paper, table of the AoA case study)
PAPER = {"0.1": (0.592, 1.769), "0.3": (0.5527, 1.7369), "0.5": (0.410, 1.498), "0.7": (0.370, 1.173)}
MEANING = {
    "measured_only": "lower bound: the network trained on the measured share alone",
    "measured_all": "upper bound: the network trained on all training spectra, measured",
    "constant": "the mean direction of the measured labels",
    "nearest_spectrum": "the label of the most similar measured spectrum",
    "peak": "the strongest direction",
}


def aoa_page(runs: list[Records]) -> Page:
    """The page of these runs."""
    several = len(runs) > 1
    shares = [(run, share, mix) for run in runs for share, mix in run.metrics["mixes"].items()]
    sections = [_results(run, share, mix, several) for run, share, mix in shares]
    if len(shares) > 1:
        sections.insert(0, _over_shares(shares))
    sections += [_synthesis(shares, several), *(_examples(run, share) for run, share, _ in shares), _size(runs)]
    sections += [*(_speed(*each) for each in shares), _training(runs)]
    sections += [_time(shares, several), _limits(runs[0]), provenance(runs)]
    names = ", ".join(dict.fromkeys(_scene(run) for run in runs))
    return Page(f"Angle of arrival: {names}", _lead(*shares[0]), sections)


def _scene(run: Records) -> str:
    name = "the simulated room" if run.metrics["data"] == "simulated-room" else run.metrics["data"]
    return f"{name}, {run.metrics['split']} split"


def _lead(run: Records, share: str, mix: dict[str, Any]) -> str:
    methods = mix["methods"]
    median = {name: m["great_circle_deg"]["median"] for name, m in methods.items()}
    turbo = min((name for name in median if name.startswith("turbo")), key=lambda name: median[name])
    gain = "lowers" if median[turbo] < median["measured_only"] else "does not lower"
    best = min(("constant", "nearest_spectrum", "peak"), key=lambda name: median[name])
    return (
        f"On {_scene(run)}, with {mix['n_measured']} of {run.metrics['n_train']} training spectra measured "
        f"({float(share):.0%}), turbo learning with {turbo.removeprefix('turbo_')} {gain} the network's median "
        f"great-circle error: "
        f"{median[turbo]:.2f} degrees against {median['measured_only']:.2f} without synthetic spectra and "
        f"{median['measured_all']:.2f} with all of them measured. The best baseline without a network, {best}, "
        f"reaches {median[best]:.2f}. {run.metrics['n_test']} test spectra."
    )


def _results(run: Records, share: str, mix: dict[str, Any], several: bool) -> Section:
    title = f"{float(share):.0%} measured" + (f" - {_scene(run)}, seed {run.metrics['seed']}" if several else "")
    rows = [
        [name, *(_with_interval(method[column]) for column in ERRORS), number(method["great_circle_deg"]["p90"])]
        for name, method in mix["methods"].items()
    ]
    columns = ["method", *(f"{name} [deg]" for name in ERRORS.values()), "great circle, 90 %"]
    strong = frozenset(name for name in mix["methods"] if name.startswith("turbo"))
    paragraphs = [
        "; ".join(f"{name}: {text}" for name, text in MEANING.items())
        + ". turbo_NAME: the network trained on the measured share and on spectra that NAME synthesized at the others."
    ]
    if share in PAPER:
        elevation, azimuth = PAPER[share]
        paragraphs.append(
            f"For orientation: the paper reports medians of {elevation} (elevation) and {azimuth} degrees (azimuth) at this "
            "share, on its own 6,123 spectra and an unnamed split; the numbers are not comparable with these."
        )
    table = Table(columns, rows, "Median error with its 95 % interval over the test spectra.", strong)
    return Section(title, paragraphs, [table], [_cdf(run, share)])


def _with_interval(summary: dict[str, Any]) -> str:
    return f"{number(summary['median'])} [{number(summary['low'])}, {number(summary['high'])}]"


def _cdf(run: Records, share: str) -> Plot:
    table = run.table("errors")
    own = table[table["mix"] == float(share)]
    figure, axes = figures.new_figure(1, 3, 10, 3.3)
    for ax, (column, name) in zip(axes, ERRORS.items(), strict=True):
        groups = {str(method): part[column] for method, part in own.groupby("method", sort=False)}
        shown = [float(np.quantile(part, 0.95)) for method, part in groups.items() if method != "peak"]
        figures.cdf(ax, groups, f"{name} error [deg]", limit=max(*shown, 1e-3))
    axes[1].set_ylabel("")
    axes[2].set_ylabel("")
    figures.legend_below(figure, axes[0])
    scene = _file_name(run, share)
    return Plot(f"cdf-{scene}", figure, "Distribution of the errors; full lines are networks, dashed ones baselines.")


def _file_name(run: Records, share: str) -> str:
    return f"{run.metrics['data']}-{run.metrics['split']}-mix{share}-s{run.metrics['seed']}"


def _over_shares(shares: list[tuple[Records, str, dict[str, Any]]]) -> Section:
    names = list(dict.fromkeys(name for _, _, mix in shares for name in mix["methods"] if name != "peak"))
    labels = [f"{float(share):.0%}" for _, share, _ in shares]
    if len({_scene(run) for run, _, _ in shares}) > 1:
        labels = [
            f"{label}\n{run.metrics['data']}\n{run.metrics['split']}"
            for label, (run, _, _) in zip(labels, shares, strict=True)
        ]
    missing = (np.nan, np.nan, np.nan)
    heights = {
        name: [
            tuple(mix["methods"][name]["great_circle_deg"][key] for key in ("median", "low", "high"))
            if name in mix["methods"]
            else missing
            for _, _, mix in shares
        ]
        for name in names
    }
    figure, axes = figures.new_figure(1, 1, 8, 3.4)
    figures.bars(axes[0], labels, heights, "median great-circle error [deg]")
    figures.legend_below(figure, axes[0])
    return Section("Error against the measured share", plots=[Plot("shares", figure, "Whiskers: 95 % intervals.")])


def _synthesis(shares: list[tuple[Records, str, dict[str, Any]]], several: bool) -> Section:
    rows = []
    for run, share, mix in shares:
        for name, scores in mix["synthesis"].items():
            what = f"{float(share):.0%} {name}" + (f", {_scene(run)}" if several else "")
            db = scores["psnr_db"]
            interval = f"{number(db['median'], 1)} [{number(db['low'], 1)}, {number(db['high'], 1)}]"
            rows.append([what, number(scores["ssim"]["median"], 3), interval, number(scores["l1"]["mean"], 4)])
    caption = (
        "SSIM: scikit-image's default (7 x 7 uniform window, data range 1), median; PSNR: 10 log10(1 / MSE), median with "
        "its 95 % interval; L1: mean. Over the test spectra, which no synthesizer saw."
    )
    table = Table(["share and synthesizer", "SSIM", "PSNR [dB]", "L1"], rows, caption)
    return Section("How good are the synthetic spectra?", tables=[table])


def _examples(run: Records, share: str) -> Section:
    with np.load(run.folder / f"examples-mix{share}.npz") as file:
        example = dict(file)
    captions = [f"no. {i + 1}\n{db:.1f} dB" for i, db in zip(example["index"], example["psnr_db"], strict=True)]
    figure = figures.spectra(example["measured"] / 255.0, example["synthetic"] / 255.0, captions)
    text = "From the best to the worst of the test spectra by PSNR (quantiles 1, 0.8, ..., 0); angles in degrees."
    return Section(
        f"Six spectra at positions nobody measured ({float(share):.0%} measured)",
        plots=[Plot(f"spectra-{_file_name(run, share)}", figure, text)],
    )


def _size(runs: list[Records]) -> Section:
    """Quality against size: what the fit of SwiftWRF tried, and what it took."""
    plots = []
    for run in runs:
        search, final = _fits(run)
        if not len(search):
            continue
        figure, axes = figures.new_figure(1, 1, 6, 3)
        for steps, part in search.groupby("steps"):
            by_size = part.sort_values("n_primitives")
            axes[0].plot(by_size["n_primitives"], by_size["validation"], "o-", markersize=4, label=f"{steps:.0f} steps")
        n, steps = int(final["n_primitives"].iloc[0]), int(final["steps"].iloc[0])
        axes[0].axvline(n, color="#aeb7c6", linewidth=1)
        axes[0].set_xscale("log", base=2)
        axes[0].xaxis.set_major_formatter("{x:g}")
        axes[0].set(xlabel="primitives", ylabel="loss on held-out spectra")
        figures.legend_below(figure, axes[0])
        caption = (
            f"{_scene(run)}, first share. Loss of short fits on a fifth of the measured spectra that they did not see, at "
            f"coarse resolution; the model took the smallest size within 1 % of the best: {n} primitives (line), {steps} "
            "steps."
        )
        plots.append(Plot(f"size-{_file_name(run, next(iter(run.metrics['mixes'])))}", figure, caption))
    return Section("How large a model the scene needs", plots=plots)


def _fits(run: Records) -> tuple[DataFrame, DataFrame]:
    """History of the fits of SwiftWRF for the first share and repeat: the last look of each of the search, and the final
    one."""
    history = run.table("history")
    fits = history[(history["repeat"] == 0) & (history["mix"] == history["mix"].iloc[0])]
    if "stage" not in fits:
        return fits.iloc[:0], fits.iloc[:0]
    fits = fits[fits["synthesizer"] == "swiftwrf"]
    search = fits[fits["stage"] == "search"].groupby(["n_primitives", "steps"], as_index=False).last()
    return search, fits[fits["stage"] == "final"]


def _training(runs: list[Records]) -> Section:
    plots = []
    for run in runs:
        history = run.table("history")
        history = history[(history["repeat"] == 0) & (history["mix"] == history["mix"].iloc[0])]
        _, final = _fits(run)
        figure, axes = figures.new_figure(1, 2, 9, 3)
        networks = {str(name): (part["step"], part["loss"]) for name, part in history.groupby("method", sort=False)}
        figures.curves(axes[0], networks, "step", "loss of the network")
        figures.curves(axes[1], {"swiftwrf": (final["step"], final["loss"])}, "step", "loss of SwiftWRF")
        axes[1].set_visible(bool(len(final)))
        plots.append(
            Plot(
                f"training-{_file_name(run, next(iter(run.metrics['mixes'])))}",
                figure,
                f"{_scene(run)}, first share and repeat: the networks, and the final fit of SwiftWRF.",
            )
        )
    return Section("Training", plots=plots)


def _speed(run: Records, share: str, mix: dict[str, Any]) -> Section:
    figure, axes = figures.new_figure(1, 3, 10.5, 3.4)
    synthesis = mix["synthesis"].items()
    for ax, stage in zip(axes, ("fit", "synthesize"), strict=False):
        points = {
            name: (max(scores["seconds"][stage], 1e-5), 10 ** (-scores["psnr_db"]["median"] / 20))
            for name, scores in synthesis
        }
        figures.speed(ax, points, f"seconds to {stage}", "RMS error of a spectrum")
    methods = {
        name: (max(sum(method["seconds"].values()), 1e-5), method["great_circle_deg"]["median"])
        for name, method in mix["methods"].items()
    }
    figures.speed(axes[2], methods, "seconds to train and estimate", "median great-circle error [deg]")
    caption = (
        "Left and middle: synthesizers, seconds to fit and to draw the withheld and the test spectra. Right: estimators, "
        "the synthesizer's time not counted. The line is the Pareto front: what is not on it is beaten in both."
    )
    title = f"Speed against error ({float(share):.0%} measured)"
    figures.legend_of(figure, [*mix["synthesis"], *mix["methods"]])
    return Section(title, plots=[Plot(f"speed-{_file_name(run, share)}", figure, caption)])


def _time(shares: list[tuple[Records, str, dict[str, Any]]], several: bool) -> Section:
    rows = [
        [
            f"{float(share):.0%}" + (f", {_scene(run)}" if several else ""),
            *(number(mix["seconds"][k], 1) for k in ("fit", "synthesize", "train")),
        ]
        for run, share, mix in shares
    ]
    caption = "Seconds on the machine named below; train: the networks of all arms together."
    return Section("Where the time went", tables=[Table(["share", "fit", "synthesize", "train"], rows, caption)])


def _limits(run: Records) -> Section:
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
