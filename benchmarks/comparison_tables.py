"""Make the tables of docs/comparison.md, with the paper's numbers beside the measured ones."""

from __future__ import annotations

from typing import Any

from committed import interval, load, markdown
from score_tables import Rows, costs, scores

# median PSNR [dB], median SSIM and mean L1 of the paper's table, on its own spectra of these scenes
PAPER_SCENES = {
    "s23-200": {
        "vae": (18.62, 0.7133, 0.1033),
        "dcgan": (18.81, 0.7189, 0.0967),
        "nerf2": (21.76, 0.7732, 0.0712),
        "wrfgs": (20.72, 0.7588, 0.0788),
        "swiftwrf": (24.75, 0.8714, 0.0582),
    },
    "newrf-bedroom": {
        "vae": (22.57, 0.7414, 0.0609),
        "dcgan": (21.79, 0.7208, 0.0601),
        "nerf2": (25.51, 0.8057, 0.0505),
        "wrfgs": (25.50, 0.7901, 0.0482),
        "swiftwrf": (28.15, 0.9023, 0.0398),
    },
    "newrf-office": {
        "vae": (22.75, 0.7562, 0.0612),
        "dcgan": (20.95, 0.7809, 0.0529),
        "nerf2": (24.16, 0.7863, 0.0515),
        "wrfgs": (24.07, 0.7460, 0.0510),
        "swiftwrf": (28.01, 0.8755, 0.0406),
    },
}
# median elevation and azimuth errors [deg] of the paper's table at each share, likewise
PAPER_TURBO = {
    "0.1": {"swiftwrf": (0.592, 1.769), "nerf2": (0.957, 2.548), "wrfgs": (1.056, 4.506)},
    "0.3": {"swiftwrf": (0.553, 1.737), "nerf2": (0.850, 1.903), "wrfgs": (0.948, 2.364)},
    "0.5": {"swiftwrf": (0.410, 1.498), "nerf2": (0.704, 1.663), "wrfgs": (0.878, 1.854)},
    "0.7": {"swiftwrf": (0.370, 1.173), "nerf2": (0.674, 1.478), "wrfgs": (0.727, 1.629)},
}


def comparison() -> str:
    """Return the scores of every method on every scene with all training spectra, and those of the paper."""
    scenes = _by_scene()
    return scores(scenes, {scene: PAPER_SCENES.get(scene.split()[0], {}) for scene in scenes})


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
    return "" if row is None else f"{row['ssim']['median']:.3f} [{row['ssim']['low']:.3f}, {row['ssim']['high']:.3f}]"


def comparison_turbo() -> str:
    """Return median errors of the network with the spectra of several methods, elevation / azimuth."""
    rows = []
    for share, arms in (load("comparison")["turbo"] or {}).items():
        for name, arm in arms.items():
            paper = PAPER_TURBO.get(share, {}).get(name.removeprefix("turbo_"))
            cells = [interval(arm[angle]) for angle in ("elevation_deg", "azimuth_deg")]
            rows.append([f"{float(share):.0%}", name, *cells, " / ".join(map(str, paper)) if paper else ""])
    return markdown(["measured", "training set", "elevation [deg]", "azimuth [deg]", "paper, other data"], rows)
