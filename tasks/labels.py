"""One-line meanings and colours of methods, for help texts and reports."""

from __future__ import annotations

from collections.abc import Mapping
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

ESTIMATORS = {
    "aann": Label("the paper's angular neural network: ResNet-50 and a multilayer perceptron"),
    "aann_kernel": Label("kernel regression on the features of a briefly trained ResNet-50 and on coarse pixels"),
    "kernel_regression": Label("kernel regression from the spectrum to the direction", "#2a9165"),
    "matched_field": Label(
        "the position whose spectrum, predicted by the room, matches, and its direction (matched-field processing)",
        "#d1620f",
    ),
    "nearest_spectrum": Label("the label of the most similar training spectrum", "#8f7d12"),
    "constant": Label("the mean direction of the training labels", "#7f8794"),
    "peak": Label("the strongest direction", "#a0623a"),
    "music": Label("MUSIC on the array snapshots, for one source", "#b5539f"),
    "esprit": Label("ESPRIT on the array snapshots, for one source", "#3a8fb7"),
    "joint_music": Label("MUSIC over elements and subcarriers, for the earliest path", "#8f5fb5"),
    "maximum_likelihood": Label("maximum likelihood on the array snapshots, for one source", "#5f8f3a"),
}

PREDICTORS = {
    "swiftwrf": Label(
        "50 primitives a receiver on a 16 x 16 grid, averaged, on a log-distance path-loss model; mixed with simpler "
        "predictors by cross-validation",
        "#3a7fd5",
    ),
    "gp": Label(
        "a Gaussian process on the residual of the path-loss model (or of the mean)",
        "#2a9165",
    ),
    "mri_pooled": Label("one log-distance path-loss model for all receivers of the data", "#cf4a4a"),
    "mri_receiver": Label("a log-distance path-loss model for each receiver", "#d1620f"),
    "mri_residual": Label("mri_receiver, its residual interpolated from the nearest measurements", "#8f7d12"),
    "knn": Label("inverse-distance mean of the nearest measurements", "#1b8fa6"),
    "mean": Label("the mean of the receiver's training values", "#7f8794"),
    "pairs": Label(
        "a log-distance path-loss model and a Gaussian process over the positions of both ends of the link", "#8b6fd0"
    ),
    "knn_pairs": Label("inverse-distance mean of the nearest pairs of positions", "#a0623a"),
    "nerf2": Label("a neural field for all receivers, its rays averaged (NeRF2)", "#4f8f2f"),
}

LOCALIZERS = {
    "posterior": Label(
        "the median of the posterior over positions: radio maps with their uncertainty, detections, similar training rows",
        "#3a7fd5",
    ),
    "knn": Label("the inverse-distance mean position of the k places with the most similar RSSI", "#1b8fa6"),
    "knn_difference": Label("knn on differences to the row's strongest value, without the device's offset", "#d1620f"),
    "nearest": Label("the single most similar training row by Manhattan distance, the field's benchmark", "#a0559c"),
    "gp": Label("Gaussian-process regression from RSSI to coordinates", "#2a9165"),
    "mean": Label("the mean training position", "#7f8794"),
}


def meanings(registry: Registry[Any], known: Mapping[str, Label]) -> dict[str, str]:
    """Return the meanings of registered methods. That of another package's method is the first line of its docstring."""
    return {name: known[name].meaning if name in known else registry.summary(name) for name in registry}
