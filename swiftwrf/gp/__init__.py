"""The one Gaussian process: its kernel and how it is chosen, regression, and smooth fields under its prior."""

from swiftwrf.gp.choice import choose_kernel, choose_rank, inner_products, most_informative, squared_errors, thinned
from swiftwrf.gp.field import NearbyField, SmoothField
from swiftwrf.gp.kernel import Kernel, candidates
from swiftwrf.gp.process import EXACT, GaussianProcess, NearbyProcess, held_out, held_out_errors, held_out_weights

__all__ = [
    "EXACT",
    "GaussianProcess",
    "Kernel",
    "NearbyField",
    "NearbyProcess",
    "SmoothField",
    "candidates",
    "choose_kernel",
    "choose_rank",
    "held_out",
    "held_out_errors",
    "held_out_weights",
    "inner_products",
    "most_informative",
    "squared_errors",
    "thinned",
]
