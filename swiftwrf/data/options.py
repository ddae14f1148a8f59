"""Options of reading survey tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from swiftwrf.data.coordinates import Coordinates, Up
from swiftwrf.data.powers import RSSI_UNITS
from swiftwrf.errors import InputError
from swiftwrf.runtime.validation import PositiveFloat, configuration


@configuration
class TableOptions:
    """Options of reading tables, with the meaning that `load_rssi` describes.

    Example:
        >>> TableOptions(filler=[0, 100]).filler
        (0.0, 100.0)
    """

    columns: Mapping[str, str] | None = None
    filler: Sequence[float] | None = None
    coordinates: Coordinates | None = None
    offset_by: str | None = None
    transmitter: Sequence[str] = ()
    pool_by: str | None = None
    scale: PositiveFloat | None = None
    y_down: bool = False
    up: Up = "z"
    window: PositiveFloat | None = None
    quantity: str | None = None
    unit: str | None = None
    receiver_positions: Path | str | None = None

    def check(self) -> None:
        """Keep lists as tuples, which compare as a whole.

        Raises:
            InputError: A quantity without a unit or the reverse, or pools of another quantity than power.
        """
        if (self.quantity is None) != (self.unit is None) and (self.quantity or self.unit not in RSSI_UNITS):
            raise InputError(
                "quantity and unit belong together, e.g. throughput and Mbps; give both, or for RSSI one of the units "
                f"{', '.join(RSSI_UNITS)}"
            )
        if self.quantity is not None and self.pool_by is not None:
            raise InputError(f"pool_by pools received powers, but the quantity is {self.quantity}; leave it out")
        object.__setattr__(self, "filler", None if self.filler is None else tuple(map(float, self.filler)))
        object.__setattr__(self, "transmitter", tuple(self.transmitter))
