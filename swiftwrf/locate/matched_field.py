"""Matched-field processing: the position of the moving end from one spectrum, by the room that was found."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from typing import Annotated, ClassVar, Self

import torch
from annotated_types import Ge, Le
from torch import Tensor

from swiftwrf.array.angles import to_angles, to_direction
from swiftwrf.array.planar import LIGHT_SPEED, differences
from swiftwrf.data.dataset import Numbers
from swiftwrf.data.spectra import Spectra, check_training, direction_of_link
from swiftwrf.data.splits import places
from swiftwrf.errors import InputError, with_article
from swiftwrf.gp import GaussianProcess, choose_kernel, subsample
from swiftwrf.locate.features import (
    CARRIER,
    Features,
    PathWaves,
    SpectrumFeatures,
    channel_numbers,
    channels_beside,
    gain_features,
    nearby_features,
    nearby_numbers,
    room_features,
)
from swiftwrf.locate.posterior import Posterior, inflation, normalised, pooled_weights, read_inflation
from swiftwrf.locate.region import Cells, Region, best_cells, outside_mass, refined
from swiftwrf.locate.spectrum_likelihood import (
    ChannelLikelihood,
    CoarrayLikelihood,
    PathLikelihood,
    PhaseLikelihood,
    Screen,
)
from swiftwrf.models.base import FieldModel
from swiftwrf.models.geometry import GeometryModel
from swiftwrf.models.geometry.channels import coherence, ends
from swiftwrf.models.geometry.fit import GeometryConfig, observe
from swiftwrf.models.geometry.model import kept_snapshots
from swiftwrf.models.geometry.path_gains import PRIORS, PathGains, choose_prior, fit_path_gains, kernel_of
from swiftwrf.positions import to_tensor
from swiftwrf.runtime.checkpoint import Header, Saved, expect
from swiftwrf.runtime.threads import parallel_map
from swiftwrf.runtime.validation import Configured, NonNegativeInt, PositiveInt, all_or_nothing, checked, configuration

FOLDS = 5
NEARBY = "nearby."  # prefix of the names in a file
START_WEIGHTS = (0.05, 0.05, 0.3)  # of the likelihoods, by which the calibration searches
START_WEIGHTS_CHANNEL = (0.5, 0.05, 0.05)
CHANNEL_CELLS = 8  # times as many first cells for channels, which are not computed at each of them
CHANNEL_PARTS = 4  # along each edge of a cell with paths of its own
MIN_FLOOR = 1e-4  # of missing coherence, by rounding
MIN_SPECTRA = 15
BATCH_CANDIDATES = 2048  # whose waves are computed together: as many as a processor's cache holds
BATCH_CELLS = 256  # the same with parts
MAX_KEPT_NUMBERS = 2**25  # co-array numbers of channels at all cells: 134 MB


@configuration
class MatchedFieldConfig:
    """Options of matched-field processing.

    Example:
        >>> MatchedField(MatchedFieldConfig(spacing=0.5, max_cells=10_000)).config.spacing
        0.5
    """

    spacing: Annotated[float, Ge(0.02)] = 0.1
    """spacing of the first cells, in wavelengths"""
    max_cells: Annotated[int, Ge(1), Le(4_000_000)] = 400_000
    """number of first cells at most, of channels 8 times as many"""
    n_best: Annotated[int, Ge(1), Le(100_000)] = 300
    """cells of largest mass that are kept for each spectrum"""
    n_background: Annotated[int, Ge(0), Le(100_000)] = 100
    """cells that represent all others"""
    n_split: Annotated[int, Ge(1), Le(10_000)] = 16
    """cells that are split in each round"""
    n_rounds: Annotated[int, Ge(0), Le(20)] = 3
    """rounds of splitting"""
    n_calibration: PositiveInt = 120
    """held-out spectra that determine the weights of the likelihoods, at most"""
    seed: NonNegativeInt = 0
    """seed of everything random"""


@dataclass(frozen=True, eq=False)
class _Fit:
    """A room fitted to some of the data and what predicts co-array numbers: path gains of spectra, channels nearby."""

    room: GeometryModel
    paths: PhaseLikelihood
    gains: PathGains | None = None
    nearby: GaussianProcess | None = None

    @property
    def features(self) -> tuple[Features, ...]:
        """Predicted co-array numbers."""
        array = self.room.array
        if self.nearby is not None:
            return (nearby_features(array, self.nearby),)
        return (room_features(array), gain_features(array, self.gains)) if self.gains else ()


@dataclass(frozen=True, eq=False)
class _Likelihoods:
    """Likelihoods that share a room and the frequencies relative to the carrier, in the order of their weights."""

    room: GeometryModel
    frequency: Tensor
    parts: tuple[CoarrayLikelihood | ChannelLikelihood | PhaseLikelihood, ...]
    weight: Tensor

    def __call__(self, position: Tensor, observed: SpectrumFeatures) -> Tensor:
        """Return log-likelihoods (k, n, m) of n observations at candidates (n, m, 3) [m], 0 for those of weight 0."""
        n, m, _ = position.shape
        at, owner = position.reshape(-1, 3), torch.arange(n).repeat_interleave(m)

        def of_batch(rows: Tensor) -> Tensor:
            waves, target = PathWaves.at(self.room, at[rows], self.frequency), observed.subset(owner[rows])
            none = torch.zeros(len(rows))
            counted = zip(self.parts, self.weight.tolist(), strict=True)
            return torch.stack([part(waves, target) if weight > 0 else none for part, weight in counted])

        batches = torch.arange(n * m).split(BATCH_CANDIDATES // len(self.frequency))
        return torch.cat(parallel_map(of_batch, batches), dim=1).reshape(len(self.parts), n, m)

    def log_mass(self, cells: Cells, values: Tensor) -> Tensor:
        """Return the logarithms of the posterior masses of cells (n, m) with log-likelihoods (k, n, m)."""
        return normalised(torch.einsum("k,knm->nm", self.weight, values.double()) + cells.log_volume)


class MatchedField(Configured, Saved):
    """Posterior over the position of the moving end, given a spectrum.

    Three likelihoods of spectra are pooled: co-array numbers predicted by constant path gains, by position-dependent path
    gains, and element phases under uncertain path gains. Those of channels are: channels under uncertain and under constant
    path gains, and co-array numbers predicted by constant path gains and measured channels nearby. The covariances come
    from held-out positions, and so do the weights, which maximise the posterior density there. This also calibrates the
    posterior.

    Args:
        config: Options as one object. Defaults to `MatchedFieldConfig()`.
        options: Single options, which replace those of `config`.

    Raises:
        InputError: An unknown option, or a value outside its range.

    Example:
        >>> import swiftwrf
        >>> from swiftwrf.models.geometry import Plane
        >>> spectra = swiftwrf.simulated_room(n=30, grid=swiftwrf.AngularGrid.hemisphere(8, 32))
        >>> train, test = spectra.split()
        >>> room = swiftwrf.GeometryModel.of_planes(train, [Plane((0.0, 0.0, -1.0), offset_m=0.0, gain=-0.6)])
        >>> MatchedField(spacing=0.5).fit(train, room=room).locate(test.spectrum).median.shape
        torch.Size([6, 3])
    """

    kind: ClassVar[str] = "matched-field locator"
    config_type: ClassVar[type[MatchedFieldConfig]] = MatchedFieldConfig
    fitted_attribute = "_fit"
    config: MatchedFieldConfig

    @property
    def room(self) -> GeometryModel:
        """Room whose paths the likelihoods use."""
        self.check_fitted()
        return self._fit.room

    @all_or_nothing
    @checked
    def fit(
        self, train: Spectra, *, room: FieldModel | None = None, region: Region | None = None, progress: bool = False
    ) -> Self:
        """Fit the likelihoods to measured spectra and return the locator.

        Args:
            train: Measured spectra, at least 15, with array, rotation and fixed end.
            room: Fitted model of the scene with a room. Defaults to a search for the room.
            region: Prior over positions. Defaults to the neighbourhood of the training positions, with the mass outside from
                held-out ones.
            progress: Show a progress bar on a terminal.

        Raises:
            InputError: Too few spectra, a property of the data that is missing, or a room of another link.
        """
        check_training(train)
        if len(train) < MIN_SPECTRA:
            raise InputError(
                f"matched-field processing needs {MIN_SPECTRA} spectra to hold a fifth of them out, got {len(train)}"
            )
        if room is not None and room.room is None:
            raise InputError(f"{with_article(room.kind)} has no room to locate by; fit geometry or hybrid")
        own = GeometryModel(seed=self.config.seed).fit(train, like=room, progress=progress)
        self.frequency_hz, self.n_snapshots = train.frequency_hz, 0
        if train.channel is None:
            features = SpectrumFeatures.of(train.store.batches(), own.array, train.grid, self.config.seed)
        else:
            self.n_snapshots = train.channel.shape[1]
            features = SpectrumFeatures.of_channels(train.channel, own.array)
        scene, rows = observe(train, GeometryConfig(seed=self.config.seed))
        fold = places(train.position, FOLDS) % FOLDS
        chosen, prior = own, next(iter(PRIORS))
        if own.planes and not self.n_snapshots:
            chosen, prior, _ = choose_prior(own, scene, fold[rows])
        kernel = kernel_of(scene.moving)
        self.grid = train.grid

        def fitted(kept: Tensor) -> _Fit:
            phases = scene.subset(kept[rows].nonzero()[:, 0])
            part = chosen.refined_on(phases).furnished_on(train.subset(kept))
            if self.n_snapshots:
                return _Fit(part, PathLikelihood(part, torch.zeros(4 + part.reflectors.gain.shape[1])))
            likelihood = PhaseLikelihood.fit([(part, PathWaves.at(part, train.position[kept]), features.subset(kept))])
            return _Fit(part, likelihood, fit_path_gains(part, phases, kernel, prior))

        everything = torch.ones_like(fold, dtype=torch.bool)
        *parts, self._fit = parallel_map(fitted, [*(fold != number for number in range(FOLDS)), everything])
        held = []  # rooms, waves and features of every spectrum, by the fit without its fold
        for number, part in enumerate(parts):
            waves = PathWaves.at(part.room, train.position[fold == number], self._frequency(part.room))
            held.append((part.room, waves, features.subset(fold == number)))
        if self.n_snapshots:
            *parts, self._fit = self._with_nearby(train.position, features, fold, held, [*parts, self._fit])
        self.residual = torch.empty(len(self._fit.features), *features.coarray.shape)
        missing = torch.ones(len(train))
        for number, (part, (_, waves, observed)) in enumerate(zip(parts, held, strict=True)):
            for kind, predict in enumerate(part.features):
                predicted, std = predict(waves)
                self.residual[kind, fold == number] = (predicted - observed.coarray) / std[:, None]
            if observed.channel is not None:
                missing[fold == number] = 1 - coherence(observed.channel, waves.channel)
        if self.n_snapshots:  # furniture is fitted more closely to the channels that determine it than to others
            variance = PathLikelihood.fit(held).log_variance
            *parts, self._fit = (replace(f, paths=PathLikelihood(f.room, variance)) for f in (*parts, self._fit))
        self.floor = max(float(missing.median()), MIN_FLOOR)
        self.observed_power = float(features.coarray.square().mean())
        held_out = [train.position[fold == number] for number in range(FOLDS)]
        others = [Region(train.position[fold != number]) for number in range(FOLDS)]
        self.region = region or Region(train.position, outside=outside_mass(others, held_out))
        # weights by which the calibration searches
        weights = START_WEIGHTS if self.n_snapshots == 0 else START_WEIGHTS_CHANNEL
        self.weight, self.inflation = torch.tensor(weights, dtype=torch.float64), 1.0
        self._prepare()
        self._calibrate(train.position, features, fold, parts)
        self.likelihoods = replace(self.likelihoods, weight=self.weight)
        return self

    def _with_nearby(
        self,
        position: Tensor,
        features: SpectrumFeatures,
        fold: Tensor,
        held: list[tuple[GeometryModel, PathWaves, SpectrumFeatures]],
        fits: list[_Fit],
    ) -> Iterator[_Fit]:
        """Yield fits with the process of the difference of measured channels from their rooms.

        Args:
            position: Positions of the channels (n, 3) [m].
            features: Their features.
            fold: Their folds (n,).
            held: Room without each fold, its waves at the positions of the fold, and the features there.
            fits: Fits without each fold, and to all channels.
        """

        def difference(fit: _Fit, rows: Tensor) -> Tensor:
            batches = position[rows].split(BATCH_CANDIDATES)
            channels = (PathWaves.at(fit.room, at, self._frequency(fit.room)).channel for at in batches)
            return features.coarray[rows] - torch.cat([channel_numbers(own, fit.room.array) for own in channels])

        held_out = torch.empty_like(features.coarray)
        for number, (room, waves, observed) in enumerate(held):
            held_out[fold == number] = observed.coarray - channel_numbers(waves.channel, room.array)
        kernel = choose_kernel(position, held_out[:, None], fold)
        for number, fit in enumerate(fits):
            kept = fold != number  # all channels for the last
            process = GaussianProcess.regress(kernel, position[kept], difference(fit, kept), dtype=torch.float32)
            yield replace(fit, nearby=process)

    likelihoods: _Likelihoods
    _screens: list[Screen]
    """likelihoods at all cells, which choose the cells that are searched"""

    def _prepare(self) -> None:
        """Compute what all spectra share: cells of the region and what is predicted there."""
        extent, limit = self.region.extent, self.config.max_cells
        spacing = self.config.spacing * self.room.array.wavelength
        count = math.prod((extent / spacing).clamp_min(1).tolist())
        self.likelihoods = self._likelihoods(self._fit)
        own = self.likelihoods.parts[-1]
        if isinstance(own, ChannelLikelihood):
            whole = self.region.cells(int(max(min(count, CHANNEL_CELLS * limit) / CHANNEL_PARTS ** len(extent), 1)))
            self.cells, away = whole.cut(CHANNEL_PARTS), whole.centres(CHANNEL_PARTS)
            frequency = self._frequency(self.room)[ends(len(self._frequency(self.room)))]

            def predicted(position: Tensor) -> Tensor:
                return channels_beside(self.room, position, away, frequency).movedim(1, 0).contiguous()

            channels = parallel_map(predicted, whole.position.split(BATCH_CELLS))
            self._screens = [own.screen(channels)]
            near, process = self.likelihoods.parts[1], self._fit.nearby
            assert isinstance(near, CoarrayLikelihood)
            assert process is not None
            if len(self.cells.position) * len(near.distribution.scale) <= MAX_KEPT_NUMBERS:

                def corrected(cells: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
                    channel, position = cells
                    numbers, std = nearby_numbers(channel.movedim(0, 1), position, self.room.array, process)
                    return numbers @ near.distribution.whitening, std

                some = [part for channel in channels for part in channel.split(BATCH_CANDIDATES, dim=1)]
                positions = self.cells.position.split([part.shape[1] for part in some])
                numbers, std = zip(*parallel_map(corrected, zip(some, positions, strict=True)), strict=True)
                self._screens.append(near.screen(torch.cat(numbers), torch.cat(std)))
            return
        self.cells = self.region.cells(int(min(max(count, 1), limit)))
        batches = self.cells.position.split(BATCH_CANDIDATES)
        coarray = [part for part in self.likelihoods.parts if isinstance(part, CoarrayLikelihood)]
        assert self._fit.gains is not None
        # the mean of the path gains takes an eighth of the time of all their fields, and ranks cells nearly alike
        features = coarray[0].features, gain_features(self.room.array, self._fit.gains.averaged())

        def whitened(position: Tensor) -> list[Tensor]:
            waves = PathWaves.at(self.room, position)
            return [
                predict(waves)[0] @ own.distribution.whitening for predict, own in zip(features, coarray, strict=True)
            ]

        parts = zip(*parallel_map(whitened, batches), strict=True)
        ones = torch.ones(len(self.cells.position))
        self._screens = [own.screen(torch.cat(part), ones) for own, part in zip(coarray, parts, strict=True)]

    def _likelihoods(self, fit: _Fit, kept: Tensor | None = None) -> _Likelihoods:
        residual = self.residual if kept is None else self.residual[:, kept]
        coarray = [
            CoarrayLikelihood(predict, part, self.observed_power)
            for predict, part in zip(fit.features, residual, strict=True)
        ]
        frequency = self._frequency(fit.room)
        if self.n_snapshots:
            return _Likelihoods(fit.room, frequency, (fit.paths, *coarray, ChannelLikelihood(self.floor)), self.weight)
        return _Likelihoods(fit.room, frequency, (*coarray, fit.paths), self.weight)

    def _frequency(self, room: GeometryModel) -> Tensor:
        """Return the frequencies of the kept snapshots relative to the carrier, (F,), one where all are at the carrier."""
        if self.frequency_hz is None:
            return CARRIER
        return self.frequency_hz[kept_snapshots(self.n_snapshots)] * room.array.wavelength / LIGHT_SPEED

    def _calibrate(self, position: Tensor, features: SpectrumFeatures, fold: Tensor, parts: list[_Fit]) -> None:
        """Choose the weights of the likelihoods and the inflation of credible radii by held-out positions."""
        (some,) = subsample(torch.arange(len(position)), rows=self.config.n_calibration)
        rows_of = {number: some[fold[some] == number] for number in fold[some].unique().tolist()}
        at_truth, values, volumes, candidates = [], [], [], []
        for number, rows in rows_of.items():
            likelihoods, observed = self._likelihoods(parts[number], fold != number), features.subset(rows)
            at_truth.append(likelihoods(position[rows][:, None], observed)[..., 0])
            for cells, value in self._searched(observed, likelihoods):
                values.append(value)
                volumes.append(cells.log_volume)
                candidates.append(cells.position)
        value, volume, at = torch.cat(values, dim=1).double(), torch.cat(volumes), torch.cat(candidates)
        self.weight = pooled_weights(torch.cat(at_truth, dim=1), value, volume)
        log_mass = torch.einsum("k,knm->nm", self.weight, value) + volume
        held_out = Posterior(at, normalised(log_mass), self._resolution_m)
        self.inflation = inflation(held_out, position[torch.cat(list(rows_of.values()))])

    def _searched(self, observed: SpectrumFeatures, likelihoods: _Likelihoods) -> Iterator[tuple[Cells, Tensor]]:
        """Yield cells (b, m) and log-likelihoods (k, b, m) of some observations at a time."""
        generator = torch.Generator().manual_seed(self.config.seed)
        config = self.config
        for rows in torch.arange(len(observed)).split(16):  # likelihoods at all cells: 26 MB at most, of channels 205
            part = observed.subset(rows)

            def evaluate(position: Tensor, part: SpectrumFeatures = part) -> Tensor:
                return likelihoods(position, part)

            total, *others = (screen(part) for screen in self._screens)
            for other in others:
                total.add_(other)
            cells = best_cells(self.cells, total.neg_(), config.n_best, config.n_background, generator)
            values = evaluate(cells.position)
            for _ in range(config.n_rounds):
                cells, values = refined(cells, likelihoods.log_mass(cells, values), values, evaluate, config.n_split)
            yield cells, values

    @torch.no_grad()
    def locate(self, spectrum: Numbers | Spectra) -> Posterior:
        """Return the posterior over the position of the moving end for each spectrum.

        Args:
            spectrum: Magnitudes in [0, 1], tensor or array (n, n_elevation, n_azimuth) on the grid of the training spectra.
                A locator that was fitted to channels takes channels in their place, complex (n, S, K). `Spectra` may contain
                both.

        Raises:
            InputError: Spectra on another grid, no channels where the training data had them, a number that is not finite,
                or a locator that is not fitted.
        """
        self.check_fitted()
        room = self.room
        if self.n_snapshots:
            channel = spectrum.channel if isinstance(spectrum, Spectra) else spectrum
            if channel is None or not torch.as_tensor(channel).is_complex():
                raise InputError(
                    "this locator was fitted to channels; give channels, complex (n, S, K), in place of spectra"
                )
            shape = None, self.n_snapshots, len(room.array.element)
            channel = to_tensor("channel", channel, torch.complex64, shape)
            observed = SpectrumFeatures.of_channels(channel, room.array)
        else:
            values = spectrum.spectrum if isinstance(spectrum, Spectra) else spectrum
            magnitude = to_tensor("spectra", values, torch.float32, (None, *self.grid.shape))
            observed = SpectrumFeatures.of([magnitude], room.array, self.grid, self.config.seed)
        parts = list(self._searched(observed, self.likelihoods))
        position = torch.cat([cells.position for cells, _ in parts])
        log_weight = torch.cat([self.likelihoods.log_mass(cells, values) for cells, values in parts])
        # within half a wavelength the field changes too little for a second mode
        width = self.room.array.wavelength / 2
        return Posterior(position, log_weight, self._resolution_m, self.inflation, width)

    @property
    def _resolution_m(self) -> float:
        """Edge of the smallest cells [m]."""
        return float(self.cells.edge_m / 2**self.config.n_rounds)

    def predict(self, spectrum: Numbers | Spectra) -> Tensor:
        """Return azimuth and elevation (n, 2) [rad] of the transmitter that minimise the expected angular error."""
        return self.direction(self.locate(spectrum))

    def direction(self, posterior: Posterior) -> Tensor:
        """Return azimuth and elevation (n, 2) [rad] of the smallest expected angular error under a posterior."""
        room, at = self.room, posterior.position
        label = direction_of_link(at.reshape(-1, 3), room.fixed_position, room.rotation, room.moving, room.array)
        vectors = to_direction(*label.unbind(-1)).reshape(at.shape)
        return torch.stack(to_angles(posterior.direction(vectors)), dim=-1)

    def __repr__(self) -> str:
        if not self.is_fitted:
            return f"{type(self).__name__}(not fitted)"
        return f"{type(self).__name__}(fitted, {len(self.room.planes)} planes, {len(self.cells.position):,} cells)"

    def state(self) -> tuple[dict[str, Tensor], Header]:
        """Return the fitted tensors by name, and plain values."""
        tensors, header = self.room.state()
        fit = self._fit
        gains, values = fit.gains.state() if fit.gains else fit.nearby.state(NEARBY) if fit.nearby else ({}, {})
        own = {"statistics": fit.paths.log_variance, "residual": self.residual, "weight": self.weight}
        at, prior_values = self.region.state()
        frequency = None if self.frequency_hz is None else self.frequency_hz.tolist()
        channel = {"n_snapshots": self.n_snapshots, "frequency_hz": frequency, "floor": self.floor}
        plain = {"locator": asdict(self.config), "observed_power": self.observed_power, "inflation": self.inflation}
        plain |= channel
        return tensors | gains | own | at, header | values | plain | prior_values

    @classmethod
    def from_state(cls, tensors: dict[str, Tensor], header: Header) -> Self:
        """Return the locator that `state` describes."""
        locator = cls(MatchedFieldConfig(**header["locator"]))
        room = GeometryModel.from_state(tensors, header)
        features, is_channel = 2 * len(differences(room.array)), bool(header["n_snapshots"])
        n, known = tensors["residual"].shape[1], len(tensors["region"])
        shapes = {
            "statistics": (4 + room.reflectors.gain.shape[1],),
            "residual": (1 if is_channel else 2, n, features),
            "region": (known, 3),
            "weight": (3,),
        }
        expect(tensors, shapes)
        if n < MIN_SPECTRA or bool((tensors["statistics"].abs() > 30).any()):
            raise InputError("residuals, positions or variances are not those of a fitted locator")
        frequency = header["frequency_hz"]
        locator.n_snapshots, locator.floor = int(header["n_snapshots"]), float(header["floor"])
        locator.frequency_hz = None if frequency is None else torch.tensor(frequency, dtype=torch.float64)
        if not locator.floor > 0 or (frequency is not None and len(frequency) != locator.n_snapshots):
            raise InputError("frequencies and missing coherence are not those of a fitted locator")
        locator.grid = room.grid
        if is_channel:
            nearby = GaussianProcess.from_state(tensors, header, torch.float32, prefix=NEARBY)
            expect(tensors, {f"{NEARBY}value": (len(nearby.known), features)})
            locator._fit = _Fit(room, PathLikelihood(room, tensors["statistics"]), nearby=nearby)
        else:
            gains = PathGains.from_state(tensors, header, room)
            locator._fit = _Fit(room, PhaseLikelihood(room, tensors["statistics"]), gains)
        locator.residual, locator.weight = tensors["residual"], tensors["weight"]
        locator.region, locator.observed_power = Region.from_state(tensors, header), float(header["observed_power"])
        locator.inflation = read_inflation(header)
        locator._prepare()
        return locator
