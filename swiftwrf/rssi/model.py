"""RSSI from SwiftWRF: for each receiver a small spectrum that moves with the transmitter, averaged to one number.

    rssi_r(s) = T_r - 10 gamma_r log10 |s - receiver_r| + directivity_r(s) + pooled_r(c_r(s)) - pooled_r(0)       [dBm]

pooled_r is the averaged magnitude of receiver r's primitives on a 16 x 16 grid (`swiftwrf.rssi.head`), c_r a smooth function
of position that moves their responses, and the directivity a few harmonics of the direction from the receiver. The plain
head of the paper is -100 + pooled_r(c_r(s)).
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields
from functools import cached_property
from typing import ClassVar

import torch
from torch import Tensor

from swiftwrf.errors import InputError
from swiftwrf.gp import Kernel
from swiftwrf.positions import check_batch, check_positions
from swiftwrf.rssi.head import Table
from swiftwrf.rssi.law import harmonics, log_distance
from swiftwrf.rssi.uncertainty import Known
from swiftwrf.runtime.checkpoint import Header, Saved
from swiftwrf.runtime.threads import single_thread

FARTHEST = 1e9  # [m] from the measurements: beyond, single precision ends, and so does any receiver's reach


@dataclass(frozen=True, eq=False)
class RssiModel(Saved):
    """RSSI at R receivers for any position of the transmitter; what `fit_rssi` returns.

    Args:
        receiver_names: in the order of the columns.
        n_primitives: a receiver; 0 where the law is all.
        kernel: of the motion, lengths in [m].
        weight: of the field, the receiver's law, the law of all receivers and the receiver's mean in the prediction, (4,);
            it is worked into the tensors below.
        receiver: positions, float64 (R, 3) [m].
        centre: of the measured positions, float64 (3,) [m].
        level, slope: float64 (R,) [dBm], [dB a decade].
        directivity: (R, 8) [dB].
        anchor: positions of the motion's coefficients, less the centre, (n, 3) [m].
        coefficient: (n, R) [dB].
        drawn: fields of the head, (R, 2, 2, directions).
        offset: what is taken from the averaged magnitude, (R,) [dB].
        share: of the head's change in the prediction, (1,).
        known_position, known_root: of `swiftwrf.rssi.uncertainty.Known`.
        field_db, noise_db: deviation of the field under its prior, and of a measurement about it, (R,).
        widening: half of the interval in deviations, (1,).
    """

    kind: ClassVar[str] = "rssi model"

    receiver_names: tuple[str, ...]
    n_primitives: int
    kernel: Kernel
    weight: Tensor
    receiver: Tensor
    centre: Tensor
    level: Tensor
    slope: Tensor
    directivity: Tensor
    anchor: Tensor
    coefficient: Tensor
    drawn: Tensor
    offset: Tensor
    share: Tensor
    known_position: Tensor
    known_root: Tensor
    field_db: Tensor
    noise_db: Tensor
    widening: Tensor

    @cached_property
    def _table(self) -> Table:
        return Table(self.drawn)

    def motion(self, position: Tensor) -> Tensor:
        """c of each receiver at positions (n, 3) less the centre, (n, R) [dB]."""
        return self.kernel(position, self.anchor) @ self.coefficient

    @torch.no_grad()
    @single_thread()
    def predict(self, position: Tensor, batch: int = 512) -> tuple[Tensor, Tensor, Tensor]:
        """RSSI at any positions, with an interval for a measurement there.

        Args:
            position: of the transmitter [m], (n, 3).
            batch: positions at a time, so many that they stay in the processor's cache.

        Returns:
            Prediction, lower and upper end of the interval, each float32 (n, R) [dBm].

        Raises:
            InputError: positions of another shape, not finite, or more than a million kilometres away; a batch below 1.
        """
        position = check_positions(position)
        check_batch(batch)
        away = (position - self.centre).abs().amax() if len(position) else torch.zeros(())
        if away > FARTHEST:
            raise InputError(
                f"a position is {float(away):.3g} m away from the measurements; at most {FARTHEST:g} m make sense"
            )
        middle = torch.empty(len(position), len(self.receiver_names))
        deviation = torch.empty_like(middle)
        for start in range(0, len(position), batch):
            rows = slice(start, start + batch)
            local = (position[rows] - self.centre).float()
            middle[rows] = self._prediction(position[rows], local)
            deviation[rows] = self._deviation(local)
        half = self.widening * deviation
        return middle, middle - half, middle + half

    def _prediction(self, position: Tensor, local: Tensor) -> Tensor:
        law = self.level + self.slope * log_distance(position, self.receiver)
        bearing = harmonics(local, (self.receiver - self.centre).float())
        head = self._table(self.motion(local))[0] - self.offset
        return law.float() + torch.einsum("brh,rh->br", bearing, self.directivity) + self.share * head

    def _deviation(self, local: Tensor) -> Tensor:
        """Of a measurement about the prediction, (n, R) [dB]: noise, and the field's uncertainty, which grows away from
        measured positions."""
        unknown = Known(self.known_position, self.known_root).unknown(local, self.kernel)
        return (self.noise_db.square() + self.field_db.square() * unknown[:, None]).sqrt()

    def state(self) -> tuple[dict[str, Tensor], Header]:
        tensors = {name: value for name, value in vars(self).items() if isinstance(value, Tensor)}
        header = {
            "receiver_names": self.receiver_names,
            "n_primitives": self.n_primitives,
            "kernel": asdict(self.kernel),
        }
        return tensors, header

    @classmethod
    def from_state(cls, tensors: dict[str, Tensor], header: Header) -> RssiModel:
        own = {field.name: tensors[field.name] for field in fields(cls) if field.name in tensors}
        return cls(tuple(header["receiver_names"]), header["n_primitives"], Kernel(**header["kernel"]), **own)
