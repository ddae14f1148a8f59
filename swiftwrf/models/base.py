"""The interface of every field model: fit to measured spectra, then predict spectra at any position."""

from __future__ import annotations

import warnings
from abc import abstractmethod
from collections.abc import Callable, Iterable
from copy import copy
from pathlib import Path
from typing import Annotated, Any, ClassVar, Self

import torch
from annotated_types import Gt, Le
from torch import Tensor

from swiftwrf.array.angles import AngularGrid
from swiftwrf.choices import FIELD_MODELS, PUBLISHED, Moving
from swiftwrf.data.dataset import Data, Numbers, PositionedData
from swiftwrf.data.spectra import Spectra, check_training, to_magnitudes
from swiftwrf.data.splits import Validation
from swiftwrf.data.store import Store
from swiftwrf.errors import InputError, with_article
from swiftwrf.models.link import Link
from swiftwrf.models.prediction import Prediction
from swiftwrf.plotting import Axes, Displayed, extent
from swiftwrf.positions import check_near, check_positions, to_tensor
from swiftwrf.runtime.checkpoint import Header, Saved, check_folder
from swiftwrf.runtime.descent import Record
from swiftwrf.runtime.threads import single_thread, to_device
from swiftwrf.runtime.validation import (
    NonNegativeInt,
    Preset,
    all_or_nothing,
    checked,
    configuration,
)

ARRAY, FIXED_END = "array", "fixed end"  # requirements that a model can declare
CPU = torch.device("cpu")
ALREADY_LEARNT = "are already in the model and are left out"


@configuration
class FieldConfig:
    """Options of every field model.

    Example:
        >>> FieldConfig(validation="block", seed=3).validation
        'block'
    """

    validation: Validation = "random"
    """training rows held out to choose settings: single ones at random, one region at a time, or whole sessions of RSSI"""
    seed: NonNegativeInt = 0
    """seed of everything random"""


class Updatable:
    """Base class of models that recognise the rows that they have learnt, so that they learn none twice."""

    updates: ClassVar[bool] = False
    """whether `update` is available; other models must be fitted again"""
    row_digests: Annotated[Tensor, "int64 rows"] = torch.zeros(0, dtype=torch.int64)
    """digests of the rows that the model has learnt, in their order, set by `fit` and `update`"""

    def is_learnt(self, new: PositionedData) -> Tensor:
        """Return True for rows that the model has learnt, by their number, time, position and values, bool (n,)."""
        return torch.isin(new.row_digests(), self.row_digests)

    def _not_learnt(self, new: Data) -> Data:
        """Return the rows that the model has not learnt, and warn of the others."""
        if n_known := int((known := self.is_learnt(new)).sum()):
            warnings.warn(f"{new.name}: {n_known} of {len(new)} rows {ALREADY_LEARNT}", stacklevel=4)
        return new.subset(~known) if n_known else new

    def _digests_without(self, rows: Tensor, n: int) -> Tensor:
        """Return the digests without those of rows, given by their numbers among n rows. The last of these have digests."""
        return self.row_digests[~torch.isin(torch.arange(-len(self.row_digests), 0), rows - n)]


