"""Spectra of several stations: one transmission, received by all of them or by some."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from swiftwrf.choices import Moving
from swiftwrf.data.dataset import Arrays, PositionedData
from swiftwrf.data.spectra import Spectra
from swiftwrf.errors import InputError
from swiftwrf.runtime.validation import checked

MAX_DIFFERENCE_M = 1e-3  # of the positions of one transmission in the data of two stations, from rounding


@dataclass(frozen=True, eq=False, init=False, repr=False)
class Stations(PositionedData):
    """Spectra of several stations at n positions of the moving end of their links.

    A station is a fixed array that receives a moving transmitter, or a fixed transmitter that a moving array receives.
    Arrays, carriers and grids may differ between stations. No phase or delay between stations is used.

    Args:
        spectra: Spectra of each station by its name. Rows with equal `index` are one transmission. A station that did not
            receive a transmission has no row of it.
        name: Name of the data set.
        details: named_splits, source and notes of `PositionedData`. Defaults to those of the stations.

    Raises:
        InputError: No station, a station with two rows of one transmission, positions of one transmission that differ, or
            stations of which some move and others do not.

    Example:
        >>> import swiftwrf
        >>> first = swiftwrf.simulated_room(n=20)
        >>> data = Stations({"east": first, "west": first[5:]})
        >>> len(data), data.received.sum(dim=0).tolist()
        (20, [20, 15])
    """

    position: Tensor
    """positions of the moving end, float64 (n, 3) [m]"""
    row: Tensor
    """row of each transmission in the spectra of each station, int64 (n, A); -1 where a station did not receive it"""
    spectra: dict[str, Spectra]

    row_fields: ClassVar[tuple[str, ...]] = ("position", "row", "index")

    @checked
    def __init__(self, spectra: Mapping[str, Spectra], *, name: str = "stations", **details: Any) -> None:
        if not spectra:
            raise InputError("Stations takes the spectra of one station or more by name, got none")
        if len(moving := {each.moving for each in spectra.values()}) > 1:
            raise InputError(
                f"the moving end of all stations of {name} must be the same, got {' and '.join(sorted(moving))}"
            )
        index = torch.cat([each.index for each in spectra.values()]).unique()
        row = torch.full((len(index), len(spectra)), -1)
        position = torch.full((len(index), 3), torch.nan, dtype=torch.float64)
        for number, (station, each) in enumerate(spectra.items()):
            at = torch.searchsorted(index, each.index)
            if len(at.unique()) < len(at):
                raise InputError(f"station {station!r} of {name} has two rows of one transmission; give each an index")
            away = (position[at] - each.position).norm(dim=1).nan_to_num(0.0)
            if len(at) and float(away.max()) > MAX_DIFFERENCE_M:
                raise InputError(
                    f"transmission {int(each.index[away.argmax()])} of {name} is {float(away.max()):.3g} m away at station "
                    f"{station!r} from where another station has it; rows of equal index are one transmission"
                )
            row[at, number], position[at] = torch.arange(len(at)), each.position
        first = next((each for each in spectra.values() if len(each) == len(index)), None)
        given: dict[str, Any] = {
            "named_splits": {} if first is None else _by_transmission(first, index),
            "source": {
                f"{station}/{file}": sha for station, each in spectra.items() for file, sha in each.source.items()
            },
            "notes": tuple(f"{station}: {note}" for station, each in spectra.items() for note in each.notes),
        }
        super().__init__(name, index, position=position, row=row, **given | details)
        object.__setattr__(self, "spectra", dict(spectra))

    @property
    def names(self) -> list[str]:
        """Names of the stations."""
        return list(self.spectra)

    @property
    def moving(self) -> Moving:
        """The end that moves: "transmitter" or "receiver"."""
        return next(iter(self.spectra.values())).moving

    @property
    def received(self) -> Tensor:
        """True where a station received a transmission, bool (n, A)."""
        return self.row >= 0

    def of(self, station: str) -> tuple[Tensor, Spectra]:
        """Return the numbers of the rows that a station received, int64 (m,), and its spectra of these rows.

        Raises:
            InputError: No station of this name.
        """
        if station not in self.spectra:
            raise InputError(f"{self.name} has no station {station!r}; choose one of {', '.join(self.spectra)}")
        row = self.row[:, self.names.index(station)]
        received = (row >= 0).nonzero()[:, 0]
        return received, self.spectra[station].subset(row[received])

    def only(self, *stations: str) -> Stations:
        """Return the same transmissions with some stations, of which none may have received some.

        Raises:
            InputError: No station of a name.
        """
        for station in stations:
            self.of(station)
        chosen = torch.tensor([self.names.index(station) for station in stations])
        spectra = {station: self.spectra[station] for station in stations}
        return self.derived(row=self.row[:, chosen], spectra=spectra)

    def _columns(self) -> dict[str, Any]:
        return {f"received_{name}": column.numpy() for name, column in zip(self.spectra, self.received.T, strict=True)}

    def coordinates(self) -> Arrays:
        return super().coordinates() | {"station": (("station",), self.names)}

    def variables(self) -> Arrays:
        return {"received": (("position", "station"), self.received.numpy())}

    def _summary(self) -> str:
        return f"{len(self)} transmissions at {len(self.spectra)} stations ({', '.join(self.spectra)}), moving {self.moving}"


def _by_transmission(spectra: Spectra, index: Tensor) -> dict[str, tuple[Tensor, Tensor]]:
    """Return the splits of a station that received all transmissions as splits of these."""
    number = torch.searchsorted(index, spectra.index)
    return {name: (number[train], number[test]) for name, (train, test) in spectra.named_splits.items()}
