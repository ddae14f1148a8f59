"""Position of the transmitter from its RSSI, by the radio maps of all receivers."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, ClassVar, Self

import numpy as np
import torch
from annotated_types import Ge, Le
from torch import Tensor

from swiftwrf.data.dataset import Numbers
from swiftwrf.data.powers import MAX_RSSI_DBM, MIN_RSSI_DBM, check_powers
from swiftwrf.data.rssi import Rssi
from swiftwrf.data.splits import FOLDS, Validation, folds
from swiftwrf.errors import InputError
from swiftwrf.locate.posterior import HeldOut, Inflation, PoolWeights, Posterior, calibrated_pool, normalised
from swiftwrf.locate.region import Region, outside_mass
from swiftwrf.locate.rssi_likelihood import (
    DetectionLikelihood,
    FingerprintLikelihood,
    Fingerprints,
    Maps,
    RssiLikelihoods,
    ValueLikelihood,
    Votes,
    maps_at,
)
from swiftwrf.positions import to_tensor
from swiftwrf.rssi import RssiModel
from swiftwrf.rssi.detection import Detection
from swiftwrf.runtime.checkpoint import Saved
from swiftwrf.runtime.progress import progress as tracked
from swiftwrf.runtime.validation import NonNegativeInt, PositiveInt, all_or_nothing, checked, configuration

MAX_HELD_OUT = 2000  # rows that determine the distributions
BATCH_ROWS = 128  # rows whose posteriors are in memory together


@configuration
class RssiLocatorConfig:
    """Options of the locator."""

    validation: Validation = "random"
    """training rows held out to calibrate: single ones at random, or one region at a time"""
    n_cells: Annotated[int, Ge(1), Le(1_000_000)] = 4000
    """candidate positions"""
    n_calibration: PositiveInt = 600
    """held-out rows that determine the weights of the likelihoods, at most"""
    seed: NonNegativeInt = 0
    """seed of everything random"""


@dataclass(frozen=True, eq=False)
class _Part:
    """Some rows of a held-out fold, and what follows from the other folds."""

    rssi: Tensor
    position: Tensor
    region: Region
    model: RssiModel
    maps: Maps
    fingerprints: Fingerprints
    votes: Votes


class RssiLocator(Saved):
    """Posterior over the position of the transmitter, given its RSSI at the receivers.

    Three likelihoods are pooled: the values under the radio maps with their uncertainty and a common offset of a row, which
    receivers detect the transmitter at all, and the position of similar training rows. Held-out rows determine their
    distributions, weights, and the radii of credible regions. So 80 % of the positions are in their regions, on average over
    rows that are as far from the training rows as `validation` states. A single region of a block may have 50 to 95 %. Rows
    with more scatter, e.g. single packets where the training rows are averages, need larger radii. In a building with floors
    the candidate positions are on the floors.

    The options are those of `RssiLocatorConfig`.

    Example:
        >>> import swiftwrf
        >>> train, test = swiftwrf.rssi_room(n=100).split()
        >>> posterior = RssiLocator(n_cells=500).fit(train).locate(test.rssi_dbm)
        >>> posterior.median.shape
        torch.Size([20, 3])
    """

    kind: ClassVar[str] = "RSSI locator"
    config_type: ClassVar[type[RssiLocatorConfig]] = RssiLocatorConfig
    fitted_attribute = "_maps"
    config: RssiLocatorConfig

    saved = "model likelihoods region weight inflation"
    model: RssiModel
    """radio maps of the receivers, set by `fit`"""
    likelihoods: Annotated[RssiLikelihoods, "r=model.r"]
    """likelihoods that are pooled, set by `fit`"""
    region: Region
    """prior over positions, set by `fit`"""
    weight: PoolWeights
    """weights of the likelihoods, float64 (3,), set by `fit`"""
    inflation: Inflation
    """factor of the credible radii, set by `fit`"""
    receiver_names: tuple[str, ...]
    """names of the receivers, set by `fit`"""
    held_out_m: dict[str, float]
    """mean errors [m] of the posterior and of the mean training position at held-out rows, set by `fit`, not saved"""

    @all_or_nothing
    @checked
    def fit(
        self, train: Rssi, *, model: RssiModel | None = None, region: Region | None = None, progress: bool = False
    ) -> Self:
        """Fit the likelihoods to measured rows and return the locator.

        Args:
            train: Measured rows, at least 10.
            model: Radio maps fitted to rows at the same receivers. Fitted by default.
            region: Prior over positions. Defaults to the neighbourhood of the training positions, with the mass outside from
                held-out ones.
            progress: Show a progress bar on a terminal.

        Raises:
            InputError: Too few rows or positions, or a model of other receivers.
        """
        config = self.config
        if model is not None:
            train = model.aligned(train)
        self.receiver_names = train.receiver_names
        self.model = model or self._radio_maps(train)
        known = train.transmitter_position
        fold = folds(known, config.validation, config.seed, session=train.session)
        fingerprints = Fingerprints.fit(train, fold, config.seed)
        numbers = tracked(fold.unique().tolist(), "held-out folds", progress)
        parts = [self._part(train, fold, number, fingerprints) for number in numbers]
        prior = region or Region(
            known,
            0.25 if config.validation == "block" else 0.03,  # a block of a fifth may lie beyond the known positions
            outside_mass([part.region for part in parts], [part.position for part in parts]),
        )
        self.region = replace(prior, floors=train.floors)
        self.cells = self.region.cells(config.n_cells)
        self._maps = maps_at(self.model, self.cells.position)
        curve = Detection.estimate(train.transmitter_position, train.rssi_dbm)
        limit = torch.zeros(len(self.receiver_names)).double() if curve is None else curve.limit
        self.likelihoods = self._fitted(parts, fingerprints, limit)
        self._calibrate(parts, limit)
        return self

    def _fitted(self, parts: list[_Part], fingerprints: Fingerprints, limit: Tensor) -> RssiLikelihoods:
        """Return the likelihoods by some fingerprints, with the distributions of the errors in held-out folds."""
        rssi, position = (torch.cat([getattr(part, name) for part in parts]) for name in ("rssi", "position"))
        mean, std = (torch.cat(values) for values in zip(*(part.maps for part in parts), strict=True))
        part, centre, estimate = (torch.cat(values) for values in zip(*(part.votes for part in parts), strict=True))
        # positions are measured to a few centimetres at best
        smallest_m = max(self.cells.edge_m, 0.05)
        return RssiLikelihoods(
            ValueLikelihood.fit((mean, std), rssi),
            DetectionLikelihood.fit(mean, ~rssi.isnan(), limit),
            FingerprintLikelihood.fit(fingerprints, (part, centre, estimate), position, smallest_m),
        )

    def _radio_maps(self, train: Rssi) -> RssiModel:
        # which receivers detect the transmitter is a likelihood of its own
        return RssiModel(validation=self.config.validation, seed=self.config.seed, not_detected="unknown").fit(train)

    def _part(self, train: Rssi, fold: Tensor, number: int, fingerprints: Fingerprints) -> _Part:
        generator = torch.Generator().manual_seed(self.config.seed)
        out, kept = ((fold == number) & train.detected.any(dim=1)).nonzero()[:, 0], train.subset(fold != number)
        out = out[torch.randperm(len(out), generator=generator)[: MAX_HELD_OUT // FOLDS]]
        rssi, position = train.rssi_dbm[out], train.transmitter_position[out]
        model = self._radio_maps(kept)
        found = Fingerprints.of(kept, fingerprints.metric, fingerprints.k)
        region = Region(kept.transmitter_position, floors=train.floors)
        return _Part(rssi, position, region, model, maps_at(model, position), found, found.votes(rssi))

    def _calibrate(self, parts: list[_Part], limit: Tensor) -> None:
        """Choose the weights of the likelihoods and the factor of credible radii by held-out positions.

        The distributions for each fold are those of the other folds.
        """
        held_out, from_mean = [], []
        for part in parts:
            likelihoods = self._fitted([other for other in parts if other is not part], part.fingerprints, limit)
            some = slice(-(-self.config.n_calibration // len(parts)))
            rssi, at, (mean, std) = part.rssi[some], part.position[some], part.maps
            values = likelihoods(self.cells.position, maps_at(part.model, self.cells.position), rssi)
            at_truth = likelihoods(at, (mean[some], std[some]), rssi).diagonal(dim1=1, dim2=2)
            prior = replace(part.region, margin=self.region.margin, outside=self.region.outside)
            mass = prior.log_mass(self.cells.position).expand(len(rssi), -1)
            held_out.append(HeldOut(at, at_truth, self.cells.position[None], values, mass))
            from_mean.append((at - part.region.known.mean(dim=0)).norm(dim=1))
        self.weight, self.inflation, error = calibrated_pool(held_out, self.cells.edge_m, self.region.floors)
        self.held_out_m = {"posterior": float(error.mean()), "mean": float(torch.cat(from_mean).mean())}

    @torch.no_grad()
    def locate(self, rssi: Numbers) -> Posterior:
        """Return the posterior over the transmitter's position for each row.

        Args:
            rssi: RSSI at the receivers of the training rows, tensor or array (n, R) [dBm], NaN if not detected.

        Raises:
            InputError: Another number of receivers, infinite values, a row that no receiver detected, or a locator that is
                not fitted.
        """
        rssi = to_tensor("rssi", rssi, torch.float64, (None, len(self.receiver_names)), missing=True)
        check_powers("rssi", rssi.numpy(), self.receiver_names, np.arange(len(rssi))[:, None])
        silent = rssi.isnan().all(dim=1).nonzero()[:, 0]
        if len(silent):
            raise InputError(f"no receiver detected the transmitter in row {int(silent[0])}; leave such rows out")
        at = self.cells.position
        values = self.likelihoods(at, self._maps, rssi)
        log_mass = torch.einsum("k,knm->nm", self.weight, values) + self.cells.log_volume
        edge_m, floors = self.cells.edge_m, self.region.floors
        return Posterior(at[None], normalised(log_mass), edge_m, self.inflation, floors=floors)

    @torch.no_grad()
    @checked
    def sample(self, position: Numbers, n: PositiveInt, generator: torch.Generator) -> Tensor:
        """Sample rows of RSSI from the fitted distributions: values with a common offset, and lost packets.

        Args:
            position: Positions of the transmitter, float64 (m, 3) [m].
            n: Number of rows at each position.
            generator: Source of randomness.

        Returns:
            RSSI (n, m, R) [dBm], NaN if not detected. A row whose packets are all lost keeps its strongest value.
        """
        mean, std = (values.double() for values in maps_at(self.model, position))
        error = self.likelihoods.values.sample(std.expand(n, -1, -1), generator)
        rssi = (mean + error).clamp(MIN_RSSI_DBM, MAX_RSSI_DBM)
        chance = self.likelihoods.detections.probability(mean)
        lost = torch.rand(rssi.shape, generator=generator, dtype=torch.float64) >= chance
        strongest = torch.nn.functional.one_hot(rssi.argmax(dim=2), rssi.shape[2]).bool()
        lost &= ~(strongest & lost.all(dim=2, keepdim=True))
        return rssi.masked_fill(lost, torch.nan)

    def __repr__(self) -> str:
        if not self.is_fitted:
            return f"{type(self).__name__}(not fitted)"
        return f"{type(self).__name__}(fitted, {len(self.receiver_names)} receivers, {len(self.cells.position)} cells)"

    def _restored(self) -> None:
        self.receiver_names = self.model.receiver_names
        self.cells = self.region.cells(self.config.n_cells)
        self._maps = maps_at(self.model, self.cells.position)