class FieldModel(Updatable, Saved, Displayed):
    """Base class of all field models.

    A subclass implements `_fit` and `_predict`. For `save` and `load` it names what `_fit` sets in `saved` and annotates it;
    see `Saved`. Its `name` and its `kind` in files default to the name of the class. `config_type` declares the options,
    which are keyword arguments of the constructor. `augment.choose_model` takes the class or an object of it. The decorator
    `FIELD_MODELS.register("name")` of `swiftwrf.models` makes the name known to `make_model` and to the tasks of this
    process.

    Args:
        config: Options as one object. Defaults to those of the preset.
        preset: "quick" for the defaults, sized for a desktop; "paper" for the settings of the model's publication.
        options: Single options, which replace those of `config`.

    Raises:
        InputError: An unknown option, or a value outside its range.

    Example:
        >>> import swiftwrf
        >>> class Mean(swiftwrf.FieldModel):
        ...     def _fit(self, train, **_):
        ...         self.mean = train.store.mean()
        ...     def _predict(self, position, grid, with_std):
        ...         return self.mean.expand(len(position), -1, -1), None
        >>> train, test = swiftwrf.simulated_room(n=50).split()
        >>> Mean().fit(train).predict(test.position).mean.shape
        torch.Size([10, 30, 120])
    """

    config_type: ClassVar[type[Any]] = FieldConfig
    """dataclass of the options"""
    fitted_attribute = "grid"
    name: ClassVar[str]
    """name in the registry, on the command line and in reports"""
    requires: ClassVar[tuple[str, ...]] = ()
    """properties of the data that the model needs: ARRAY, FIXED_END"""
    searches: ClassVar[bool] = False
    """whether `fit` searches a structure that it can reuse from another model"""
    slow: ClassVar[bool] = False
    """whether a fit takes minutes, so that it is compared only on request"""
    any_grid: ClassVar[bool] = False
    """whether `predict` takes other grids than that of the training spectra"""
    batch: ClassVar[int] = 64
    """positions evaluated at a time, which bounds the memory"""

    saved = "grid bounds link row_digests"
    grid: AngularGrid
    """grid of the training spectra, set by `fit`"""
    bounds: Annotated[Tensor, "float64 2 3"]
    """corners of the box around the training positions, float64 (2, 3) [m], set by `fit`"""
    link: Link
    """link of the training spectra, set by `fit`"""

    def __init_subclass__(cls, **options: Any) -> None:
        cls.name, cls.kind = (vars(cls).get(attribute, cls.__name__) for attribute in ("name", "kind"))
        super().__init_subclass__(**options)

    @classmethod
    def lacking(cls, data: Spectra | Link) -> list[str]:
        """Return the requirements of the model that the data do not meet."""
        known = {
            ARRAY: data.array is not None,
            FIXED_END: data.fixed_position is not None and data.rotation is not None,
        }
        return [need for need in cls.requires if not known[need]]

    @classmethod
    def accepts_like(cls, model: FieldModel) -> bool:
        """Return True if `fit` can reuse the structure of this fitted model."""
        return cls.searches and type(model) is cls

    @all_or_nothing
    @checked
    def fit(
        self,
        train: Spectra,
        *,
        like: FieldModel | None = None,
        device: torch.device | str = "cpu",
        checkpoint: Path | None = None,
        on_record: Callable[[Record], None] | None = None,
        progress: bool = False,
    ) -> Self:
        """Fit the model to measured spectra and return it. A fit that fails leaves the model as it was.

        Args:
            train: Training spectra, at least 10.
            like: Fitted model of the same link whose structure (planes, number of primitives) is reused, not searched.
                Options that state the structure take precedence.
            device: Device to compute on.
            checkpoint: File for the state of a long fit. If it exists, the fit continues from it.
            on_record: Called with each evaluation: stage, steps, loss, seconds.
            progress: Show a progress bar on a terminal.

        Raises:
            InputError: Too few spectra, values that are not finite, a missing requirement, a `like` of another link, or a
                checkpoint of another fit or in a folder that does not exist.
            FitError: The loss diverged.
        """
        device = to_device(device)
        if checkpoint is not None:
            check_folder(checkpoint, "checkpoint")
        check_training(train)
        self._check_described(train)
        if like is not None and not self.accepts_like(like):
            raise InputError(f"{self.name} cannot reuse the structure of {with_article(like.kind)}")
        if like is not None:
            train = like.link.aligned(train)
        self.grid, self.bounds, self.link = train.grid, bounding_box(train.position), Link.from_spectra(train)
        self.row_digests = train.row_digests() if self.updates else self.row_digests
        self._fit(train, like=like, device=device, checkpoint=checkpoint, on_record=on_record, progress=progress)
        return self

    def _check_described(self, data: Spectra) -> None:
        if lacking := self.lacking(data):
            raise InputError(f"{self.name} needs the {' and the '.join(lacking)}, which {data.name} does not describe")

    @abstractmethod
    def _fit(self, train: Spectra, **arguments: Any) -> None:
        """Fit to checked data.

        Args:
            train: Training spectra.
            arguments: The other arguments of `fit`. A model declares those that it uses, and ignores the rest by `**_`.
        """

    @abstractmethod
    def _predict(self, position: Tensor, grid: AngularGrid, with_std: bool) -> tuple[Tensor, Tensor | None]:
        """Return magnitudes (b, H, W) and their standard deviation for one batch of positions (b, 3), float64 [m].

        Differentiable where the mathematics is. Magnitudes need not be clipped. The standard deviation may be None.
        """

    @checked
    def predict(self, position: Numbers, grid: AngularGrid | None = None) -> Prediction:
        """Predict spectra.

        Gradients flow to the positions, and to parameters of the model that require them, unless torch.no_grad is active.

        Args:
            position: Positions of the moving end, tensor or array (n, 3) [m].
            grid: Directions. Defaults to the grid of the training spectra.

        Returns:
            Magnitudes in [0, 1], float32 (n, n_elevation, n_azimuth), on the model's device, and standard deviations.

        Raises:
            InputError: Positions of another shape or not finite, a grid that the model cannot predict, or a model that is
                not fitted.
        """
        return self._predicted(position, grid, with_std=True)

    @checked
    def synthesize(self, position: Numbers, grid: AngularGrid | None = None) -> Tensor:
        """Return the mean of `predict` alone, without the cost of the standard deviation."""
        return self._predicted(position, grid, with_std=False).mean

    def _predicted(self, position: Numbers, grid: AngularGrid | None, with_std: bool) -> Prediction:
        """Predict a batch of positions at a time, with gradients only where a position or parameter requires them."""
        grid, position = self._checked_grid(grid), check_positions(position).to(self.device)
        batch = self._batch_on(position.device)

        def evaluate(part: Tensor) -> tuple[Tensor, Tensor | None]:
            mean, std = self._predict(part, grid, with_std)
            shape = len(part), *grid.shape
            mean = check_predicted(self, mean, shape).float().clamp(0, 1)
            # images of 8 bits, in which spectra are stored, have steps of 1 / 255
            return mean, None if std is None else check_predicted(self, std, shape).float().clamp_min(1 / 255)

        differentiable = position.requires_grad or any(tensor.requires_grad for tensor in self.parameters())
        with torch.set_grad_enabled(torch.is_grad_enabled() and differentiable):
            if torch.is_grad_enabled() or len(position) <= batch:
                means, stds = zip(*(evaluate(part) for part in position.split(batch)), strict=True)
                mean = means[0] if len(means) == 1 else torch.cat(means)
                std = None if stds[0] is None else torch.cat(stds)
            else:  # into one tensor, because a list of parts would double the memory
                mean, std = torch.empty(len(position), *grid.shape, device=position.device), None
                for start in range(0, len(position), batch):
                    rows = slice(start, start + batch)
                    mean[rows], part = evaluate(position[rows])
                    if part is not None:
                        std = torch.empty_like(mean) if std is None else std
                        std[rows] = part
        return Prediction(mean, std, position, grid)

    @single_thread()
    @checked
    def update(self, new: Spectra) -> Self:
        """Return the model with more training spectra, by an update of its factorisation. This model stays as it is.

        The result equals a fit to all spectra with the same kernel, noise and components. The planes of a room are refined
        and not searched, which needs 10 new positions. Furniture stays.

        Args:
            new: Spectra of the same link on the grid of the training spectra, any number. Those that the model has already
                learnt are left out, with a warning.

        Raises:
            InputError: A model that must be fitted again, or as `aligned`.

        Example:
            >>> import swiftwrf
            >>> data = swiftwrf.simulated_room(n=50)
            >>> model = swiftwrf.make_model("coarray").fit(data.subset(torch.arange(40)))
            >>> model.update(data.subset(torch.arange(40, 50))).process.known.shape
            torch.Size([50, 3])
        """
        new = self._not_learnt(self.aligned(new))
        model = self._copy()
        if len(new):
            model.bounds = bounding_box(torch.cat([self.bounds, new.position]))
            model._update(new)
            model.row_digests = torch.cat([self.row_digests, new.row_digests()])
        return model

    def aligned(self, new: Spectra) -> Spectra:
        """Return spectra as the model takes them: snapshots in the order of the training spectra. Refuse other measurements.

        Raises:
            InputError: Another grid or link than that of the training spectra, positions far away from them, or a spectrum
                that is not finite.
        """
        if new.grid != self._checked_grid(None):
            raise InputError(
                f"{new.name} has another grid than the training spectra; give spectra of {self.grid.shape}"
            )
        self._check_described(new)
        new = self.link.aligned(new)
        check_near(new.name, new.position, self.bounds)
        check_training(new, least=0)
        return new

    def forget(self, rows: Numbers) -> Self:
        """Return the model without some of its training spectra; see `update`.

        Args:
            rows: Numbers of training spectra, in the order in which the model received them, int64.

        Raises:
            InputError: A model that must be fitted again, all of its spectra, or a number outside the range.
        """
        model, rows = self._copy(), to_tensor("rows", rows, torch.int64, (None,))
        model._forget(rows)
        model.row_digests = self._digests_without(rows, len(self.region()))
        return model

    @checked
    def aged(self, correlation: Annotated[float, Gt(0), Le(1)]) -> Self:
        """Return the model after a change of the scene, for which earlier spectra count less than new ones.

        Args:
            correlation: Correlation of the fields before and after the change, above 0 and at most 1.

        Raises:
            InputError: A model that must be fitted again, or a correlation outside the range.
        """
        model = self._copy()
        model._age(correlation)
        return model

    def _copy(self) -> Self:
        """Return a copy that shares all tensors."""
        self.check_fitted()
        return copy(self)

    def _update(self, new: Spectra) -> None:
        """Add checked spectra to this copy."""
        raise InputError(f"{self.kind}: cannot be updated; fit it again to all spectra")

    def _forget(self, rows: Tensor) -> None:
        """Remove training spectra from this copy."""
        raise InputError(f"{self.kind}: cannot forget single spectra; fit it again to the others")

    def _age(self, correlation: float) -> None:
        """Lower the weight of the training spectra of this copy."""
        raise InputError(f"{self.kind}: cannot weigh earlier spectra less; fit it again to the new ones")

    @property
    def room(self) -> Any:
        """`GeometryModel` of the room that the model estimates or uses; None for models without one."""
        return None

    @property
    def fixed_end(self) -> tuple[Tensor, Tensor, Moving] | None:
        """Position of the fixed end (3,) [m], rotation of the array (3, 3), both on the CPU, and moving end.

        None if the training spectra do not describe them.
        """
        position, rotation = self.link.fixed_position, self.link.rotation
        return None if position is None or rotation is None else (position, rotation, self.link.moving)

    def region(self) -> Tensor:
        """Return positions (n, 3) [m] around which the model was fitted, on the CPU.

        Defaults to centre and corners of the box around the training positions. Models that store the training positions
        return these.
        """
        self._checked_grid(None)
        return torch.cat([self.bounds.mean(dim=0, keepdim=True), self.bounds])

    def parameters(self) -> Iterable[Tensor]:
        """Return the tensors that can require gradients; none by default."""
        return ()

    @property
    def device(self) -> torch.device:
        """Device of the fitted tensors."""
        return next((tensor.device for tensor in self.parameters()), CPU)

    def _batch_on(self, device: torch.device) -> int:
        """Return the number of positions evaluated at a time on a device."""
        return self.batch

    def _checked_grid(self, grid: AngularGrid | None) -> AngularGrid:
        self.check_fitted()
        if grid is not None and grid != self.grid and not self.any_grid:
            raise InputError(f"{self.name} predicts spectra on the grid of its training spectra only")
        return grid or self.grid

    def state(self) -> tuple[dict[str, Tensor], Header]:
        if self.saved == FieldModel.saved:
            raise InputError(f"{self.name} cannot be saved; its class must name what `_fit` sets in `saved`")
        return super().state()

    def _restored(self) -> None:
        if lacking := self.lacking(self.link):
            raise InputError(f"it lacks the {' and the '.join(lacking)}")

    def plot(self, position: Numbers, ax: Axes | None = None) -> Axes:
        """Draw the predicted spectrum at one position, seen along the normal of the array.

        Args:
            position: Position of the moving end, (3,) [m].
            ax: Polar axes to draw into. Defaults to those of a new figure.

        Raises:
            InputError: As `predict`.

        Example:
            >>> import swiftwrf
            >>> room = swiftwrf.simulated_room(n=20)
            >>> make_model("nearest").fit(room).plot(room.position[0]).get_title()
            'nearest at ... m'
        """
        position = check_positions(position, "position", (3,))
        prediction = self.predict(position[None])
        at = ", ".join(f"{coordinate:.2f}" for coordinate in position.tolist())
        ax = prediction.plot(ax=ax)
        ax.set_title(f"{self.name} at ({at}) m")
        return ax

    def _facts(self) -> dict[str, str]:
        facts = {"model": self.kind}
        if not self.is_fitted:
            return facts | {"fitted": "no"}
        return facts | {
            "directions": f"{self.grid.shape[0]} x {self.grid.shape[1]}",
            "fitted over": extent(self.bounds),
        }

    def __repr__(self) -> str:
        fitted = f"fitted, {self.grid.shape[0]} x {self.grid.shape[1]} directions" if self.is_fitted else "not fitted"
        return f"{type(self).__name__}({fitted})"


