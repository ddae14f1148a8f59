"""Make the tables of docs/comparison.md, with the paper's numbers beside the measured ones."""

from __future__ import annotations

from typing import Any

from committed import load, markdown
from score_tables import Rows, angles, costs, scores

# median PSNR [dB], median SSIM and mean L1 of the paper's table, on its own spectra of the RFID set
PAPER_S23 = {
    "vae": (18.62, 0.7133, 0.1033),
    "dcgan": (18.81, 0.7189, 0.0967),
    "nerf2": (21.76, 0.7732, 0.0712),
    "wrfgs": (20.72, 0.7588, 0.0788),
    "swiftwrf": (24.75, 0.8714, 0.0582),
}


def comparison() -> str:
    """Return the scores of every method on every scene with all training spectra, and those of the paper."""
    paper = {
        name: {"psnr_db": {"median": psnr}, "ssim": {"median": ssim}, "l1": {"mean": l1}}
        for name, (psnr, ssim, l1) in PAPER_S23.items()
    }
    return scores(_by_scene() | {"paper, other spectra of s23": paper}, {})


def comparison_cost() -> str:
    """Return seconds and size of every method with all training spectra."""
    return costs(_by_scene())


def _by_scene() -> dict[str, Rows]:
    return {scene: next(iter(by_count.values())) for scene, by_count in load("comparison")["scenes"].items()}


def comparison_counts() -> str:
    """Return the median SSIM of every method against the number of training spectra."""
    by_count = load("comparison")["scenes"]["s23-200 random"]
    ascending = sorted(by_count, key=int)
    methods = list(dict.fromkeys(name for rows in by_count.values() for name in rows))
    rows = [[name, *(_ssim(by_count[n].get(name)) for n in ascending)] for name in methods]
    return markdown(["s23-200, random: training spectra", *ascending], rows)


def _ssim(row: dict[str, Any] | None) -> str:
    return "" if row is None else f"{row['ssim']['median']:.3f}"


def comparison_turbo() -> str:
    """Return median errors of the network with the spectra of several methods, elevation / azimuth."""
    return angles(load("comparison")["turbo"])
