"""Options of the RSSI model."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Any

from annotated_types import Ge

from swiftwrf.models.base import FieldConfig
from swiftwrf.runtime.validation import NonNegativeInt, PositiveFloat, PositiveInt, configuration


@configuration
class RssiConfig(FieldConfig):
    """Options of `RssiModel`. The defaults have the lowest error on held-out training rows.

    Example:
        >>> RssiConfig.paper(steps=100).paper_head
        True
    """

    n_primitives: NonNegativeInt = 50
    """primitives a receiver; a fit uses none if the path-loss model predicts held-out rows as well as a field"""
    huber: PositiveFloat = 1.345
    """number of standard deviations of the noise beyond which an error counts linearly (Huber's constant: 95 % efficient
    for Gaussian noise), since packets have outliers"""
    max_locations: Annotated[int, Ge(10)] = 1500
    """location bins that the rows are averaged in; the time of a fit grows with the cube of their number"""
    paper_head: bool = False
    """the head of the paper, rssi = 100 (mean magnitude - 1), its primitives learnt by gradient descent; otherwise fixed
    primitives on a path-loss model with directivity, fitted by iteratively reweighted least squares"""
    steps: PositiveInt = 600
    """gradient steps of the paper's head"""
    batch: PositiveInt = 1024
    """location bins a gradient step"""
    rate: PositiveFloat = 5e-2
    """learning rate of a gradient step"""

    @classmethod
    def paper(cls, **changes: Any) -> RssiConfig:
        """Return the paper's head: 50 learnt primitives a receiver, and their mean magnitude only.

        The paper leaves the scale of its target open. This is the scale of NeRF2.
        """
        return replace(cls(paper_head=True), **changes)
