"""Position of the transmitter from its RSSI, by the radio maps of all receivers."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Annotated, ClassVar, Self

import numpy as np
import torch
from annotated_types import Ge, Le
from torch import Tensor

from swiftwrf.data.dataset import Numbers
from swiftwrf.data.fillers import MAX_RSSI_DBM, MIN_RSSI_DBM, check_powers
from swiftwrf.data.rssi import Rssi
from swiftwrf.data.splits import Validation, folds
from swiftwrf.errors import InputError
from swiftwrf.locate.pool import inflation, pooled_weights
from swiftwrf.locate.posterior import Posterior, normalised
from swiftwrf.locate.region import Region, outside_mass
from swiftwrf.locate.rssi_likelihood import DetectionLikelihood, FingerprintLikelihood, RssiMaps, ValueLikelihood
from swiftwrf.positions import to_tensor
from swiftwrf.rssi import RssiModel
from swiftwrf.runtime.checkpoint import Header, Saved, expect
from swiftwrf.runtime.options import Configured, all_or_nothing
from swiftwrf.runtime.progress import progress as tracked
from swiftwrf.runtime.validation import NonNegativeInt, PositiveInt, checked, configuration

MAX_INFLATION_ROWS = 300  # held-out rows that determine the coverage of credible regions
NEIGHBOUR_COUNTS = (1, 2, 3, 5, 8, 13, 20)
BLOCK_MARGIN = 0.25  # of the region: a block of a fifth may lie beyond the known positions
MIN_SCALE_M = 0.05  # of the error of nearest neighbours
UNDETECTED_BELOW_DB = 5.0  # below the weakest value, of what is not detected, in the space of fingerprints


@configuration
class RssiLocatorConfig:
    """Options of the locator.

    Example:
        >>> RssiLocator(RssiLocatorConfig(validation="block"), n_cells=500).config.validation
        'block'
    """

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
    """One held-out fold: its rows, and what follows from the others."""

    out: Tensor
    kept: Tensor
    model: RssiModel
    maps: RssiMaps


class RssiLocator(Configured, Saved):
    """Posterior over the position of the transmitter, given its RSSI at the receivers.

    Three likelihoods are pooled: the values under the radio maps with their uncertainty and correlated errors, which
    receivers detect the transmitter at all, and the position of similar training rows. Held-out rows determine their
    distributions and weights.

    Args:
        config: Options as one object. Defaults to `RssiLocatorConfig()`.
        options: Single options, which replace those of `config`.

    Raises:
        InputError: An unknown option, or a value outside its range.

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

    @all_or_nothing
    @checked
    def fit(
        self,
        train: Rssi,
        *,
        model: RssiModel | None = None,
        region: Region | None = None,
        progress: bool = False,
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
            model.check_measurements(train)
            train = train.about(model.origin)
        self.receiver_names = train.receiver_names
        self.model = model or RssiModel(validation=config.validation, seed=config.seed).fit(train)
        known, rssi = train.transmitter_position, train.rssi_dbm
        self.floor_dbm = float(rssi[~rssi.isnan()].min()) - UNDETECTED_BELOW_DB
        fold = folds(known, config.validation, config.seed, session=train.session)
        numbers = tracked(fold.unique().tolist(), "held-out folds", progress)
        parts = [self._part(train, fold, number) for number in numbers]
        self.region = region or Region(
            known,
            BLOCK_MARGIN if config.validation == "block" else 0.03,
            outside_mass([Region(known[part.kept]) for part in parts], [known[part.out] for part in parts]),
        )
        self.cells = self.region.cells(config.n_cells)
        self._fit_likelihoods(train, parts)
        self._calibrate(train, parts)
        self._maps = RssiMaps.of(self.model.predict(self.cells.position))
        return self

    def _part(self, train: Rssi, fold: Tensor, number: int) -> _Part:
        out, kept = (fold == number).nonzero()[:, 0], (fold != number).nonzero()[:, 0]
        model = RssiModel(validation=self.config.validation, seed=self.config.seed).fit(train.subset(kept))
        return _Part(out, kept, model, RssiMaps.of(model.predict(train.transmitter_position[out])))

    def _likelihoods(
        self, train: Rssi, parts: list[_Part], max_neighbours: int
    ) -> tuple[ValueLikelihood, DetectionLikelihood, int, Tensor]:
        """Fit the distributions to held-out folds: of values, of detections, and of the error of k nearest neighbours."""
        rssi = torch.cat([train.rssi_dbm[part.out] for part in parts])
        mean, std = (torch.cat([getattr(part.maps, name) for part in parts]) for name in ("mean", "std"))
        counts = [k for k in NEIGHBOUR_COUNTS if k < len(rssi) / 2 and k <= max_neighbours]
        errors = {k: self._neighbour_errors(train, parts, k) for k in counts}
        k = min(errors, key=lambda k: float(errors[k].norm(dim=1).median()))
        scale = (errors[k].abs().quantile(0.6, dim=0).square() + max(self.cells.edge_m, MIN_SCALE_M) ** 2).sqrt()
        values = ValueLikelihood.fit((rssi.float() - mean) / std)
        return values, DetectionLikelihood.fit(mean, ~rssi.isnan()), k, scale

    def _neighbour_errors(self, train: Rssi, parts: list[_Part], k: int) -> Tensor:
        one = torch.ones(3, dtype=torch.float64)
        return torch.cat(
            [
                self._fingerprints(train, part.kept, k, one).estimate(train.rssi_dbm[part.out])
                - train.transmitter_position[part.out]
                for part in parts
            ]
        )

    def _fingerprints(self, train: Rssi, rows: Tensor, k: int, scale_m: Tensor) -> FingerprintLikelihood:
        filled = train.rssi_dbm[rows].float().nan_to_num(self.floor_dbm)
        return FingerprintLikelihood(train.transmitter_position[rows], filled, self.floor_dbm, k, scale_m)

    def _fit_likelihoods(self, train: Rssi, parts: list[_Part]) -> None:
        self.values, self.detections, k, scale = self._likelihoods(train, parts, _fewest_kept(parts))
        self.fingerprints = self._fingerprints(train, torch.arange(len(train)), k, scale)

    def _calibrate(self, train: Rssi, parts: list[_Part]) -> None:
        """Choose the weights of the likelihoods by the posterior density at held-out positions.

        The distributions of each fold are fitted to the other folds, and so is the prior over positions.
        """
        truth, values, positions, masses = [], [], [], []
        share = min(1.0, self.config.n_calibration / len(train))
        for number, part in enumerate(parts):
            value, detection, k, scale = self._likelihoods(
                train, parts[:number] + parts[number + 1 :], _fewest_kept(parts)
            )
            fingerprints = self._fingerprints(train, part.kept, k, scale)
            some = torch.linspace(0, len(part.out) - 1, max(1, round(share * len(part.out)))).long()
            rssi, at = train.rssi_dbm[part.out[some]], train.transmitter_position[part.out[some]]
            maps = RssiMaps.of(part.model.predict(self.cells.position))

            def all_of(
                maps: RssiMaps,
                position: Tensor,
                rows: Tensor,
                one: ValueLikelihood = value,
                two: DetectionLikelihood = detection,
                three: FingerprintLikelihood = fingerprints,
            ) -> Tensor:
                parts = (
                    one.log_likelihood(maps, rows),
                    two.log_likelihood(maps, rows),
                    three.log_likelihood(position, rows),
                )
                return torch.stack([value.double() for value in parts])

            values.append(all_of(maps, self.cells.position, rssi))
            prior = Region(train.transmitter_position[part.kept], self.region.margin, self.region.outside)
            masses.append(prior.log_mass(self.cells.position).expand(len(rssi), -1))
            own = RssiMaps(part.maps.mean[some], part.maps.std[some])
            positions.append(at)
            truth.append(all_of(own, at, rssi).diagonal(dim1=1, dim2=2))
        candidates, position, volume = torch.cat(values, dim=1), torch.cat(positions), torch.cat(masses)
        self.weight = pooled_weights(torch.cat(truth, dim=1), candidates, volume)
        generator = torch.Generator().manual_seed(self.config.seed)
        rows = torch.randperm(len(position), generator=generator)[:MAX_INFLATION_ROWS]
        log_mass = torch.einsum("k,knm->nm", self.weight, candidates[:, rows]) + volume[rows]
        held_out = Posterior(self.cells.position[None], normalised(log_mass), self.cells.edge_m)
        self.inflation = inflation(held_out, position[rows])

    @torch.no_grad()
    def locate(self, rssi: Numbers) -> Posterior:
        """Return the posterior over the transmitter's position for each row.

        Args:
            rssi: RSSI at the receivers of the training rows, tensor or array (n, R) [dBm], NaN if not detected.

        Raises:
            InputError: Another number of receivers, infinite values, a row that no receiver detected, or a locator that is
                not fitted.
        """
        self.check_fitted()
        rssi = to_tensor("rssi", rssi, torch.float64, (None, len(self.receiver_names)), missing=True)
        check_powers("rssi", rssi.numpy(), self.receiver_names, np.arange(len(rssi))[:, None])
        silent = rssi.isnan().all(dim=1).nonzero()[:, 0]
        if len(silent):
            raise InputError(f"no receiver detected the transmitter in row {int(silent[0])}; leave such rows out")
        at = self.cells.position
        parts = (
            self.values.log_likelihood(self._maps, rssi),
            self.detections.log_likelihood(self._maps, rssi),
            self.fingerprints.log_likelihood(at, rssi),
        )
        log_mass = sum(weight * part.double() for weight, part in zip(self.weight.tolist(), parts, strict=True))
        return Posterior(at[None], normalised(log_mass + self.cells.log_volume), self.cells.edge_m, self.inflation)

    @torch.no_grad()
    @checked
    def sample(self, position: Numbers, n: PositiveInt, generator: torch.Generator) -> Tensor:
        """Sample rows of RSSI from the fitted distributions: values with correlated errors, and lost packets.

        Args:
            position: Positions of the transmitter, float64 (m, 3) [m].
            n: Number of rows at each position.
            generator: Source of randomness.

        Returns:
            RSSI (n, m, R) [dBm], NaN if not detected. A row whose packets are all lost keeps its strongest value.
        """
        self.check_fitted()
        maps = RssiMaps.of(self.model.predict(position))
        mean, std = maps.mean.double(), maps.std.double()
        rssi = (mean + std * self.values.sample((n, len(mean)), generator)).clamp(MIN_RSSI_DBM, MAX_RSSI_DBM)
        chance = self.detections.probability(mean)
        lost = torch.rand(rssi.shape, generator=generator, dtype=torch.float64) >= chance
        strongest = torch.nn.functional.one_hot(rssi.argmax(dim=2), rssi.shape[2]).bool()
        lost &= ~(strongest & lost.all(dim=2, keepdim=True))
        return rssi.masked_fill(lost, torch.nan)

    def __repr__(self) -> str:
        if not self.is_fitted:
            return f"{type(self).__name__}(not fitted)"
        return f"{type(self).__name__}(fitted, {len(self.receiver_names)} receivers, {len(self.cells.position)} cells)"

    def state(self) -> tuple[dict[str, Tensor], Header]:
        """Return the fitted tensors by name, and plain values."""
        self.check_fitted()
        tensors, header = self.model.state()
        own = {
            "known": self.fingerprints.position,
            "fingerprint": self.fingerprints.rssi,
            "scale_m": self.fingerprints.scale_m,
            "correlation": self.values.correlation,
            "weight": self.weight,
        }
        plain = {
            "locator": asdict(self.config),
            "floor_dbm": self.floor_dbm,
            "k": self.fingerprints.k,
            "degrees": None if math.isinf(self.values.degrees) else self.values.degrees,
            "detections": asdict(self.detections),
            "inflation": self.inflation,
        }
        at, prior = self.region.state()
        return tensors | own | at, header | plain | prior

    @classmethod
    def from_state(cls, tensors: dict[str, Tensor], header: Header) -> Self:
        """Return the locator that `state` describes."""
        locator = cls(RssiLocatorConfig(**header["locator"]))
        locator.model = RssiModel.from_state(tensors, header)
        locator.receiver_names = locator.model.receiver_names
        n, r = len(tensors["known"]), len(locator.receiver_names)
        expect(
            tensors,
            {"known": (n, 3), "fingerprint": (n, r), "scale_m": (3,), "correlation": (r, r), "weight": (3,)},
        )
        degrees, k = header["degrees"], int(header["k"])
        if not 1 <= k <= n:
            raise InputError(f"k must be between 1 and the number of rows, got {k}")
        correlation, scale = tensors["correlation"], tensors["scale_m"]
        definite = not bool(torch.linalg.cholesky_ex(correlation).info)
        if not (definite and bool((scale > 0).all()) and (degrees is None or float(degrees) > 0)):
            raise InputError("correlation, scale or degrees of freedom are those of no distribution")
        locator.values = ValueLikelihood(tensors["correlation"], math.inf if degrees is None else float(degrees))
        locator.detections = DetectionLikelihood(**header["detections"])
        locator.floor_dbm = float(header["floor_dbm"])
        locator.fingerprints = FingerprintLikelihood(
            tensors["known"], tensors["fingerprint"], locator.floor_dbm, k, tensors["scale_m"]
        )
        locator.region = Region.from_state(tensors, header)
        locator.cells = locator.region.cells(locator.config.n_cells)
        locator.weight, locator.inflation = tensors["weight"], float(header["inflation"])
        if not 0 < locator.inflation < math.inf:
            raise InputError(f"inflation must be a number above 0, got {locator.inflation}")
        locator._maps = RssiMaps.of(locator.model.predict(locator.cells.position))
        return locator


def _fewest_kept(parts: list[_Part]) -> int:
    """Return the smallest number of rows that are trained on while a fold is held out."""
    return min(len(part.kept) for part in parts)