def bounding_box(position: Tensor) -> Tensor:
    """Return the lower and upper corner (2, 3) of the box around positions (n, 3) [m]."""
    position = check_positions(position)
    return torch.stack([position.amin(dim=0), position.amax(dim=0)])


def check_predicted(model: object, value: Tensor, shape: tuple[int, ...]) -> Tensor:
    """Return what a model predicts unchanged; refuse all but finite numbers in a floating-point tensor of this shape."""
    name = type(model).__name__
    if not isinstance(value, Tensor) or not value.is_floating_point() or value.shape != shape:
        got = f"{value.dtype} {tuple(value.shape)}" if isinstance(value, Tensor) else type(value).__name__
        raise InputError(f"{name} must predict a floating-point tensor of shape {shape}, got {got}")
    if not bool(value.detach().sum().isfinite()):
        raise InputError(f"{name} predicts values that are not finite; if its parameters overflow, fit it again")
    return value


def synthesized(model: FieldModel, position: Tensor) -> Tensor:
    """Return the spectra of a model of any class at positions (n, 3), checked, float32 (n, H, W) on the CPU."""
    shape, spectra = (len(position), *model.grid.shape), model.synthesize(position)
    return Store(to_magnitudes(f"spectra of {type(model).__name__}", spectra, shape))[:]


@checked
def make_model(name: str, preset: Preset = "quick", **options: Any) -> FieldModel:
    """Return a field model by its name.

    Args:
        name: Name in the registry, e.g. "hybrid".
        preset: "quick", or "paper" for published settings. With "paper" the name "swiftwrf" gives `SwiftWRFPaper`.
        options: Options of the model.

    Raises:
        InputError: An unknown name, an option or preset that the model does not have, or a value outside its range.

    Example:
        >>> make_model("idw", seed=3).config.seed
        3
    """
    return model_type(name, preset)(preset=preset, **options)


def model_type(name: str, preset: Preset = "quick") -> type[FieldModel]:
    """Return the field model of a name; with "paper", the one that has the published settings."""
    model: type[FieldModel] = FIELD_MODELS[PUBLISHED.get(name, name) if preset == "paper" else name]
    return model
