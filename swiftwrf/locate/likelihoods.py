"""The likelihoods that matched-field processing pools: those of spectra, and those of channels.

Both kinds are fitted without each fold and to all data, screen the cells of a region, and evaluate candidates.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated, ClassVar, Self

import torch
from annotated_types import Ge, Gt, Le
from torch import Tensor

from swiftwrf.array.planar import LIGHT_SPEED, differences
from swiftwrf.data.dataset import Numbers
from swiftwrf.data.spectra import Spectra
from swiftwrf.data.splits import each_fold
from swiftwrf.errors import InputError
from swiftwrf.gp import GaussianProcess, choose_kernel
from swiftwrf.locate.features import (
    CARRIER,
    PathWaves,
    SpectrumFeatures,
    channel_numbers,
    channels_beside,
    gain_features,
    nearby_features,
    nearby_numbers,
)
from swiftwrf.locate.region import Cells, Region
from swiftwrf.locate.spectrum_likelihood import (
    ChannelLikelihood,
    CoarrayLikelihood,
    Likelihood,
    PathLikelihood,
    PhaseLikelihood,
    Screen,
    Student,
)
from swiftwrf.models.geometry import GeometryModel
from swiftwrf.models.geometry.channels import coherence, ends
from swiftwrf.models.geometry.fit import GeometryConfig, observe
from swiftwrf.models.geometry.model import kept_snapshots
from swiftwrf.models.geometry.path_gains import PRIORS, PathGains, choose_prior, fit_path_gains, kernel_of
from swiftwrf.positions import to_tensor
from swiftwrf.runtime.threads import parallel_map
from swiftwrf.runtime.validation import PositiveInt

CHANNEL_CELLS = 8  # times as many first cells for channels, which are not computed at each of them
CHANNEL_PARTS = 4  # along each edge of a cell with paths of its own; not studied
MIN_FLOOR = 1e-4  # of missing coherence, by rounding
MIN_VARIANCE = 1e-6  # of the errors of co-array numbers, relative to their mean square, by rounding
BATCH_CANDIDATES = 2048  # whose waves are computed together: as many as a processor's cache holds
BATCH_CELLS = 256  # the same with parts
MAX_KEPT_NUMBERS = 2**25  # co-array numbers of channels at all cells: 134 MB
MAX_LOG_VARIANCE = 30.0


@dataclass(frozen=True, eq=False)
class Likelihoods(ABC):
    """Likelihoods by one room, which a pool weighs.

    Args:
        room: Room whose paths they share.
        frequency: Frequencies of the snapshots relative to the carrier, float64 (F,), one if all are at the carrier.
        log_variance: Logarithms of the variances of path gains, see `PhaseLikelihood`.
    """

    room: GeometryModel
    frequency: Annotated[Tensor, "float64 f", Gt(0)]
    log_variance: Annotated[Tensor, "float32 v", Ge(-MAX_LOG_VARIANCE), Le(MAX_LOG_VARIANCE)]

    start: ClassVar[tuple[float, ...]]
    """weights by which the calibration searches"""
    names: ClassVar[tuple[str, ...]]
    """what each likelihood is of"""

    @property
    @abstractmethod
    def parts(self) -> tuple[Likelihood, ...]:
        """Likelihoods in the order of their weights."""

    @classmethod
    @abstractmethod
    def fit(cls, train: Spectra, room: GeometryModel, fold: Tensor, seed: int) -> tuple[SpectrumFeatures, list[Self]]:
        """Return the features of the data, and the likelihoods without each fold (n,) and, last, of all data."""

    @abstractmethod
    def features(self, data: Numbers | Spectra, seed: int) -> SpectrumFeatures:
        """Return the features of what is located.

        Raises:
            InputError: Other measurements than those that the likelihoods were fitted to.
        """

    @abstractmethod
    def screens(self, region: Region, count: int, most: int) -> tuple[Cells, list[Screen]]:
        """Return about `count` cells of a region, or `most` of them, and likelihoods at all of them that choose some."""

    @abstractmethod
    def elsewhere(self, room: GeometryModel) -> Self:
        """Return the likelihoods of an equal array in another pose, by its room, where nothing was measured."""

    @abstractmethod
    def sample(self, position: Tensor, generator: torch.Generator) -> SpectrumFeatures:
        """Return features at positions (n, 3) of channels whose path gains vary as at held-out positions."""

    def check(self) -> None:
        """Refuse likelihoods from a file that do not fit their room.

        Raises:
            InputError: Another number of variances, or scales that are those of no distribution.
        """
        size, count = 2 * len(differences(self.room.array)), 4 + self.room.reflectors.gain.shape[1]
        if len(self.log_variance) != count:
            raise InputError(f"a room with {count - 4} planes has {count} variances, got {len(self.log_variance)}")
        for scale in (part.distribution.scale for part in self.parts if isinstance(part, CoarrayLikelihood)):
            if len(scale) != size or bool(torch.linalg.cholesky_ex(scale).info.any()):
                raise InputError("scales are those of no distribution of co-array numbers")

    def __call__(self, position: Tensor, observed: SpectrumFeatures, weight: Tensor) -> Tensor:
        """Return log-likelihoods (k, n, m) of n observations at candidates (n, m, 3) [m], 0 for those of weight 0."""
        n, m, _ = position.shape
        at, owner = position.reshape(-1, 3), torch.arange(n).repeat_interleave(m)
        counted = list(zip(self.parts, weight.tolist(), strict=True))

        def of_batch(rows: Tensor) -> Tensor:
            waves, target = PathWaves.at(self.room, at[rows], self.frequency), observed.subset(owner[rows])
            none = torch.zeros(len(rows))
            return torch.stack([part(waves, target) if factor > 0 else none for part, factor in counted])

        batches = torch.arange(n * m).split(BATCH_CANDIDATES // len(self.frequency))
        return torch.cat(parallel_map(of_batch, batches), dim=1).reshape(len(counted), n, m)


@dataclass(frozen=True, eq=False)
class SpectrumLikelihoods(Likelihoods):
    """Likelihoods of spectra.

    They are those of co-array numbers by constant and by position-dependent path gains, and of element phases under
    uncertain path gains.

    Args:
        gains: Position-dependent path gains.
        coarray: Distributions of the errors of both predictions of co-array numbers.
    """

    gains: PathGains
    coarray: tuple[Student, Student]

    start = (0.05, 0.05, 0.3)
    names = ("constant gains", "varying gains", "phases")

    @property
    def parts(self) -> tuple[Likelihood, ...]:
        predictions = gain_features(self.room.array, self.gains)
        return *map(CoarrayLikelihood, predictions, self.coarray), self._phases

    @cached_property
    def _phases(self) -> PhaseLikelihood:
        return PhaseLikelihood(self.room, self.log_variance)

    @classmethod
    def fit(cls, train: Spectra, room: GeometryModel, fold: Tensor, seed: int) -> tuple[SpectrumFeatures, list[Self]]:
        features = SpectrumFeatures.of(train.store.batches(), room.array, train.grid, seed)
        scene, rows = observe(train, GeometryConfig(seed=seed))
        prior = next(iter(PRIORS))
        if room.planes:
            room, prior, _ = choose_prior(room, scene, fold[rows])
        kernel = kernel_of(scene.moving)

        def fitted(kept: Tensor) -> tuple[GeometryModel, PathGains, PhaseLikelihood]:
            phases = scene.subset(torch.isin(rows, kept).nonzero()[:, 0])
            refined = room.refined_on(phases)
            waves = PathWaves.at(refined, train.position[kept])
            likelihood = PhaseLikelihood.fit([(refined, waves, features.subset(kept))])
            return refined, fit_path_gains(refined, phases, kernel, prior), likelihood

        outs, kept = _held_out_and_kept(fold)
        fits = parallel_map(fitted, kept)
        residual = torch.empty(2, *features.coarray.shape)
        for out, (refined, gains, _) in zip(outs, fits[:-1], strict=True):
            waves, observed = PathWaves.at(refined, train.position[out]), features.coarray[out]
            for row, predict in enumerate(gain_features(refined.array, gains)):
                residual[row, out] = predict(waves)[0] - observed
        floor = MIN_VARIANCE * float(features.coarray.square().mean())
        likelihoods = []
        for known, (refined, gains, phases) in zip(kept, fits, strict=True):
            constant, varying = (Student.fit(part[known], floor) for part in residual)
            likelihoods.append(cls(refined, CARRIER, phases.log_variance, gains, (constant, varying)))
        return features, likelihoods

    def elsewhere(self, room: GeometryModel) -> SpectrumLikelihoods:
        gains = replace(self.gains, process=_far_away(self.gains.process))
        return replace(self, room=room, gains=gains, coarray=(self.coarray[0], self.coarray[0]))

    def sample(self, position: Tensor, generator: torch.Generator) -> SpectrumFeatures:
        channel = self._phases.sample(PathWaves.at(self.room, position), generator)
        return SpectrumFeatures.of([self.room.array.spectrum(channel, self.room.grid)], self.room.array, self.room.grid)

    def features(self, data: Numbers | Spectra, seed: int) -> SpectrumFeatures:
        values, grid = data.spectrum if isinstance(data, Spectra) else data, self.room.grid
        magnitude = to_tensor("spectra", values, torch.float32, (None, *grid.shape))
        return SpectrumFeatures.of([magnitude], self.room.array, grid, seed)

    def screens(self, region: Region, count: int, most: int) -> tuple[Cells, list[Screen]]:
        cells = region.cells(min(max(count, 1), most))
        # the mean of the path gains takes an eighth of the time of all their fields, and ranks cells nearly alike
        predictions = gain_features(self.room.array, self.gains.averaged())
        likelihoods = [*map(CoarrayLikelihood, predictions, self.coarray)]

        def whitened(position: Tensor) -> list[Tensor]:
            waves = PathWaves.at(self.room, position)
            return [part.predict(waves)[0] @ part.distribution.whitening for part in likelihoods]

        numbers = zip(*parallel_map(whitened, cells.position.split(BATCH_CANDIDATES)), strict=True)
        std = torch.ones(len(cells.position))
        return cells, [part.screen(torch.cat(batches), std) for part, batches in zip(likelihoods, numbers, strict=True)]

    def check(self) -> None:
        super().check()
        if len(self.frequency) != 1 or self.gains.n_paths != 1 + len(self.room.reflectors.sequence):
            raise InputError("frequencies or path gains are those of another room")


@dataclass(frozen=True, eq=False)
class ChannelLikelihoods(Likelihoods):
    """Likelihoods of channels.

    They are those of channels under uncertain path gains, of co-array numbers by constant path gains and measured channels
    nearby, and of channels by constant path gains.

    Args:
        n_snapshots: Number of snapshots of each measurement.
        process: Process of the differences of measured co-array numbers from those of the room.
        nearby: Distribution of the errors of the co-array numbers by room and process.
        fields: Likelihood by constant path gains.
    """

    n_snapshots: PositiveInt
    process: GaussianProcess
    nearby: Annotated[Student, "f=process.k"]
    fields: ChannelLikelihood

    start = (0.5, 0.05, 0.05)
    names = ("paths", "nearby channels", "constant gains")

    @property
    def parts(self) -> tuple[Likelihood, ...]:
        return self._paths, self._coarray, self.fields

    @cached_property
    def _paths(self) -> PathLikelihood:
        return PathLikelihood(self.room, self.log_variance)

    @property
    def _coarray(self) -> CoarrayLikelihood:
        return CoarrayLikelihood(nearby_features(self.room.array, self.process), self.nearby)

    @classmethod
    def fit(cls, train: Spectra, room: GeometryModel, fold: Tensor, seed: int) -> tuple[SpectrumFeatures, list[Self]]:
        assert train.channel is not None
        array, position, n_snapshots = room.array, train.position, train.channel.shape[1]
        features = SpectrumFeatures.of_channels(train.channel, array)
        scene, rows = observe(train, GeometryConfig(seed=seed))
        frequency = CARRIER
        if train.frequency_hz is not None:
            frequency = train.frequency_hz[kept_snapshots(n_snapshots)] * array.wavelength / LIGHT_SPEED

        def fitted(kept: Tensor) -> GeometryModel:
            phases = scene.subset(torch.isin(rows, kept).nonzero()[:, 0])
            return room.refined_on(phases).furnished_on(train.subset(kept))

        outs, kept = _held_out_and_kept(fold)
        rooms = parallel_map(fitted, kept)
        # every channel, by the room without its fold
        held = [
            (own, PathWaves.at(own, position[out], frequency), features.subset(out))
            for own, out in zip(rooms[:-1], outs, strict=True)
        ]
        missing, error = torch.empty(len(train)), torch.empty_like(features.coarray)
        for out, (_, waves, observed) in zip(outs, held, strict=True):
            assert observed.channel is not None
            missing[out] = 1 - coherence(observed.channel, waves.channel)
            error[out] = observed.coarray - channel_numbers(waves.channel, array)
        fields = ChannelLikelihood(max(float(missing.median()), MIN_FLOOR))
        # furniture is fitted more closely to the channels that determine it than to others
        variance = PathLikelihood.fit(held).log_variance
        kernel = choose_kernel(position, error[:, None], fold)

        def process(own: GeometryModel, rows: Tensor) -> GaussianProcess:
            channels = (PathWaves.at(own, at, frequency).channel for at in position[rows].split(BATCH_CANDIDATES))
            predicted = torch.cat([channel_numbers(channel, array) for channel in channels])
            difference = features.coarray[rows] - predicted
            return GaussianProcess(kernel, position[rows], difference.float())

        processes = [*map(process, rooms, kept)]
        residual = torch.empty_like(features.coarray)
        for nearby, out, (_, waves, observed) in zip(processes[:-1], outs, held, strict=True):
            numbers, std = nearby_numbers(waves.channel, waves.position, array, nearby)
            residual[out] = (numbers - observed.coarray) / std[:, None]
        floor = MIN_VARIANCE * float(features.coarray.square().mean())
        return features, [
            cls(
                own,
                frequency,
                variance,
                n_snapshots,
                nearby,
                Student.fit(residual[rows], floor),
                fields,
            )
            for own, nearby, rows in zip(rooms, processes, kept, strict=True)
        ]

    def elsewhere(self, room: GeometryModel) -> ChannelLikelihoods:
        return replace(self, room=room, process=_far_away(self.process))

    def sample(self, position: Tensor, generator: torch.Generator) -> SpectrumFeatures:
        channel = self._paths.sample(PathWaves.at(self.room, position, self.frequency), generator)
        return SpectrumFeatures.of_channels(channel, self.room.array)

    def features(self, data: Numbers | Spectra, seed: int) -> SpectrumFeatures:
        channel = data.channel if isinstance(data, Spectra) else data
        if channel is None or not torch.as_tensor(channel).is_complex():
            raise InputError(
                "this locator was fitted to channels; give channels, complex (n, S, K), in place of spectra"
            )
        shape = None, self.n_snapshots, len(self.room.array.element)
        return SpectrumFeatures.of_channels(to_tensor("channel", channel, torch.complex64, shape), self.room.array)

    def screens(self, region: Region, count: int, most: int) -> tuple[Cells, list[Screen]]:
        parts = CHANNEL_PARTS ** len(region.extent)
        whole = region.cells(int(max(min(count, CHANNEL_CELLS * most) / parts, 1)))
        cells, away = whole.cut(CHANNEL_PARTS), whole.centres(CHANNEL_PARTS)
        frequency = self.frequency[ends(len(self.frequency))]

        def predicted(position: Tensor) -> Tensor:
            return channels_beside(self.room, position, away, frequency).movedim(1, 0).contiguous()

        channels = parallel_map(predicted, whole.position.split(BATCH_CELLS))
        screens = [self.fields.screen(channels)]
        if len(cells.position) * len(self.nearby.scale) <= MAX_KEPT_NUMBERS:

            def corrected(at: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
                channel, position = at
                numbers, std = nearby_numbers(channel.movedim(0, 1), position, self.room.array, self.process)
                return numbers @ self.nearby.whitening, std

            some = [part for channel in channels for part in channel.split(BATCH_CANDIDATES, dim=1)]
            positions = cells.position.split([part.shape[1] for part in some])
            numbers, std = zip(*parallel_map(corrected, zip(some, positions, strict=True)), strict=True)
            screens.append(self._coarray.screen(torch.cat(numbers), torch.cat(std)))
        return cells, screens

    def check(self) -> None:
        super().check()
        if len(self.frequency) not in {1, len(kept_snapshots(self.n_snapshots))}:
            raise InputError(f"{self.n_snapshots} snapshots have {len(self.frequency)} frequencies")


def _held_out_and_kept(fold: Tensor) -> tuple[list[Tensor], list[Tensor]]:
    """Return the rows of each fold, and those of all but each fold with, last, all rows."""
    outs, kept = zip(*each_fold(fold), strict=True)
    return [*outs], [*kept, torch.arange(len(fold))]


def _far_away(process: GaussianProcess, distance_m: float = 1e6) -> GaussianProcess:
    """Return the process with its known values so far away that predictions are those of the prior."""
    return replace(process, known=process.known + distance_m)
