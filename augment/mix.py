"""Measured and synthetic spectra at a given share, each labelled by its origin, with nothing withheld leaking in."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from augment.places import FURTHER, Places
from swiftwrf import InputError, Spectra
from swiftwrf.data.splits import MIN_TRAINING
from swiftwrf.data.store import Store


@dataclass(frozen=True, eq=False)
class Mixed:
    """A training set for an estimator of the angle of arrival.

    Args:
        stores: of the spectra (n, H, W), one after the other.
        label: azimuth and elevation [rad], (n, 2).
        index: number of each sample's place in the data set, -1 for further places, (n,).
        synthetic: origin of each spectrum: False measured, True synthesized, (n,).
    """

    stores: tuple[Store, ...]
    label: Tensor
    index: Tensor
    synthetic: Tensor

    def __len__(self) -> int:
        return len(self.label)

    @property
    def spectrum(self) -> Tensor:
        """All spectra, float32 (n, H, W)."""
        return torch.cat([store[:] for store in self.stores])

    def batches(self) -> Iterator[Tensor]:
        """All spectra in order, float32, as many at once as fit into memory."""
        return (batch for store in self.stores for batch in store.batches())

    @classmethod
    def measured(cls, spectra: Spectra) -> Mixed:
        """Measured spectra alone."""
        synthetic = torch.zeros(len(spectra), dtype=torch.bool)
        return cls((spectra.store,), spectra.label, spectra.index, synthetic)

    @property
    def counts(self) -> dict[str, int]:
        """How many spectra are measured, synthesized at withheld places, and synthesized at further ones."""
        further = int((self.index == FURTHER).sum())
        synthetic = int(self.synthetic.sum())
        return {"measured": len(self) - synthetic, "withheld": synthetic - further, "further": further}

    def add(self, places: Places, synthetic: Tensor) -> Mixed:
        """With synthetic spectra (n, H, W) at these places, after those there are; magnitudes, or bytes, where 255 is 1.

        Raises:
            InputError: another number of spectra than places.
        """
        if len(synthetic) != len(places):
            raise InputError(f"expected one synthetic spectrum for each of {len(places)} places, got {len(synthetic)}")
        return Mixed(
            (*self.stores, Store(synthetic)),
            torch.cat([self.label, places.label]),
            torch.cat([self.index, places.index]),
            torch.cat([self.synthetic, torch.ones(len(synthetic), dtype=torch.bool)]),
        )


def withhold(train: Spectra, share: float, seed: int) -> tuple[Spectra, Places]:
    """A random `share` of the training spectra as measured, and the places of the others.

    Raises:
        InputError: a share outside (0, 1]; fewer than 10 measured spectra left.
    """
    if not 0 < share <= 1:
        raise InputError(f"the measured share must lie in (0, 1], got {share:g}")
    n = round(share * len(train))
    if n < MIN_TRAINING:
        raise InputError(
            f"a measured share of {share:g} leaves {n} of {len(train)} training spectra; "
            f"at least {MIN_TRAINING} are needed, a share of {MIN_TRAINING / len(train):.2g}"
        )
    order = torch.randperm(len(train), generator=torch.Generator().manual_seed(seed))
    measured, others = train.subset(order[:n].sort().values), train.subset(order[n:].sort().values)
    return measured, Places(others.position, others.label, others.index)


def mix(measured: Spectra, withheld: Places, synthetic: Tensor) -> Mixed:
    """Measured spectra, and synthetic ones (n, H, W) at the withheld places, in this order.

    The synthesizer that drew them was fitted on `measured` alone, which is all that `withhold` hands out.

    Raises:
        InputError: another number of spectra than places.
    """
    return Mixed.measured(measured).add(withheld, synthetic)
