"""The report's sections on the quality of the synthetic spectra."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from pandas import DataFrame, concat

from swiftwrf.models import FIELD_MODELS
from tasks import labels
from tasks.aoa.page.records import FractionRecords
from tasks.page import figures
from tasks.page.page import Plot, Section, Table
from tasks.page.provenance import number


def synthesis_section(fractions: list[FractionRecords], several: bool) -> Section:
    """Return the quality of the spectra of each field model at the test positions."""
    rows = []
    for fraction in fractions:
        for name, scores in fraction.mix["synthesis"].items():
            what = f"{fraction.percent} {name}" + (f", {fraction.run.scene}" if several else "")
            db = scores["psnr_db"]
            interval = f"{number(db['median'], 1)} [{number(db['low'], 1)}, {number(db['high'], 1)}]"
            rows.append([what, number(scores["ssim"]["median"], 3), interval, number(scores["l1"]["mean"], 4)])
    caption = (
        "SSIM: scikit-image's default (7 x 7 uniform window, data range 1), median; PSNR: 10 log10(1 / MSE), median with "
        "its 95 % interval; L1: mean. Over the test spectra, which no synthesizer was fitted to."
    )
    table = Table(["fraction and synthesizer", "SSIM", "PSNR [dB]", "L1"], rows, caption)
    names = dict.fromkeys(name for fraction in fractions for name in fraction.mix["synthesis"])
    plots = [_ssim_cdf(fraction) for fraction in fractions]
    meanings = {name: label.meaning for name, label in labels.labels(FIELD_MODELS, labels.FIELD_MODELS, names).items()}
    return Section("How good are the synthetic spectra?", [], [table], plots, meanings)


def _ssim_cdf(fraction: FractionRecords) -> Plot:
    table = fraction.table("synthesis")
    own = table[table["synthesizer"].isin(list(FIELD_MODELS))]
    groups = {str(name): part["ssim"] for name, part in own.groupby("synthesizer", sort=False)}
    figure, axes = figures.new_figure(1, 1, 6, 3.3)
    figures.cdf(axes[0], fraction.palette, groups, "SSIM", limit=1)
    figures.legend_below(figure, axes[0])
    caption = f"Distribution of the SSIM over the test spectra, {fraction.title}."
    return Plot(f"ssim-{fraction.file_name}", figure, caption, own[["repeat", "index", "synthesizer", "ssim"]])


def examples_section(fraction: FractionRecords) -> Section:
    """Return measured and synthetic spectra side by side, from the best to the worst."""
    example = fraction.run.arrays(f"examples-mix{fraction.key}")
    captions = [f"no. {i + 1}\n{db:.1f} dB" for i, db in zip(example["index"], example["psnr_db"], strict=True)]
    deviation = example["deviation"] / 255.0 if "deviation" in example else None
    figure = figures.spectra(example["measured"] / 255.0, example["synthetic"] / 255.0, captions, deviation)
    text = "From the best to the worst of the test spectra by PSNR (quantiles 1, 0.8, ..., 0); angles in degrees."
    if deviation is not None:
        text += (
            " Expected deviation: the predictive standard deviation of the model; intervals of 80 % cover "
            f"{float(example['coverage']):.0%} of the pixels of all test spectra."
        )
    return Section(
        f"Six spectra at positions nobody measured ({fraction.title}, {example.get('synthesizer', 'swiftwrf')})",
        plots=[Plot(f"spectra-{fraction.file_name}", figure, text, _pixels(example))],
    )


def _pixels(example: dict[str, NDArray[Any]]) -> DataFrame:
    """Return the pixels of the spectra in 256 steps, one row of pixels a row."""
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
