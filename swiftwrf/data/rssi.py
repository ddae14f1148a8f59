"""Received power at fixed receivers, measured at known positions of the transmitter."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from torch import Tensor

from swiftwrf.data.splits import MIN_TRAINING, choose_split
from swiftwrf.errors import InputError, listed


@dataclass(frozen=True, eq=False)
class Rssi:
    """RSSI of a moving transmitter at fixed receivers.

    Args:
        name: of the data set.
        receiver_names: R names, in file order.
        receiver_position: float64 (R, 3) [m]; nan where it is unknown, for all receivers or none.
        transmitter_position: float64 (n, 3) [m].
        rssi_dbm: float64 (n, R) [dBm], nan where the receiver did not hear the transmitter.
        index: number of each row in the data set, counted from 0, int64 (n,).
        named_splits: training and test rows of the splits that came with the data.
        source: sha256 of each file that says what the data are, by file name.
        notes: what the reader found or did that a user should know, a sentence each.
    """

    name: str
    receiver_names: tuple[str, ...]
    receiver_position: Tensor
    transmitter_position: Tensor
    rssi_dbm: Tensor
    index: Tensor
    named_splits: dict[str, tuple[Tensor, Tensor]] = field(default_factory=dict)
    source: dict[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.transmitter_position)

    @property
    def located(self) -> bool:
        """Whether the positions of the receivers are known."""
        return bool(self.receiver_position.isfinite().all())

    def subset(self, rows: Tensor) -> Rssi:
        """The given rows, in the given order; splits named for the whole set are dropped."""
        return replace(
            self,
            transmitter_position=self.transmitter_position[rows],
            rssi_dbm=self.rssi_dbm[rows],
            index=self.index[rows],
            named_splits={},
        )

    def split(self, name: str = "random", seed: int = 0) -> tuple[Rssi, Rssi]:
        """Training and test part: a split that came with the data, or a seeded `random` or `block` one.

        Raises:
            InputError: an unknown name; fewer than 10 training rows.
        """
        train, test = choose_split(name, seed, self.transmitter_position, self.named_splits, self.name)
        return self.subset(train), self.subset(test)

    def receivers(self, asked: Sequence[str]) -> Rssi:
        """Only the receivers asked for: names, numbers counted from 1 in file order, or `all`, which leaves out those that
        were heard in fewer than 10 rows and says so in `notes`.

        Raises:
            InputError: a receiver that there is not, one asked for twice, or one heard in fewer than 10 rows.
        """
        if list(asked) == ["all"]:
            return self._heard_enough()
        columns = [self._column(a) for a in asked]
        if not columns or len(set(columns)) < len(columns):
            raise InputError(f"ask for each receiver once, got {' '.join(asked) or 'none'}")
        for column in columns:
            heard = int((~self.rssi_dbm[:, column].isnan()).sum())
            if heard < MIN_TRAINING:
                raise InputError(
                    f"receiver {self.receiver_names[column]!r} of {self.name} was heard in {heard} rows; "
                    f"at least {MIN_TRAINING} are needed"
                )
        return self.columns(columns)

    def _heard_enough(self) -> Rssi:
        enough = (~self.rssi_dbm.isnan()).sum(dim=0) >= MIN_TRAINING
        if not bool(enough.any()):
            raise InputError(f"no receiver of {self.name} was heard in {MIN_TRAINING} rows")
        found = self.columns(enough.nonzero()[:, 0].tolist())
        rare = [name for name, heard in zip(self.receiver_names, enough.tolist(), strict=True) if not heard]
        if not rare:
            return found
        note = f"receivers heard in fewer than {MIN_TRAINING} rows are left out: {listed(rare)}"
        return replace(found, notes=(*found.notes, note))

    def columns(self, columns: list[int]) -> Rssi:
        """The receivers of these columns, in this order."""
        return replace(
            self,
            receiver_names=tuple(self.receiver_names[c] for c in columns),
            receiver_position=self.receiver_position[columns],
            rssi_dbm=self.rssi_dbm[:, columns],
        )

    def _column(self, asked: str) -> int:
        if asked in self.receiver_names:
            return self.receiver_names.index(asked)
        if asked.isdecimal() and 1 <= int(asked) <= len(self.receiver_names):
            return int(asked) - 1
        listed = ", ".join(f"{i} {name}" for i, name in enumerate(self.receiver_names, start=1))
        raise InputError(f"{self.name} has no receiver {asked!r}; there are {listed}")
