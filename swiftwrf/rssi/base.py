"""The interface of every RSSI predictor: fit to measured RSSI, then predict it at any position."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from copy import copy
from dataclasses import replace
from typing import Annotated, Any, ClassVar, Self

import torch
from torch import Tensor

from swiftwrf.data.coordinates import GeodeticOrigin
from swiftwrf.data.dataset import Numbers
from swiftwrf.data.rssi import Offsets, Rssi
from swiftwrf.data.splits import MIN_PLACES, MIN_TRAINING
from swiftwrf.errors import InputError, listed
from swiftwrf.models.base import FieldConfig, Updatable
from swiftwrf.models.prediction import Prediction
from swiftwrf.plotting import Displayed
from swiftwrf.positions import check_near, check_positions
from swiftwrf.rssi.detection import Detection
from swiftwrf.rssi.offsets import FloorAttenuation, estimate_floor_attenuation
from swiftwrf.rssi.scans import CORRELATION
from swiftwrf.runtime.digest import computed_once
from swiftwrf.runtime.threads import to_device
from swiftwrf.runtime.validation import (
    Configured,
    all_or_nothing,
    checked,
)

Map = Callable[[Callable[[Any], Any], Iterable[Any]], Iterable[Any]]
RECEIVER_POSITIONS = "positions of the receivers"


class RssiPredictor(Updatable, Configured, Displayed, ABC):
    """Base class of all predictors of RSSI at fixed receivers from the position of the transmitter.

    If the data have floors, `fit` removes the attenuation of those between transmitter and receiver, and `predict` adds it.

    A subclass sets `name` and `config_type`, and implements `_fit` and `_predict`. The constructor is that of `Configured`.

    Example:
        >>> import swiftwrf
        >>> train, test = swiftwrf.rssi_room(n=60).split()
        >>> swiftwrf.RssiModel(seed=1).fit(train).predict(test.transmitter_position).mean.shape
        torch.Size([12, 12])
    """

    config_type: ClassVar[type[Any]] = FieldConfig
    """dataclass of the options"""
    name: ClassVar[str]
    """name on the command line and in reports"""
    requires_receiver_position: ClassVar[bool] = False
    """whether the positions of the receivers must be known"""
    slow: ClassVar[bool] = False
    """whether a fit takes minutes, so that it is compared only on request"""
    max_map_predictions: ClassVar[int] = 2**22
    """predictions of a map at all receivers if its cells are not given"""
    batch_size: ClassVar[int] = 512
    """positions evaluated at a time, few enough to stay in the processor's cache"""

    fitted_attribute = "receiver_names"
    saved: ClassVar[str] = (
        "receiver_position receiver_names origin offsets attenuation detection row_digests quantity unit value_centre "
        "value_scale scan_correlation"
    )
    """what the file of a predictor contains that is `Saved`, too"""
    receiver_names: Annotated[tuple[str, ...], "r"]
    """names of the receivers, set by `fit`"""
    receiver_position: Annotated[Tensor, "float64 r 3 nan"]
    """positions of the receivers, float64 (R, 3) [m], nan where unknown, set by `fit`"""
    origin: GeodeticOrigin | None
    """latitude and longitude of x = y = 0, if the positions were projected from degrees, set by `fit`"""
    detection: Annotated[Detection, "r"] | None
    """curve of detection of the training rows; None if every cell has a value; set by `fit`"""
    offsets: Offsets | None
    """offsets that were removed from the training rows, set by `fit`; predictions are of their reference"""
    quantity: str = "RSSI"
    """what is predicted, set by `fit`: RSSI, or another quantity of the data"""
    unit: str = "dBm"
    """its unit, set by `fit`"""
    value_centre: float = 0.0
    """mean of the training values of another quantity than RSSI, which is subtracted before the fit"""
    value_scale: float = 1.0
    """their number in a dB of the fit: other quantities are scaled to the standard deviation of RSSI"""
    scan_correlation: float = CORRELATION
    """correlation of the errors of the receivers of a scan"""
    attenuation: Annotated[FloorAttenuation, "r"] | None = None
    """attenuation of the floors between transmitter and receiver, set by `fit` if the data have floors"""

    @classmethod
    def compared(cls, data: Rssi) -> bool:
        """Return whether the predictor is compared on these data without a request."""
        return not cls.slow

    @classmethod
    def lacking(cls, data: Rssi) -> str:
        """Return a sentence about what the data lack for this predictor, or an empty text if they have it."""
        if cls.requires_receiver_position and not data.located:
            return f"{cls.name} needs the {RECEIVER_POSITIONS}, which {data.name} does not describe"
        return ""

    @all_or_nothing
    @checked
    def fit(
        self,
        train: Rssi,
        *,
        pool: Rssi | None = None,
        device: torch.device | str = "cpu",
        parallel: Map | None = None,
        progress: bool = False,
        usual_std_db: float = 8.0,
    ) -> Self:
        """Fit the predictor to measured RSSI and return it. A fit that fails leaves the predictor as it was.

        Args:
            train: Training rows, at least 4 measurements in all. Missing values (nan) are ignored.
            pool: The same rows at every receiver of the data, from which properties common to all receivers are learnt.
                Defaults to `train`. Receivers with fewer than 10 rows take no part in the choice of the kernel.
            device: Device to compute on. The fitted predictor is on the CPU.
            parallel: Function that maps a picklable fit over receivers as `map` does, e.g. on other machines. Defaults to
                threads of this process.
            progress: Show a progress bar on a terminal.
            usual_std_db: Standard deviation that values of another quantity are scaled to, since priors are those of RSSI.
                Not studied.

        Raises:
            InputError: Too few measurements, values that are not finite, a missing requirement, or a pool of other rows.
            FitError: The fit diverged.
        """
        pool = pool or train
        names = {*train.receiver_names, *(pool.receiver_names[c] for c in often_detected(pool).tolist())}
        pool = pool.columns([c for c, name in enumerate(pool.receiver_names) if name in names])
        if (detected := int(train.detected.sum())) < (least := MIN_PLACES - 1):
            raise InputError(
                f"receivers {listed(train.receiver_names)} have {detected} training measurements in all; measure at least "
                f"{least}"
            )
        more = set(train.receiver_names) <= set(pool.receiver_names)
        if not more or not torch.equal(pool.transmitter_position, train.transmitter_position):
            raise InputError("the pool must hold the same rows as the training part, at the same receivers and more")
        if lacking := self.lacking(train):
            raise InputError(lacking)
        self.receiver_names, self.receiver_position = tuple(map(str, train.receiver_names)), train.receiver_position
        self.origin, self.offsets, self.attenuation = train.origin, train.offsets, None
        self.quantity, self.unit, self.value_centre, self.value_scale = train.quantity, train.unit, 0.0, 1.0
        if not train.is_power:
            values = pool.rssi_dbm[pool.detected]
            self.value_centre = float(values.mean())
            self.value_scale = (float(values.std(correction=0)) or 1.0) / usual_std_db
            train, pool = self._scaled(train), self._scaled(pool)
        self.row_digests = train.row_digests() if self.updates else self.row_digests
        shift = torch.zeros_like(pool.rssi_dbm)
        if train.offsets is not None:
            shift = shift + train.offsets.of(pool)[:, None]
        if train.floors is not None:
            of_pool = FloorAttenuation(train.floors, (0,) * len(pool.receiver_names), 0.0)
            of_pool = _floor_attenuation(pool) if pool.is_power else of_pool
            columns = columns_of(self.receiver_names, pool).tolist()
            self.attenuation = replace(of_pool, receiver_floor=tuple(of_pool.receiver_floor[c] for c in columns))
            shift = shift + of_pool.of(pool.transmitter_position)
            train, pool = self.attenuation.removed(train), of_pool.removed(pool)
        empty_cells, curve = getattr(self.config, "not_detected", "auto"), None
        if not pool.is_power:
            empty_cells = "unknown"
        if empty_cells == "weak" or (empty_cells == "auto" and pool.margin_db is None):
            curve = _detection_curve(pool.transmitter_position, pool.rssi_dbm + shift)
        self.detection = curve and curve.columns(columns_of(self.receiver_names, pool))
        if empty_cells == "auto" and pool.margin_db is not None and math.isfinite(pool.margin_db):
            curve, of_lists = Detection.of_lists(pool.rssi_dbm + shift, pool.margin_db)
            shift = shift + of_lists
        others = {"device": to_device(device), "parallel": parallel, "progress": progress}
        self._fit(train, pool=pool, shift=shift, curve=curve, **others)
        if not train.is_power and (held_out := getattr(self, "held_out_db", None)):
            self.held_out_db = {name: self.value_scale * error for name, error in held_out.items()}
        return self

    def _scaled(self, data: Rssi) -> Rssi:
        """Return data with the values of the fit."""
        return data.derived(rssi_dbm=(data.rssi_dbm - self.value_centre) / self.value_scale)

    @checked
    def update(self, new: Rssi) -> Self:
        """Return the predictor with more training rows, by an update of its factorisation. This one stays as it is.

        The result equals a fit to all rows with the same kernel, noise and weights of the earlier rows.

        Args:
            new: Rows at the receivers of the training rows, any number. Those that the predictor has already learnt are
                left out, with a warning.

        Raises:
            InputError: A predictor that must be fitted again, or as `aligned`.

        Example:
            >>> import swiftwrf
            >>> data = swiftwrf.rssi_room(n=60)
            >>> model = swiftwrf.RssiModel().fit(data.subset(torch.arange(50)))
            >>> len(model.update(data.subset(torch.arange(50, 60))).region())
            60
        """
        new = self._not_learnt(self.aligned(new))
        predictor = copy(self)
        if len(new):
            self.check_updates()
            predictor.row_digests = torch.cat([self.row_digests, new.row_digests()])
            new = self._scaled(new)
            predictor._update(new if self.attenuation is None else self.attenuation.removed(new))
        return predictor

    def check_updates(self) -> None:
        """Raise InputError if the predictor must be fitted again to more rows."""
        if not self.updates:
            raise InputError(f"a predictor {self.name} cannot be updated; fit it again to all rows")

    def aligned(self, data: Rssi, *, located: bool = True) -> Rssi:
        """Return rows as the predictor takes them, and refuse rows that were measured otherwise than the training rows.

        Receivers are in the order of the training rows, positions about the same origin, and offsets that the predictor
        knows are removed.

        Args:
            data: Rows at the receivers of the training rows.
            located: Whether the positions of the transmitter count.

        Raises:
            InputError: Other receivers, or one more than 1 cm from its position in the training rows, where both are known;
                positions in degrees for a predictor in metres or the reverse, on other floors, or far away.
        """
        self.check_fitted()
        if (data.quantity, data.unit) != (self.quantity, self.unit):
            raise InputError(
                f"{data.name} has {data.quantity} [{data.unit}], but the predictor was fitted to {self.quantity} "
                f"[{self.unit}]"
            )
        names, fitted = data.receiver_names, self.receiver_names
        if sorted(names) != sorted(fitted):
            raise InputError(
                f"{data.name} has the receivers {listed(names)}, but the predictor was fitted to {listed(fitted)}; "
                "give these"
            )
        data = (data if names == fitted else data.columns(columns_of(fitted, data).tolist())).about(self.origin)
        moved = (data.receiver_position - self.receiver_position).norm(dim=1).nan_to_num(0.0)
        if bool((moved > 0.01).any()):
            name, metres = fitted[int(moved.argmax())], float(moved.max())
            raise InputError(
                f"{data.name} has receiver {name} {metres:.3g} m away from its position in the rows that the predictor was "
                "fitted to; fit a predictor to rows with the receivers at these positions"
            )
        if located and len(data):
            data = self._on_own_floors(data)
        return data if self.offsets is None else self.offsets.removed(data)

    def _on_own_floors(self, data: Rssi) -> Rssi:
        """Return rows with the floors of the training rows. Refuse another unit, other floors and positions far away."""
        if data.origin != self.origin:
            unit, fitted = ("metres" if origin is None else "degrees" for origin in (data.origin, self.origin))
            raise InputError(
                f"{data.name} has positions in {unit}, but the predictor was fitted to {fitted}; give {fitted}"
            )
        floors, at = self.attenuation and self.attenuation.floors, data.transmitter_position
        if data.floors is not None:
            pairs = zip(data.floors.named(at), floors.named(at) if floors else [""] * len(at), strict=True)
            if other := {name for name, fitted in pairs if not {*name.split(", ")} & {*fitted.split(", ")}}:
                raise InputError(
                    f"{data.name} has rows on floor {listed(sorted(other))} at heights of other floors of the rows that the "
                    f"predictor was fitted to ({listed(floors.names) if floors else 'none'}); fit a predictor to all floors"
                )
        if self.updates:
            check_near(data.name, at, self.region())
        return data.derived(floors=floors)

    def _update(self, new: Rssi) -> None:
        """Add checked rows to this copy."""

    def region(self) -> Tensor:
        """Return the training positions (n, 3) [m], whose box a map covers."""
        raise InputError(f"a predictor {self.name} has no map; choose swiftwrf or pairs")

    @abstractmethod
    def _fit(self, train: Rssi, *, pool: Rssi, shift: Tensor, curve: Detection | None, **arguments: Any) -> None:
        """Fit to checked data.

        Args:
            train: Training rows.
            pool: The same rows at all receivers.
            shift: Received power less the RSSI of the pool, by floors and offsets that were removed, (n, P) [dB].
            curve: Curve of detection of the pool; None if every cell has a value.
            arguments: The other arguments of `fit`. A predictor declares those that it uses, and ignores the rest by `**_`.
        """

    @abstractmethod
    def _predict(self, position: Tensor) -> tuple[Tensor, Tensor | None]:
        """Return RSSI (b, R) [dBm] and its standard deviation, or None, for a batch of positions (b, 3), float64 [m]."""

    def predict(self, position: Numbers) -> Prediction:
        """Predict the RSSI at every receiver.

        Gradients flow to the positions where the mathematics is differentiable, unless torch.no_grad is active.

        Args:
            position: Positions of the transmitter, tensor or array (n, 3) [m].

        Returns:
            Mean (n, R) [dBm], and the standard deviation of a measurement (n, R) [dB] if the predictor has one.

        Raises:
            InputError: Positions of another shape or not finite, or a predictor that is not fitted.
        """
        self.check_fitted()
        position = check_positions(position)
        with torch.set_grad_enabled(torch.is_grad_enabled() and position.requires_grad):
            mean, std = in_batches(self._predict, position, self.batch_size)
        if self.attenuation is not None:
            mean = mean + self.attenuation.of(position).to(mean)
        if self.value_scale != 1:
            mean, std = self.value_centre + self.value_scale * mean, std if std is None else self.value_scale * std
        return Prediction(
            mean, std, position, receiver_names=self.receiver_names, quantity=self.quantity, unit=self.unit
        )

    @checked
    def predict_detected(self, data: Rssi | Numbers) -> Prediction:
        """Predict the RSSI at least where it is measured, with shapes of `predict` at the positions of the data.

        Args:
            data: Measurements, or positions of the transmitter, tensor or array (n, 3) [m].

        Raises:
            InputError: As `aligned`.
        """
        at = self.aligned(data).transmitter_position if isinstance(data, Rssi) else data
        return self._detected(self.predict(at), self._offset(data))

    @checked
    def predict_detection(self, position: Rssi | Numbers, offset_db: Tensor | float = 0.0) -> Tensor:
        """Return the probability that each receiver detects a packet, float64 (n, R).

        A predictor without a probability has 1 where its mean is above the limit of detection, else 0. All is 1 if every
        cell of the training rows has a value.

        Args:
            position: Positions of the transmitter, tensor or array (n, 3) [m], or measurements, whose offsets count.
            offset_db: Offset of the transmitter relative to the reference of `offsets`, one number or (n, 1) [dB].

        Raises:
            InputError: As `predict`, or as `aligned` for measurements.

        Example:
            >>> import swiftwrf
            >>> swiftwrf.RssiModel().fit(swiftwrf.rssi_room(n=60)).predict_detection([[1.0, 2.0, 1.2]]).shape
            torch.Size([1, 12])
        """
        if isinstance(position, Rssi):
            data = self.aligned(position)
            position, offset_db = data.transmitter_position, self._offset(data)
        with torch.no_grad():
            return self._detection(self.predict(position), offset_db)

    def predict_packets(self, position: Numbers) -> tuple[Prediction, Prediction, Tensor]:
        """Return what `predict`, `predict_detected` and `predict_detection` return at positions, from one prediction.

        Example:
            >>> import swiftwrf
            >>> every, detected, _ = swiftwrf.RssiModel().fit(swiftwrf.rssi_room(n=60)).predict_packets([[1.0, 2.0, 1.2]])
            >>> bool((detected.mean >= every.mean).all())
            True
        """
        with torch.no_grad():
            prediction = self.predict(position)
            return prediction, self._detected(prediction, 0.0), self._detection(prediction, 0.0)

    def _offset(self, data: Rssi | Numbers) -> Tensor | float:
        """Return the offset of each row of measurements relative to the reference, (n, 1) [dB]; 0 where there are none."""
        return 0.0 if self.offsets is None or not isinstance(data, Rssi) else self.offsets.of(data)[:, None]

    def _detected(self, prediction: Prediction, offset_db: Tensor | float) -> Prediction:
        """Return the prediction of detected packets from that of all packets."""
        return prediction

    def _detection(self, prediction: Prediction, offset_db: Tensor | float) -> Tensor:
        """Return the probability of a detection from the prediction of all packets."""
        mean = prediction.mean.double() + offset_db
        return torch.ones_like(mean) if self.detection is None else (mean > self.detection.limit).double()

    def _facts(self) -> dict[str, str]:
        return {"model": self.name, "receivers": listed(getattr(self, "receiver_names", ())) or "not fitted"}

    def __repr__(self) -> str:
        if not self.is_fitted:
            return f"{type(self).__name__}(not fitted)"
        n = len(self.receiver_names)
        return f"{type(self).__name__}(fitted, {n} {'receiver' if n == 1 else 'receivers'})"


_detection_curve = computed_once(Detection.estimate)
_floor_attenuation = computed_once(estimate_floor_attenuation)


def in_batches(
    predict: Callable[[Tensor], tuple[Tensor, Tensor | None]], rows: Tensor, size: int
) -> tuple[Tensor, Tensor | None]:
    """Return mean and standard deviation, or None, of all rows, predicted in parts of `size` rows."""
    means, stds = zip(*map(predict, rows.split(size)), strict=True)
    return torch.cat(means), None if stds[0] is None else torch.cat(stds)


def often_detected(pool: Rssi) -> Tensor:
    """Return the columns of receivers detected in 10 rows or more, int64; of all detected ones if there is none."""
    count = pool.detected.sum(dim=0)
    often = count >= MIN_TRAINING
    return (often if bool(often.any()) else count > 0).nonzero()[:, 0]


def columns_of(receiver_names: Sequence[str], pool: Rssi) -> Tensor:
    """Return the columns of a pool that hold these receivers, int64 (R,)."""
    names = list(pool.receiver_names)
    return torch.tensor([names.index(name) for name in receiver_names])
