"""Position of the transmitter from its RSSI, by the radio maps of all receivers."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Annotated, ClassVar, Self

import numpy as np
import torch
from annotated_types import Ge, Le
from torch import Tensor

from swiftwrf.data.columns import MAX_RSSI_DBM, MIN_RSSI_DBM, check_powers
from swiftwrf.data.dataset import Numbers
from swiftwrf.data.rssi import Rssi
from swiftwrf.data.splits import Validation, folds
from swiftwrf.errors import InputError
from swiftwrf.locate.posterior import Posterior, inflation, normalised, pooled_weights, read_inflation
from swiftwrf.locate.region import Region, outside_mass
from swiftwrf.locate.rssi_likelihood import DetectionLikelihood, FingerprintLikelihood, Maps, RssiLikelihoods, maps_at
from swiftwrf.locate.student import Student, correlation
from swiftwrf.positions import to_tensor
from swiftwrf.rssi import RssiModel
from swiftwrf.runtime.checkpoint import Header, Saved, expect
from swiftwrf.runtime.progress import progress as tracked
from swiftwrf.runtime.validation import Configured, NonNegativeInt, PositiveInt, all_or_nothing, checked, configuration

NEIGHBOUR_COUNTS = (1, 2, 3, 5, 8, 13, 20)
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
    maps: Maps


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
            0.25 if config.validation == "block" else 0.03,  # a block of a fifth may lie beyond the known positions
            outside_mass([Region(known[part.kept]) for part in parts], [known[part.out] for part in parts]),
        )
        self.cells = self.region.cells(config.n_cells)
        max_neighbours = min(len(part.kept) for part in parts)
        self.likelihoods = self._likelihoods(train, parts, torch.arange(len(train)), max_neighbours)
        self._calibrate(train, parts, max_neighbours)
        self._maps = maps_at(self.model, self.cells.position)
        return self

    def _part(self, train: Rssi, fold: Tensor, number: int) -> _Part:
        out, kept = (fold == number).nonzero()[:, 0], (fold != number).nonzero()[:, 0]
        model = RssiModel(validation=self.config.validation, seed=self.config.seed).fit(train.subset(kept))
        return _Part(out, kept, model, maps_at(model, train.transmitter_position[out]))

    def _likelihoods(self, train: Rssi, parts: list[_Part], rows: Tensor, max_neighbours: int) -> RssiLikelihoods:
        """Fit the distributions to held-out folds, with `rows` of the training data as fingerprints."""
        rssi = torch.cat([train.rssi_dbm[part.out] for part in parts])
        mean, std = (torch.cat(values) for values in zip(*(part.maps for part in parts), strict=True))

        def fingerprints(rows: Tensor, k: int, scale_m: Tensor) -> FingerprintLikelihood:
            filled = train.rssi_dbm[rows].float().nan_to_num(self.floor_dbm)
            return FingerprintLikelihood(train.transmitter_position[rows], filled, self.floor_dbm, k, scale_m)

        def errors(k: int) -> Tensor:
            found = (
                fingerprints(part.kept, k, torch.ones(3)).estimate(train.rssi_dbm[part.out])
                - train.transmitter_position[part.out]
                for part in parts
            )
            return torch.cat(list(found))

        counts = [k for k in NEIGHBOUR_COUNTS if k < len(rssi) / 2 and k <= max_neighbours]
        k = min(counts, key=lambda k: float(errors(k).norm(dim=1).median()))
        # positions are measured to a few centimetres at best
        scale = (errors(k).abs().quantile(0.6, dim=0).square() + max(self.cells.edge_m, 0.05) ** 2).sqrt()
        values = Student.fit((rssi.float() - mean) / std, correlation, (0.0, 0.1, 0.3, 0.6, 1.0), n_folds=2)
        return RssiLikelihoods(values, DetectionLikelihood.fit(mean, ~rssi.isnan()), fingerprints(rows, k, scale))

    def _calibrate(self, train: Rssi, parts: list[_Part], max_neighbours: int) -> None:
        """Choose the weights of the likelihoods by the posterior density at held-out positions.

        The distributions of each fold are fitted to the other folds, and so is the prior over positions.
        """
        truth, values, positions, masses = [], [], [], []
        fraction = min(1.0, self.config.n_calibration / len(train))
        for number, part in enumerate(parts):
            likelihoods = self._likelihoods(train, parts[:number] + parts[number + 1 :], part.kept, max_neighbours)
            some = torch.linspace(0, len(part.out) - 1, max(1, round(fraction * len(part.out)))).long()
            rssi, at = train.rssi_dbm[part.out[some]], train.transmitter_position[part.out[some]]
            values.append(likelihoods(self.cells.position, maps_at(part.model, self.cells.position), rssi))
            own = part.maps[0][some], part.maps[1][some]
            truth.append(likelihoods(at, own, rssi).diagonal(dim1=1, dim2=2))
            prior = Region(train.transmitter_position[part.kept], self.region.margin, self.region.outside)
            masses.append(prior.log_mass(self.cells.position).expand(len(rssi), -1))
            positions.append(at)
        candidates, position, volume = torch.cat(values, dim=1), torch.cat(positions), torch.cat(masses)
        self.weight = pooled_weights(torch.cat(truth, dim=1), candidates, volume)
        generator = torch.Generator().manual_seed(self.config.seed)
        rows = torch.randperm(len(position), generator=generator)[:300]
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
        values = self.likelihoods(at, self._maps, rssi)
        log_mass = torch.einsum("k,knm->nm", self.weight, values)
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
        mean, std = (values.double() for values in maps_at(self.model, position))
        draws = self.likelihoods.values.sample((n, len(mean)), generator)
        rssi = (mean + std * draws).clamp(MIN_RSSI_DBM, MAX_RSSI_DBM)
        chance = self.likelihoods.detections.probability(mean)
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
        values, fingerprints = self.likelihoods.values, self.likelihoods.fingerprints
        own = {
            "known": fingerprints.position,
            "fingerprint": fingerprints.rssi,
            "scale_m": fingerprints.scale_m,
            "correlation": values.scale,
            "weight": self.weight,
        }
        plain = {
            "locator": asdict(self.config),
            "floor_dbm": self.floor_dbm,
            "k": fingerprints.k,
            "degrees": None if math.isinf(values.degrees) else values.degrees,
            "detections": asdict(self.likelihoods.detections),
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
            tensors, {"known": (n, 3), "fingerprint": (n, r), "scale_m": (3,), "correlation": (r, r), "weight": (3,)}
        )
        degrees, k = header["degrees"], int(header["k"])
        if not 1 <= k <= n:
            raise InputError(f"k must be between 1 and the number of rows, got {k}")
        matrix, scale = tensors["correlation"], tensors["scale_m"]
        definite = not bool(torch.linalg.cholesky_ex(matrix).info)
        if not (definite and bool((scale > 0).all()) and (degrees is None or float(degrees) > 0)):
            raise InputError("correlation, scale or degrees of freedom are those of no distribution")
        locator.floor_dbm = float(header["floor_dbm"])
        locator.likelihoods = RssiLikelihoods(
            Student(matrix, math.inf if degrees is None else float(degrees)),
            DetectionLikelihood(**header["detections"]),
            FingerprintLikelihood(tensors["known"], tensors["fingerprint"], locator.floor_dbm, k, scale),
        )
        locator.region = Region.from_state(tensors, header)
        locator.cells = locator.region.cells(locator.config.n_cells)
        locator.weight, locator.inflation = tensors["weight"], read_inflation(header)
        locator._maps = maps_at(locator.model, locator.cells.position)
        return locator
