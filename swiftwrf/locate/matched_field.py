"""Matched-field processing: the position of the moving end from one spectrum, by the room that was found."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Annotated, ClassVar, Self

import torch
from annotated_types import Ge, Le
from torch import Tensor

from swiftwrf.array.angles import AngularGrid, to_angles, to_direction
from swiftwrf.data.dataset import Numbers
from swiftwrf.data.spectra import Spectra, check_training, direction_of_link
from swiftwrf.data.splits import each_fold, folds
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
from swiftwrf.runtime.validation import NonNegativeInt, PositiveInt, all_or_nothing, checked, configuration

MIN_SPECTRA = 15


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


class MatchedField(Locator):
    """Posterior over the position of the moving end, given a spectrum.

    Three likelihoods of spectra are pooled: co-array numbers predicted by constant path gains, by position-dependent path
    gains, and element phases under uncertain path gains. Those of channels are: channels under uncertain and under constant
    path gains, and co-array numbers predicted by constant path gains and measured channels nearby. Covariances, weights and
    the radii of credible regions come from held-out positions. Weights maximise the posterior density there. The room is
    searched in all spectra, and refined without each fold.

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

    saved = "likelihoods weight inflation region"
    likelihoods: SpectrumLikelihoods | ChannelLikelihoods

    @property
    def room(self) -> GeometryModel:
        """Room whose paths the likelihoods use."""
        return self.likelihoods.room

    @property
    def grid(self) -> AngularGrid:
        """Grid of the training spectra."""
        return self.room.grid

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
        seed, position = self.config.seed, train.position
        model = GeometryModel(seed=seed).fit(train, like=room, progress=progress)
        train = model.link.aligned(train)
        fold = folds(position, "random", seed)
        kind = SpectrumLikelihoods if train.channel is None else ChannelLikelihoods
        features, (*parts, self.likelihoods) = kind.fit(train, model, fold, seed)
        held_out = ((Region(position[kept]), position[out]) for out, kept in each_fold(fold))
        self.region = region or Region(position, outside=outside_mass(held_out))
        self._prepare()
        self.weight, self.inflation = torch.tensor(kind.start, dtype=torch.float64), 1.0
        self._calibrate(self._held_out(position, features, fold, parts))
        return self

    def _prepare(self) -> None:
        """Compute what all spectra share: cells of the region, and likelihoods there that choose those searched."""
        spacing = self.config.spacing * self.room.array.wavelength
        count = int(math.prod((self.region.extent / spacing).clamp_min(1).tolist()))
        self.cells, self._screens = self.likelihoods.screens(self.region, count, self.config.max_cells)

    _screens: list[Screen]

    def _held_out(
        self, position: Tensor, features: SpectrumFeatures, fold: Tensor, parts: Sequence[Likelihoods]
    ) -> Iterator[HeldOut]:
        """Yield at most `n_calibration` spectra, evenly chosen, by folds, with their likelihoods by the other folds."""
        (chosen,) = subsample(torch.arange(len(position)), rows=self.config.n_calibration)
        for rows, _ in each_fold(fold, chosen):
            likelihoods, observed = parts[int(fold[rows[0]])], features.subset(rows)
            at_truth = likelihoods(position[rows][:, None], observed, self.weight)[..., 0]
            cells, values = zip(*self._searched(observed, likelihoods), strict=True)
            at, volume = (torch.cat([getattr(batch, name) for batch in cells]) for name in ("position", "log_volume"))
            yield HeldOut(position[rows], at_truth, at, torch.cat(values, dim=1).double(), volume)

    def _searched(self, observed: SpectrumFeatures, likelihoods: Likelihoods) -> Iterator[tuple[Cells, Tensor]]:
        """Yield cells (b, m) and log-likelihoods (k, b, m) of 16 observations at a time."""
        generator = torch.Generator().manual_seed(self.config.seed)
        config = self.config
        for rows in torch.arange(len(observed)).split(16):  # likelihoods at all cells: 26 MB at most, of channels 205
            part = observed.subset(rows)

            def evaluate(position: Tensor, part: SpectrumFeatures = part) -> Tensor:
                return likelihoods(position, part, self.weight)

            total, *others = (screen(part) for screen in self._screens)
            for other in others:
                total.add_(other)
            cells = best_cells(self.cells, total.neg_(), config.n_best, config.n_background, generator)
            values = evaluate(cells.position)
            for _ in range(config.n_rounds):
                log_mass = self._posterior(cells.position, values, cells.log_volume).log_weight
                cells, values = refined(cells, log_mass, values, evaluate, config.n_split)
            yield cells, values

    @torch.no_grad()
    def locate(self, spectrum: Numbers | Spectra) -> Posterior:
        """Return the posterior over the position of the moving end for each spectrum.

        Args:
            spectrum: Magnitudes in [0, 1], tensor or array (n, n_elevation, n_azimuth) on the grid of the training spectra.
                A locator that was fitted to channels takes channels in their place, complex (n, S, K). `Spectra` may contain
                both.

        Raises:
            InputError: No row, spectra on another grid or of another link, no channels where the training data had them, a
                number that is not finite, or a locator that is not fitted.
        """
        self.check_fitted()
        if not len(spectrum):
            raise InputError("there is no row to locate")
        if isinstance(spectrum, Spectra):
            spectrum = self.room.link.aligned(spectrum)
        observed = self.likelihoods.features(spectrum, self.config.seed)
        parts = self._searched(observed, self.likelihoods)
        posterior = Posterior.cat(
            [self._posterior(cells.position, values, cells.log_volume) for cells, values in parts]
        )
        # within half a wavelength the field changes too little for a second mode
        return replace(posterior, mode_width_m=self.room.array.wavelength / 2)

    @property
    def _resolution_m(self) -> float:
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

    def _restored(self) -> None:
        self.likelihoods.check()
        self._prepare()
