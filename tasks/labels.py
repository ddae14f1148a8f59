"""One-line meanings and colours of methods, for help texts and reports."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from swiftwrf.runtime.registry import Registry

# colour-blind safe (P. Tol, "bright"), for methods of other packages
OTHER_COLOURS = ("#ee6677", "#228833", "#ccbb44", "#66ccee", "#aa3377", "#bbbbbb")


@dataclass(frozen=True)
class Label:
    """How a method is shown.

    Args:
        meaning: One line.
        colour: `#rrggbb`. None for one that follows from the name.
    """

    meaning: str
    colour: str | None = None


FIELD_MODELS = {
    "swiftwrf": Label("2D Gaussians that deform with the position", "#4477aa"),
    "gp": Label("a Gaussian process on the pixels", "#ee8866"),
    "coarray": Label("a Gaussian process in the space that the array's spectra can lie in", "#aa3377"),
    "geometry": Label("image sources of the room's walls, found from the spectra", "#3366ff"),
    "hybrid": Label("geometry with position-dependent path gains, and a Gaussian process on the residual", "#332288"),
    "raytrace": Label("rays traced by Sionna RT, in --scene or in the room found (extra: raytrace)", "#994455"),
    "idw": Label("inverse-distance mean of the nearest spectra", "#66ccee"),
    "nearest": Label("the spectrum of the nearest measured position", "#ccbb44"),
    "nerf2": Label("a neural field summed along rays (NeRF2)", "#44aa99"),
    "wrfgs": Label("3D Gaussians drawn on the array's sphere (WRF-GS)", "#882255"),
    "vae": Label("a convolutional decoder of position and latent variables (VAE)", "#999933"),
    "dcgan": Label("a convolutional generator trained against a discriminator (DCGAN)", "#661100"),
}

BEAMFORMERS = {
    "phase": Label("from the phases alone, the paper's spectrum of one snapshot"),
    "bartlett": Label("the fraction of the power that a beam collects"),
    "capon": Label("minimum variance; needs as many snapshots as elements"),
}

ESTIMATORS = {
    "aann": Label("the paper's angular neural network: ResNet-50 and a multilayer perceptron"),
    "aann_kernel": Label("kernel regression on the features of a briefly trained ResNet-50 and on coarse pixels"),
    "kernel_regression": Label("kernel regression from the spectrum to the direction", "#44aa99"),
    "matched_field": Label(
        "the position whose spectrum, predicted by the room, matches, and its direction (matched-field processing)",
        "#ddaa33",
    ),
    "nearest_spectrum": Label("the label of the most similar training spectrum", "#666666"),
    "constant": Label("the mean direction of the training labels", "#999999"),
    "peak": Label("the strongest direction", "#bbbbbb"),
    "music": Label("MUSIC on the array snapshots, for one source", "#aa4499"),
    "esprit": Label("ESPRIT on the array snapshots, for one source", "#88ccee"),
    "maximum_likelihood": Label("maximum likelihood on the array snapshots, for one source", "#117733"),
}

PREDICTORS = {
    "swiftwrf": Label(
        "50 primitives a receiver on a 16 x 16 grid, averaged, on a log-distance path-loss model; mixed with simpler "
        "predictors by cross-validation",
        "#4477aa",
    ),
    "gp": Label(
        "a Gaussian process on the residual of the path-loss model (or of the mean)",
        "#228833",
    ),
    "mri_pooled": Label("one log-distance path-loss model for all receivers of the data", "#ee6677"),
    "mri_receiver": Label("a log-distance path-loss model for each receiver", "#ee8866"),
    "mri_residual": Label("mri_receiver, its residual interpolated from the nearest measurements", "#ccbb44"),
    "knn": Label("inverse-distance mean of the nearest measurements", "#66ccee"),
    "mean": Label("the mean of the receiver's training values", "#bbbbbb"),
    "pairs": Label(
        "a log-distance path-loss model and a Gaussian process over the positions of both ends of the link", "#332288"
    ),
    "knn_pairs": Label("inverse-distance mean of the nearest pairs of positions", "#999933"),
    "nerf2": Label("a neural field for all receivers, its rays averaged (NeRF2)", "#44aa99"),
    "blend": Label("a weighted mean of other predictors, weights by cross-validation", "#aa3377"),
}

LOCALIZERS = {
    "posterior": Label(
        "the median of the posterior over positions: radio maps with their uncertainty, detections, similar training rows",
        "#4477aa",
    ),
    "knn": Label("the inverse-distance mean position of the k training rows with the most similar RSSI", "#66ccee"),
    "knn_difference": Label("knn on differences to the row's strongest value, without the device's offset", "#ee8866"),
    "gp": Label("Gaussian-process regression from RSSI to coordinates", "#228833"),
    "mean": Label("the mean training position", "#bbbbbb"),
}


def labels(registry: Registry[Any], known: dict[str, Label], names: Iterable[str] | None = None) -> dict[str, Label]:
    """Return the labels of registered methods; a method of another package has the first line of its docstring.

    Args:
        registry: Registry of the methods.
        known: Labels of the methods of this package.
        names: Methods, all registered ones by default. Names that are not registered are left out.
    """
    found = registry if names is None else [name for name in names if name in registry]
    return {name: known.get(name) or Label(registry.summary(name)) for name in found}
