"""Options of the RSSI model."""

from __future__ import annotations

from typing import Annotated

from annotated_types import Ge

from swiftwrf.choices import NotDetected
from swiftwrf.data.splits import Validation
from swiftwrf.models.base import FieldConfig
from swiftwrf.runtime.validation import NonNegativeInt, PositiveFloat, configuration


@configuration
class RssiConfig(FieldConfig):
    """Options of `RssiModel`. The defaults have the lowest error on held-out training rows.

    Example:
        >>> RssiConfig(validation="block").n_primitives
        50
    """

    n_primitives: NonNegativeInt = 50
    """primitives a receiver; 0 for a path-loss model without a field, which a fit also takes if it predicts held-out rows as
    well"""
    huber: PositiveFloat = 1.345
    """number of standard deviations of the noise beyond which an error counts linearly (Huber's constant: 95 % efficient
    for Gaussian noise), since packets have outliers"""
    max_locations: Annotated[int, Ge(10)] = 1500
    """location bins that the rows are averaged in; the time of a fit grows with the cube of their number. With 1,000
    held-out errors are 6 % larger on gsm-recife and 0.2 % on kolak"""
    not_detected: NotDetected = "auto"
    """meaning of an empty cell.

    - "weak": the power was below the limit of detection.
    - "unknown": the cell is ignored.
    - "auto": if rows list the strongest or the associated receivers only (`Rssi.margin_db`), the power was below the listed
      ones. Otherwise "weak" at each receiver whose empty cells are where its path loss expects no value, else "unknown". It
      is "unknown" at all receivers if values and detections of 12 of them in held-out folds are then more likely.

    Only the path loss counts the empty cells of a receiver with fewer than 10 values"""
    calibration: Validation | None = None
    """folds whose errors scale the standard deviations. Defaults to those of `validation`. "block" suits predictions for
    other days or devices, whose errors no fold of single rows contains"""
    noises: tuple[PositiveFloat, ...] = (0.03, 0.1, 0.3, 1.0, 2.0, 3.0)
    """compared variances of one measurement about the field, relative to that of the field. Fading of a packet is about as
    large as shadowing. Means of many packets have less noise"""
    least_noise_with_limits: PositiveFloat = 0.3
    """smallest of these variances where empty cells are upper limits; if all are smaller, their largest. With less, weak
    cells of simulated surveys were predicted 2.6 dB too strong in place of 1.6"""
