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
from swiftwrf.data.splits import FOLDS, Validation, each_fold, folds
from swiftwrf.errors import InputError
from swiftwrf.locate.locator import Locator
from swiftwrf.locate.posterior import HeldOut, Posterior
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


class RssiLocator(Locator):
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
    config: RssiLocatorConfig

    saved = "model likelihoods region weight inflation"
    model: RssiModel
    """radio maps of the receivers, set by `fit`"""
    likelihoods: Annotated[RssiLikelihoods, "r=model.r"]
    """likelihoods that are pooled, set by `fit`"""
    weight: Annotated[Tensor, "float64 3", Ge(0), Le(1e3)]
    """their weights: of values, detections and fingerprints"""
    held_out_m: dict[str, float]
    """mean errors [m] of the posterior and of the mean training position at held-out rows, set by `fit`, not saved"""

    @property
    def receiver_names(self) -> tuple[str, ...]:
        """Names of the receivers."""
        return self.model.receiver_names

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
        train.check_power("a locator")
        config = self.config
        if model is not None:
            train = model.aligned(train)
        self.model = model or self._radio_maps(train)
        known = train.transmitter_position
        fold = folds(known, config.validation, config.seed, session=train.session)
        fingerprints = Fingerprints.fit(train, fold, config.seed)
        splits = list(each_fold(fold, train.detected.any(dim=1).nonzero()[:, 0]))
        parts = [self._part(train, *rows, fingerprints) for rows in tracked(splits, "held-out folds", progress)]
        prior = region or Region(
            known,
            0.25 if config.validation == "block" else 0.03,  # a block of a fifth may lie beyond the known positions
            outside_mass((part.region, part.position) for part in parts),
        )
        self.region = replace(prior, floors=train.floors)
        self._prepare()
        curve = Detection.estimate(train.transmitter_position, train.rssi_dbm)
        limit = torch.zeros(len(self.receiver_names)).double() if curve is None else curve.limit
        self.likelihoods = self._fitted(parts, fingerprints, limit)
        held_out = [self._held_out(part, parts, limit) for part in parts]
        error = self._calibrate(held_out)
        away = [each.truth - part.region.known.mean(dim=0) for each, part in zip(held_out, parts, strict=True)]
        self.held_out_m = {"posterior": float(error.mean()), "mean": float(torch.cat(away).norm(dim=1).mean())}
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
        # which receivers detect the transmitter is a likelihood of its own, and a scan is no mean of packets
        validation, seed, noises = self.config.validation, self.config.seed, (0.3, 1.0, 2.0, 3.0)
        return RssiModel(validation=validation, seed=seed, not_detected="unknown", noises=noises).fit(train)

    def _part(self, train: Rssi, out: Tensor, kept: Tensor, fingerprints: Fingerprints) -> _Part:
        generator = torch.Generator().manual_seed(self.config.seed)
        out = out[torch.randperm(len(out), generator=generator)[: MAX_HELD_OUT // FOLDS]]
        rssi, position, known = train.rssi_dbm[out], train.transmitter_position[out], train.subset(kept)
        model = self._radio_maps(known)
        others = Fingerprints.of(known, fingerprints.metric, fingerprints.k)
        region = Region(known.transmitter_position, floors=train.floors)
        return _Part(rssi, position, region, model, maps_at(model, position), others, others.votes(rssi))

    def _held_out(self, part: _Part, parts: list[_Part], limit: Tensor) -> HeldOut:
        """Return some rows of a part with their likelihoods, whose distributions are those of the other parts."""
        likelihoods = self._fitted([other for other in parts if other is not part], part.fingerprints, limit)
        rows, cells = slice(-(-self.config.n_calibration // len(parts))), self.cells.position
        rssi, at, (mean, std) = part.rssi[rows], part.position[rows], part.maps
        values = likelihoods(cells, maps_at(part.model, cells), rssi)
        at_truth = likelihoods(at, (mean[rows], std[rows]), rssi).diagonal(dim1=1, dim2=2)
        prior = replace(part.region, margin=self.region.margin, outside=self.region.outside)
        return HeldOut(at, at_truth, cells[None], values, prior.log_mass(cells).expand(len(rssi), -1))

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
        return self._posterior(at[None], self.likelihoods(at, self._maps, rssi), self.cells.log_volume)

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

    def _prepare(self) -> None:
        """Compute the cells of the region and the radio maps there."""
        self.cells = self.region.cells(self.config.n_cells)
        self._maps = maps_at(self.model, self.cells.position)

    _restored = _prepare
