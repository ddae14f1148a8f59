"""Training sets of measured and synthetic spectra, each spectrum labelled by its origin."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from augment.positions import NO_INDEX, SyntheticPositions
from swiftwrf import AngularGrid, InputError, Spectra
from swiftwrf.array.planar import PlanarArray
from swiftwrf.data.spectra import to_directions, to_magnitudes
from swiftwrf.data.splits import MIN_TRAINING, random_rows
from swiftwrf.data.store import Store


@dataclass(frozen=True, eq=False, repr=False)
class Mixed:
    """A training set for an estimator of the direction.

    Args:
        stores: Spectra (n, H, W) in parts.
        label: Azimuth and elevation (n, 2) [rad].
        index: Number of each spectrum's position in the data set, (n,). -1 for synthetic positions outside of it.
        synthetic: Origin of each spectrum, bool (n,).
        grid: Directions of the pixels.
        array: Antenna array, if it is known.

    Raises:
        InputError: A spectrum without direction, or a direction beyond its range.

    Example:
        >>> import swiftwrf
        >>> measured, withheld = withhold(swiftwrf.simulated_room(n=40), 0.5, seed=0)
        >>> model = swiftwrf.make_model("nearest").fit(measured)
        >>> train = mix(measured, withheld, model.synthesize(withheld.position))
        >>> train
        <Mixed: 20 measured and 20 synthetic spectra of 30 x 120 directions>
    """

    stores: tuple[Store, ...]
    label: Tensor
    index: Tensor
    synthetic: Tensor
    grid: AngularGrid
    array: PlanarArray | None = None

    def __post_init__(self) -> None:
        label = to_directions("label", self.label, len(self.synthetic), missing=True)
        if unknown := int(label.isnan().any(dim=1).sum()):
            raise InputError(f"{unknown} of {len(self)} spectra have no direction; give label, or pose and moving end")

    def __len__(self) -> int:
        return len(self.label)

    def __repr__(self) -> str:
        n, (rows, columns) = int(self.synthetic.sum()), self.grid.shape
        return f"<Mixed: {len(self) - n} measured and {n} synthetic spectra of {rows} x {columns} directions>"

    @property
    def spectrum(self) -> Tensor:
        """All spectra, float32 (n, H, W)."""
        return torch.cat([store[:] for store in self.stores])

    def batches(self) -> Iterator[Tensor]:
        """Yield all spectra in order, float32, in parts that fit into memory."""
        return (batch for store in self.stores for batch in store.batches())

    @classmethod
    def measured(cls, spectra: Spectra) -> Mixed:
        """Return a training set of measured spectra alone."""
        synthetic = torch.zeros(len(spectra), dtype=torch.bool)
        return cls((spectra.store,), spectra.label.clone(), spectra.index, synthetic, spectra.grid, spectra.array)

    @property
    def counts(self) -> dict[str, int]:
        """Number of measured spectra, of synthetic spectra at withheld positions, and of those at extra positions."""
        extra = int((self.index == NO_INDEX).sum())
        synthetic = int(self.synthetic.sum())
        return {"measured": len(self) - synthetic, "withheld": synthetic - extra, "extra": extra}

    def select(self, rows: Tensor) -> Tensor:
        """Return spectra by their row numbers (m,) in any order, float32 (m, H, W)."""
        ends = torch.tensor([len(store) for store in self.stores]).cumsum(0)
        number = torch.bucketize(rows, ends, right=True)
        selected = torch.empty(len(rows), *self.grid.shape)
        for i, store in enumerate(self.stores):
            selected[number == i] = store[rows[number == i] - (int(ends[i]) - len(store))]
        return selected

    def add(self, positions: SyntheticPositions, synthetic: Tensor) -> Mixed:
        """Return the training set with spectra (n, H, W) at synthetic positions appended: magnitudes, or bytes (255 is 1).

        Raises:
            InputError: Not one spectrum for each position, another grid, or a value that is no magnitude.
        """
        values = to_magnitudes("synthetic spectra", synthetic, (len(positions), *self.grid.shape))
        return Mixed(
            (*self.stores, Store(values)),
            torch.cat([self.label, positions.label]),
            torch.cat([self.index, positions.index]),
            torch.cat([self.synthetic, torch.ones(len(values), dtype=torch.bool)]),
            self.grid,
            self.array,
        )


def withhold(train: Spectra, measured_fraction: float, seed: int) -> tuple[Spectra, SyntheticPositions]:
    """Return a random fraction of the training spectra as measured, and the positions of the others.

    Spectra at one position are in one part.

    Args:
        train: Training spectra.
        measured_fraction: Fraction of the training spectra that counts as measured, in (0, 1].
        seed: Seed of the draw.

    Raises:
        InputError: A fraction outside (0, 1], or fewer than 10 measured spectra.

    Example:
        >>> import swiftwrf
        >>> measured, withheld = withhold(swiftwrf.simulated_room(n=40), 0.3, seed=0)
        >>> len(measured), len(withheld)
        (12, 28)
    """
    if not 0 < measured_fraction <= 1:
        raise InputError(f"the measured fraction must lie in (0, 1], got {measured_fraction:g}")
    n = round(measured_fraction * len(train))
    if n < MIN_TRAINING:
        raise InputError(
            f"a measured fraction of {measured_fraction:g} leaves {n} of {len(train)} training spectra; "
            f"at least {MIN_TRAINING} are needed, a fraction of {MIN_TRAINING / max(len(train), 1):.2g}"
        )
    rows = random_rows(train.position, n, seed)
    others = train.subset(torch.ones(len(train), dtype=torch.bool).index_fill(0, rows, value=False))
    return train.subset(rows), SyntheticPositions(others.position, others.label, others.index)


def mix(measured: Spectra, withheld: SyntheticPositions, synthetic: Tensor) -> Mixed:
    """Return a training set of measured spectra, followed by synthetic spectra at the withheld positions.

    A field model fitted to `measured`, which `withhold` returns, cannot leak a withheld spectrum into the training set.

    Args:
        measured: Measured spectra.
        withheld: Positions of the synthetic spectra.
        synthetic: Synthetic spectra (n, H, W).

    Raises:
        InputError: Measured spectra without directions, or as `Mixed.add`.

    Example:
        >>> import swiftwrf
        >>> measured, withheld = withhold(swiftwrf.simulated_room(n=40), 0.5, seed=0)
        >>> model = swiftwrf.make_model("nearest").fit(measured)
        >>> mix(measured, withheld, model.synthesize(withheld.position)).label.shape
        torch.Size([40, 2])
    """
    return Mixed.measured(measured).add(withheld, synthetic)
