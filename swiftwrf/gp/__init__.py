"""Gaussian processes over positions: the kernel and its choice, regression, and principal components."""

from swiftwrf.gp.choice import choose_kernel, choose_rank, inner_products, most_informative, squared_errors, subsample
from swiftwrf.gp.kernel import Kernel, candidates
from swiftwrf.gp.pca import Components, principal_components
from swiftwrf.gp.process import GaussianProcess, LeaveGroupOut, dense_weights, held_out, held_out_neighbours

__all__ = [
    "Components",
    "GaussianProcess",
    "Kernel",
    "LeaveGroupOut",
    "candidates",
    "choose_kernel",
    "choose_rank",
    "dense_weights",
    "held_out",
    "held_out_neighbours",
    "inner_products",
    "most_informative",
    "principal_components",
    "squared_errors",
    "subsample",
]
