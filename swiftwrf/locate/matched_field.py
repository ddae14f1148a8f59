"""Matched-field processing: the position of the moving end from its spectra at one or several stations, by their rooms."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar, Self

import torch
from annotated_types import Ge, Le
from torch import Tensor

from swiftwrf.array.angles import AngularGrid, to_angles, to_direction
from swiftwrf.data.dataset import Numbers
from swiftwrf.data.spectra import Spectra, check_training, direction_of_link
from swiftwrf.data.splits import each_fold, folds
from swiftwrf.data.stations import Stations
from swiftwrf.errors import InputError, with_article
from swiftwrf.gp import subsample
from swiftwrf.locate.features import SpectrumFeatures
from swiftwrf.locate.likelihoods import ChannelLikelihoods, Likelihoods, SpectrumLikelihoods
from swiftwrf.locate.locator import Locator
from swiftwrf.locate.posterior import HeldOut, Posterior
from swiftwrf.locate.region import Cells, Region, best_cells, outside_mass, refined
from swiftwrf.locate.spectrum_likelihood import Screen
from swiftwrf.models.base import FieldModel
from swiftwrf.models.geometry import GeometryModel
from swiftwrf.models.geometry.agreement import agreed
from swiftwrf.runtime.validation import NonNegativeInt, PositiveInt, all_or_nothing, checked, configuration

MIN_SPECTRA = 15  # of a station: three in each of five folds


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


Rooms = FieldModel | Mapping[str, FieldModel]
ONE = ""  # name of the only station of plain spectra
ALL = -1  # in place of the number of a fold: none is held out


@dataclass(frozen=True, eq=False)
class Observed:
    """Features of n transmissions at A stations.

    Args:
        row: Row of each transmission in the features of each station, int64 (n, A), -1 where a station did not receive it.
        features: Features of each station, None of one that received nothing.
    """

    row: Tensor
    features: Sequence[SpectrumFeatures | None]

    def subset(self, rows: Tensor) -> Observed:
        """Return the features of some of the transmissions."""
        return replace(self, row=self.row[rows])

    def stations(self) -> Iterator[tuple[Tensor, SpectrumFeatures | None]]:
        """Yield the numbers of the transmissions that each station received, and their features there, None without any."""
        for row, features in zip(self.row.T, self.features, strict=True):
            received = (row >= 0).nonzero()[:, 0]
            yield received, None if features is None or not len(received) else features.subset(row[received])

    def __len__(self) -> int:
        return len(self.row)


class MatchedField(Locator):
    """Posterior over the position of the moving end, given its spectrum at one station or at several.

    Three likelihoods of spectra are pooled: co-array numbers predicted by constant path gains, by position-dependent path
    gains, and element phases under uncertain path gains. Those of channels are: channels under uncertain and under constant
    path gains, and co-array numbers predicted by constant path gains and measured channels nearby. Covariances, weights and
    the radii of credible regions come from held-out positions. Weights maximise the posterior density there. The room is
    searched in all spectra, and refined without each fold.

    The likelihoods of several stations are pooled in the same way, so a station with a poor room has small weights. A
    transmission need not have been received by all stations.

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
    config: MatchedFieldConfig

    saved = "stations likelihoods weight inflation region"
    stations: Annotated[tuple[str, ...], "a"]
    """names of the stations, one empty name for spectra of a single one"""
    likelihoods: Annotated[tuple[SpectrumLikelihoods | ChannelLikelihoods, ...], "a"]
    """likelihoods of each station"""

    @property
    def room(self) -> GeometryModel:
        """Room whose paths the likelihoods use.

        Raises:
            InputError: There are several stations, each with its room in `rooms`.
        """
        if len(self.likelihoods) > 1:
            raise InputError(f"{self!r} has a room for each station, see `rooms`")
        return self.likelihoods[0].room

    @property
    def rooms(self) -> dict[str, GeometryModel]:
        """Room of each station."""
        return {name: each.room for name, each in zip(self.stations, self.likelihoods, strict=True)}

    @property
    def grid(self) -> AngularGrid:
        """Grid of the training spectra of a single station."""
        return self.room.grid

    @all_or_nothing
    @checked
    def fit(
        self,
        train: Spectra | Stations,
        *,
        room: Rooms | None = None,
        region: Region | None = None,
        progress: bool = False,
    ) -> Self:
        """Fit the likelihoods to measured spectra and return the locator.

        Args:
            train: Measured spectra, at least 15 of each station, with array, rotation and fixed end.
            room: Fitted model of the scene with a room, of several stations by their names. Defaults to a search for the
                room of each station, and rooms that agree about their planes.
            region: Prior over positions. Defaults to the neighbourhood of the training positions, with the mass outside from
                held-out ones.
            progress: Show a progress bar on a terminal.

        Raises:
            InputError: Too few spectra, a property of the data that is missing, or a room of another link.
        """
        data, seed, position = _by_station(train), self.config.seed, train.position
        for station, (_, spectra) in data.items():
            if len(spectra) < MIN_SPECTRA:
                raise InputError(
                    f"matched-field processing needs {MIN_SPECTRA} spectra to hold a fifth of them out, got {len(spectra)}"
                    f"{station and f' of station {station}'}"
                )
            check_training(spectra)
        if len({spectra.channel is None for _, spectra in data.values()}) > 1:
            raise InputError(f"{train.name} has channels of some stations and none of others; locate by spectra alone")
        known = room if isinstance(room, Mapping) else dict.fromkeys(data, room)
        if different := data.keys() ^ known.keys():
            raise InputError(f"{train.name} and the rooms have other stations: {', '.join(sorted(different))}")
        for own in known.values():
            if own is not None and own.room is None:
                raise InputError(f"{with_article(own.kind)} has no room to locate by; fit geometry or hybrid")
        rooms = {
            station: GeometryModel(seed=seed).fit(spectra, like=known[station], progress=progress)
            for station, (_, spectra) in data.items()
        }
        if room is None and len(rooms) > 1:
            rooms = agreed(rooms, {station: spectra for station, (_, spectra) in data.items()})
        fold = folds(position, "random", seed)
        fitted, features = list[dict[int, SpectrumLikelihoods | ChannelLikelihoods]](), list[SpectrumFeatures]()
        for station, (rows, spectra) in data.items():
            own = rooms[station]
            kind = SpectrumLikelihoods if spectra.channel is None else ChannelLikelihoods
            seen, parts = kind.fit(own.link.aligned(spectra), own, fold[rows], seed)
            features.append(seen)
            fitted.append(dict(zip([*fold[rows].unique().tolist(), ALL], parts, strict=True)))
        self.stations, self.likelihoods = tuple(data), tuple(parts[ALL] for parts in fitted)
        held_out = ((Region(position[kept]), position[out]) for out, kept in each_fold(fold))
        self.region = region or Region(position, outside=outside_mass(held_out))
        self._prepare()
        start = [weight for each in self.likelihoods for weight in each.start]
        self.weight, self.inflation = torch.tensor(start, dtype=torch.float64), 1.0
        observed = Observed(_rows(data, self.stations, len(position)), features)
        self._calibrate(self._held_out(position, observed, fold, fitted))
        return self

    def _prepare(self) -> None:
        """Compute what all spectra share: cells of the region, and likelihoods there that choose those searched."""
        wavelength = min(each.room.array.wavelength for each in self.likelihoods)
        count = int(math.prod((self.region.extent / (self.config.spacing * wavelength)).clamp_min(1).tolist()))
        prepared = [each.screens(self.region, count, self.config.max_cells) for each in self.likelihoods]
        self.cells, self._screens = prepared[0][0], [screens for _, screens in prepared]

    _screens: list[list[Screen]]

    def _held_out(
        self, position: Tensor, observed: Observed, fold: Tensor, fitted: Sequence[Mapping[int, Likelihoods]]
    ) -> Iterator[HeldOut]:
        """Yield at most `n_calibration` transmissions, by folds, with their likelihoods by the other folds."""
        (chosen,) = subsample(torch.arange(len(position)), rows=self.config.n_calibration)
        for rows, _ in each_fold(fold, chosen):
            number, part = int(fold[rows[0]]), observed.subset(rows)
            likelihoods = [parts.get(number, parts[ALL]) for parts in fitted]  # a station may have none of the fold
            at_truth = self._values(likelihoods, position[rows][:, None], part)[..., 0]
            cells, values = zip(*self._searched(part, likelihoods), strict=True)
            at, volume = (torch.cat([getattr(each, name) for each in cells]) for name in ("position", "log_volume"))
            yield HeldOut(position[rows], at_truth, at, torch.cat(values, dim=1).double(), volume)

    def _values(self, likelihoods: Sequence[Likelihoods], position: Tensor, observed: Observed) -> Tensor:
        """Return log-likelihoods (k, n, m) at candidates (n, m, 3), 0 by stations that did not receive a transmission."""
        weights = self.weight.split([len(each.start) for each in likelihoods])
        found = []
        for likelihood, weight, (received, features) in zip(likelihoods, weights, observed.stations(), strict=True):
            values = torch.zeros(len(weight), *position.shape[:2])
            if features is not None:
                values[:, received] = likelihood(position[received], features, weight)
            found.append(values)
        return torch.cat(found)

    def _searched(self, observed: Observed, likelihoods: Sequence[Likelihoods]) -> Iterator[tuple[Cells, Tensor]]:
        """Yield cells (b, m) and log-likelihoods (k, b, m) of 16 transmissions at a time."""
        generator = torch.Generator().manual_seed(self.config.seed)
        config = self.config
        for rows in torch.arange(len(observed)).split(16):  # likelihoods at all cells: 26 MB at most, of channels 205
            part = observed.subset(rows)

            def evaluate(position: Tensor, part: Observed = part) -> Tensor:
                return self._values(likelihoods, position, part)

            total = torch.zeros(len(part), len(self.cells.position))
            for screens, (received, features) in zip(self._screens, part.stations(), strict=True):
                if features is not None:
                    for screen in screens:
                        total.index_add_(0, received, screen(features))
            cells = best_cells(self.cells, total.neg_(), config.n_best, config.n_background, generator)
            values = evaluate(cells.position)
            for _ in range(config.n_rounds):
                log_mass = self._posterior(cells.position, values, cells.log_volume).log_weight
                cells, values = refined(cells, log_mass, values, evaluate, config.n_split)
            yield cells, values

    @torch.no_grad()
    def locate(self, spectrum: Numbers | Spectra | Stations) -> Posterior:
        """Return the posterior over the position of the moving end for each spectrum.

        Args:
            spectrum: Magnitudes in [0, 1], tensor or array (n, n_elevation, n_azimuth) on the grid of the training spectra.
                A locator that was fitted to channels takes channels in their place, complex (n, S, K). `Spectra` may contain
                both. A locator of several stations takes `Stations`, of which some may be missing.

        Raises:
            InputError: No row, spectra on another grid or of another link, no channels where the training data had them, a
                number that is not finite, other stations, or a locator that is not fitted.
        """
        self.check_fitted()
        if not len(spectrum):
            raise InputError("there is no row to locate")
        data, features = self._by_station(spectrum), list[SpectrumFeatures | None]()
        for station, likelihoods in zip(self.stations, self.likelihoods, strict=True):
            if station in data:
                _, spectra = data[station]
                aligned = likelihoods.room.link.aligned(spectra) if isinstance(spectra, Spectra) else spectra
                features.append(likelihoods.features(aligned, self.config.seed))
            else:
                features.append(None)
        return self._located(Observed(_rows(data, self.stations, len(spectrum)), features))

    def _located(self, observed: Observed) -> Posterior:
        parts = self._searched(observed, self.likelihoods)
        posterior = Posterior.cat(
            [self._posterior(cells.position, values, cells.log_volume) for cells, values in parts]
        )
        # within half a wavelength the field changes too little for a second mode
        return replace(posterior, mode_width_m=max(each.room.array.wavelength for each in self.likelihoods) / 2)

    def elsewhere(self, rooms: Mapping[str, tuple[str, GeometryModel]], config: MatchedFieldConfig) -> Self:
        """Return the locator of equal arrays in other poses, without what was measured at positions.

        Args:
            rooms: Name of the station of this locator that each array is equal to, and its room, by name.
            config: Options of the search.
        """
        like = [self.stations.index(name) for name, _ in rooms.values()]
        weights = self.weight.split([len(each.start) for each in self.likelihoods])
        found = copy(self)
        found.config, found.stations, found.weight = (
            config,
            tuple(rooms),
            torch.cat([weights[number] for number in like]),
        )
        found.likelihoods = tuple(
            self.likelihoods[number].elsewhere(room) for number, (_, room) in zip(like, rooms.values(), strict=True)
        )
        found._prepare()
        return found

    @torch.no_grad()
    def located_samples(self, position: Tensor, seed: int = 0) -> Posterior:
        """Return posteriors of spectra that are simulated at positions (n, 3) by the rooms and their errors."""
        generator = torch.Generator().manual_seed(seed)
        features = [each.sample(position, generator) for each in self.likelihoods]
        return self._located(Observed(torch.arange(len(position))[:, None].expand(-1, len(features)), features))

    def _by_station(self, spectrum: Numbers | Spectra | Stations) -> Mapping[str, tuple[Tensor, Numbers | Spectra]]:
        """Return the rows that stations of this locator received, and their spectra, by station.

        Raises:
            InputError: Plain spectra for several stations, or stations of which this locator has none.
        """
        if isinstance(spectrum, Stations):
            if unknown := spectrum.spectra.keys() - set(self.stations):
                known = ", ".join(filter(None, self.stations)) or "plain spectra"
                raise InputError(f"this locator was fitted to {known}, not to {', '.join(sorted(unknown))}")
            parts = {station: spectrum.of(station) for station in spectrum.spectra}
            return {station: (rows, spectra) for station, (rows, spectra) in parts.items() if len(rows)}
        if len(self.stations) > 1:
            raise InputError(f"this locator takes Stations with {', '.join(self.stations)}, or some of them")
        return {self.stations[0]: (torch.arange(len(spectrum)), spectrum)}

    @property
    def _resolution_m(self) -> float:
        return float(self.cells.edge_m / 2**self.config.n_rounds)

    def predict(self, spectrum: Numbers | Spectra | Stations) -> Tensor:
        """Return azimuth and elevation [rad] of the moving end that minimise the expected angular error.

        Returns:
            Directions (n, 2), of several stations (n, A, 2).
        """
        posterior = self.locate(spectrum)
        found = torch.stack([self.direction(posterior, station) for station in self.stations], dim=1)
        return found if len(self.stations) > 1 else found[:, 0]

    def direction(self, posterior: Posterior, station: str | None = None) -> Tensor:
        """Return azimuth and elevation (n, 2) [rad] of the smallest expected angular error under a posterior.

        Args:
            posterior: Posterior of n transmissions.
            station: Station of the directions, one of several.

        Raises:
            InputError: No station of this name, or none of several.
        """
        room = self.room if station is None else self.rooms.get(station)
        if room is None:
            raise InputError(f"there is no station {station!r}; choose one of {', '.join(self.stations)}")
        at = posterior.position
        label = direction_of_link(at.reshape(-1, 3), room.fixed_position, room.rotation, room.moving, room.array)
        vectors = to_direction(*label.unbind(-1)).reshape(at.shape)
        return torch.stack(to_angles(posterior.direction(vectors)), dim=-1)

    def __repr__(self) -> str:
        if not self.is_fitted:
            return f"{type(self).__name__}(not fitted)"
        planes = " + ".join(str(len(room.planes)) for room in self.rooms.values())
        return f"{type(self).__name__}(fitted, {planes} planes, {len(self.cells.position):,} cells)"

    def _restored(self) -> None:
        for each in self.likelihoods:
            each.check()
        if len(self.weight) != sum(len(each.start) for each in self.likelihoods):
            raise InputError(f"{len(self.stations)} stations do not have {len(self.weight)} weights")
        self._prepare()


def _by_station(data: Spectra | Stations) -> dict[str, tuple[Tensor, Spectra]]:
    """Return the rows that each station received, and its spectra, by station."""
    if isinstance(data, Stations):
        return {station: data.of(station) for station in data.spectra}
    return {ONE: (torch.arange(len(data)), data)}


def _rows(data: Mapping[str, tuple[Tensor, Any]], stations: Sequence[str], n: int) -> Tensor:
    """Return the row of each of n transmissions at each station, (n, A), -1 where a station did not receive it."""
    row = torch.full((n, len(stations)), -1)
    for number, station in enumerate(stations):
        if station in data:
            received = data[station][0]
            row[received, number] = torch.arange(len(received))
    return row
