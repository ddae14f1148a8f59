"""One-line meanings and colours of methods, for help texts and reports."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

from swiftwrf.runtime.registry import Registry

# Each colour has a contrast of at least 3 to 1 with the light page and with the dark one. Lines also differ by dashes.
OTHER_COLOURS = ("#cf4a4a", "#2a9165", "#8f7d12", "#1b8fa6", "#c04f9d", "#7f8794")  # of methods of other packages


class Label(NamedTuple):
    """Meaning of a method in one line, and its colour `#rrggbb`, None for one that follows from the name."""

    meaning: str
    colour: str | None = None


def colours(known: Mapping[str, Label]) -> dict[str, str]:
    """Return the colours of labelled methods by name."""
    return {name: label.colour for name, label in known.items() if label.colour}


def colour(known: Mapping[str, str], name: str) -> str:
    """Return the colour of a method among the colours by name. One that is missing there follows from the name.

    Example:
        >>> colour({"gp": "#d1620f"}, "gp")
        '#d1620f'
    """
    return known.get(name) or OTHER_COLOURS[sum(name.encode()) % len(OTHER_COLOURS)]


FIELD_MODELS = {
    "swiftwrf": Label("2D Gaussians with weights that depend on the position", "#0072b2"),
    "swiftwrf_paper": Label("the paper's 2D Gaussians, deformed by a network, fitted by gradient descent", "#6b7a1f"),
    "gp": Label("a Gaussian process on the pixels", "#d1620f"),
    "coarray": Label("a Gaussian process in the space that the array's spectra can lie in", "#c04f9d"),
    "geometry": Label("image sources of the room's walls, found from the spectra", "#8b6fd0"),
    "hybrid": Label("geometry with position-dependent path gains, and a Gaussian process on the residual", "#3a7fd5"),
    "raytrace": Label("rays traced by Sionna RT, in --scene or in the room found (extra: raytrace)", "#a0623a"),
    "idw": Label("inverse-distance mean of the nearest spectra", "#1b8fa6"),
    "nearest": Label("the spectrum of the nearest measured position", "#8f7d12"),
    "nerf2": Label("a neural field summed along rays (NeRF2)", "#2a9165"),
    "wrfgs": Label("3D Gaussians drawn on the array's sphere (WRF-GS)", "#cf4a4a"),
    "vae": Label("a convolutional decoder of position and latent variables (VAE)", "#4f8f2f"),
    "dcgan": Label("a convolutional generator trained against a discriminator (DCGAN)", "#b8560f"),
}

BEAMFORMERS = {
    "phase": Label("from the phases alone, the paper's spectrum of one snapshot"),
    "bartlett": Label("the fraction of the power that a beam collects"),
    "capon": Label("minimum variance; needs as many snapshots as elements"),
}

# colours of methods whose meaning is the first line of their docstring
ESTIMATORS = {
    "kernel_regression": "#2a9165",
    "matched_field": "#d1620f",
    "nearest_spectrum": "#8f7d12",
    "constant": "#7f8794",
    "peak": "#a0623a",
    "music": "#b5539f",
    "esprit": "#3a8fb7",
    "joint_music": "#8f5fb5",
    "maximum_likelihood": "#5f8f3a",
}
PREDICTORS = {
    "swiftwrf": "#3a7fd5",
    "gp": "#2a9165",
    "mri_pooled": "#cf4a4a",
    "mri_receiver": "#d1620f",
    "mri_residual": "#8f7d12",
    "knn": "#1b8fa6",
    "mean": "#7f8794",
    "pairs": "#8b6fd0",
    "knn_pairs": "#a0623a",
    "nerf2": "#4f8f2f",
}
# Classes of coverage. Each pair differs by at least 30 in CIE Lab for every kind of colour vision.
COVERAGE = {"not measured": "#aab0b9", "not covered": "#c8501e", "uncertain": "#f2cf4a", "covered": "#1f6fb4"}
LOCALIZERS = {
    "posterior": "#3a7fd5",
    "knn": "#1b8fa6",
    "knn_difference": "#d1620f",
    "nearest": "#a0559c",
    "gp": "#2a9165",
    "mean": "#7f8794",
}


def meanings(registry: Registry[Any], known: Mapping[str, Label] = MappingProxyType({})) -> dict[str, str]:
    """Return the meanings of registered methods: of their labels, or the first lines of their docstrings."""
    return {name: known[name].meaning if name in known else registry.summary(name) for name in registry}
