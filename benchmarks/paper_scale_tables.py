"""Make the tables of docs/paper-scale.md, with the paper's values beside the measured ones."""

from __future__ import annotations

from typing import Any

from committed import interval, load, markdown
from score_tables import Rows, angles, by_fraction, costs, scores

# median PSNR [dB], median SSIM and mean L1 of the paper's table of scenes, on its own spectra of rooms of these names
PAPER = {
    "conference-transmitter": {
        "vae": (21.54, 0.7095, 0.0656),
        "dcgan": (22.41, 0.7290, 0.0600),
        "nerf2": (26.12, 0.8122, 0.0555),
        "wrfgs": (25.53, 0.7888, 0.0514),
        "swiftwrf_paper": (30.75, 0.9039, 0.0410),
    },
    "conference-receiver": {
        "vae": (23.93, 0.7664, 0.0524),
        "dcgan": (21.26, 0.7164, 0.0608),
        "nerf2": (28.21, 0.8528, 0.0387),
        "wrfgs": (26.64, 0.7916, 0.0423),
        "swiftwrf_paper": (30.54, 0.9137, 0.0315),
    },
    "office-transmitter": {
        "vae": (23.51, 0.7647, 0.0549),
        "dcgan": (22.55, 0.7441, 0.0559),
        "nerf2": (27.52, 0.8118, 0.0497),
        "wrfgs": (24.00, 0.7422, 0.0534),
        "swiftwrf_paper": (32.96, 0.9376, 0.0355),
    },
    "office-receiver": {
        "vae": (22.75, 0.7562, 0.0612),
        "dcgan": (20.95, 0.7809, 0.0529),
        "nerf2": (24.16, 0.7863, 0.0515),
        "wrfgs": (24.07, 0.7460, 0.0510),
        "swiftwrf_paper": (28.01, 0.8755, 0.0406),
    },
    "bedroom-transmitter": {
        "vae": (22.90, 0.7468, 0.0612),
        "dcgan": (21.66, 0.7314, 0.0625),
        "nerf2": (25.99, 0.8004, 0.0608),
        "wrfgs": (26.10, 0.7995, 0.0534),
        "swiftwrf_paper": (30.17, 0.9166, 0.0442),
    },
    "bedroom-receiver": {
        "vae": (22.57, 0.7414, 0.0609),
        "dcgan": (21.79, 0.7208, 0.0601),
        "nerf2": (25.51, 0.8057, 0.0505),
        "wrfgs": (25.50, 0.7901, 0.0482),
        "swiftwrf_paper": (28.15, 0.9023, 0.0398),
    },
}


def _with_all(scene: dict[str, Any], split: str) -> Rows:
    """Return the rows of a split with all training spectra."""
    by_count = scene.get(split, {})
    rows: Rows = by_count[max(by_count, key=int)] if by_count else {}
    return rows


def paper_scale() -> str:
    """Return the scores of every method on the random split of every scene, and those of the paper."""
    return scores(_by_scene("paper_scale", "random"), PAPER)


def paper_scale_block() -> str:
    """Return the scores of every method on the block split of every scene."""
    return scores(_by_scene("paper_scale", "block"), {})


def paper_scale_gpu() -> str:
    """Return the scores of the fits by gradient descent on a GPU, and those of the paper."""
    return scores(_by_scene("paper_scale_gpu", "random"), PAPER)


def _by_scene(result: str, split: str) -> dict[str, Rows]:
    """Return the rows of each scene with all training spectra."""
    return {name: _with_all(scene, split) for name, scene in load(result)["scenes"].items() if split in scene}


def paper_scale_cost() -> str:
    """Return seconds and size of the fits on the random split, from the least to the greatest scene."""
    return costs(_by_scene("paper_scale", "random"))


def paper_scale_gpu_cost() -> str:
    """Return seconds and size of the fits on a GPU."""
    return costs(_by_scene("paper_scale_gpu", "random"))


def paper_scale_density() -> str:
    """Return how densely the positions of each scene lie."""
    rows = [
        [
            name,
            f"{scene['traced']['positions']:,}",
            f"{scene['spacing_wavelengths']:.2f}",
            f"{scene['nearest_training_wavelengths']:.2f}",
            f"{scene['traced']['line_of_sight'] / scene['traced']['positions']:.0%}",
            f"{scene['traced']['paths_per_position']:.0f}",
        ]
        for name, scene in load("paper_scale")["described"].items()
    ]
    columns = ["scene", "positions", "spacing [wavelengths]", "nearest training position [wavelengths]"]
    return markdown([*columns, "line of sight", "paths a position"], rows)


def paper_scale_counts() -> str:
    """Return the scores of swiftwrf against the number of training spectra."""
    rows = []
    for name, scene in load("paper_scale")["scenes"].items():
        found = {n: methods["swiftwrf"] for n, methods in scene.get("random", {}).items() if "swiftwrf" in methods}
        if len(found) > 1:
            for n in sorted(found, key=int):
                row = found[n]
                cells = [f"{row['ssim']['median']:.3f} [{row['ssim']['low']:.3f}, {row['ssim']['high']:.3f}]"]
                cells += [f"{row['psnr_db']['median']:.2f}", f"{row['fit_seconds']:.0f}", f"{row['megabytes']:.2f}"]
                rows.append([name, f"{int(n):,}", *cells])
    return markdown(["scene, random split", "training spectra", "SSIM", "PSNR [dB]", "fit [s]", "MB"], rows)


def paper_scale_aoa() -> str:
    """Return the angular errors of each method at each measured fraction; only the network has all synthesizers."""

    def cell(errors: dict[str, Any]) -> str:
        return f"{interval(errors['great_circle_deg'])} / {errors['great_circle_deg']['p90']:.1f}"

    def is_shown(method: str) -> bool:
        return "_turbo_" not in method or method.endswith("_turbo_hybrid")

    return by_fraction(load("paper_scale")["aoa"], "great_circle_deg", cell, is_shown)


def paper_scale_angles() -> str:
    """Return elevation and azimuth errors of the network with each synthesizer, and those of the paper."""
    return angles(load("paper_scale")["aoa"])
