"""Gaussian processes over positions: the kernel and its choice, regression, and principal components."""

from swiftwrf.gp.choice import choose_kernel, inner_products, most_informative, principal_components, subsample
from swiftwrf.gp.process import GaussianProcess, Kernel, candidates, dense_weights, held_out_errors, leave_folds_out

__all__ = ["GaussianProcess", "Kernel", "candidates", "choose_kernel", "dense_weights", "held_out_errors"]
__all__ += ["inner_products", "leave_folds_out", "most_informative", "principal_components", "subsample"]
