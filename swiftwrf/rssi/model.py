"""SwiftWRF for RSSI: for each receiver a path-loss model, and a head whose latent field depends on the position.

    rssi_r(s) = T_r - 10 gamma_r log10 |s - receiver_r| + directivity_r(s) + m_r(c_r(s)) - m_r(0)       [dBm]

m_r is the mean magnitude of receiver r's primitives (`swiftwrf.rssi.head`), c_r a Gaussian process of the position, and
directivity_r a few harmonics of the direction from the receiver.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from functools import partial
from typing import Annotated, Any, ClassVar, NamedTuple, Self

import torch
from torch import Tensor

from swiftwrf.data.rssi import Rssi
from swiftwrf.data.splits import each_fold, places
from swiftwrf.gp import Kernel, subsample
from swiftwrf.metrics import HALF_WIDTH, interval_factor
from swiftwrf.models.base import CPU
from swiftwrf.models.prediction import Prediction
from swiftwrf.plotting import Axes
from swiftwrf.rssi.base import Map, RssiPredictor, columns_of
from swiftwrf.rssi.config import RssiConfig
from swiftwrf.rssi.detection import Detection, DetectionField
from swiftwrf.rssi.maps import RssiMap
from swiftwrf.rssi.path_loss import PathLoss, log_distance
from swiftwrf.rssi.posterior import RssiPosterior, held_out_std, predictive_std
from swiftwrf.rssi.regression import fit_receiver
from swiftwrf.rssi.scans import choose_correlation
from swiftwrf.rssi.training import RssiTraining, prepare, rounding_std
from swiftwrf.runtime.checkpoint import Saved
from swiftwrf.runtime.progress import progress_bar
from swiftwrf.runtime.threads import parallel_map, single_thread

MAX_COMPARED = 12  # receivers with limits that both meanings are fitted to; more do not change the choice
RECEIVERS_AT_ONCE = 64  # between two steps of the progress bar; starting threads costs milliseconds


class RssiModel(RssiPredictor, Saved):
    """50 primitives a receiver on a log-distance path-loss model.

    It predicts RSSI at fixed receivers for any position of the transmitter, differentiable in the position.
    Five held-out folds of the training rows determine the kernel, the presence of a field and the scale of the standard
    deviation. The path loss of a receiver is shrunk to that of all receivers in proportion to how well its own rows
    determine it. If the positions of the receivers are unknown, it is a level. An empty cell is an upper limit of the
    received power where the empty cells of a receiver are those of weak signals, see `RssiConfig.not_detected`. `predict`
    gives the power of all packets, `predict_detected` that of detected ones.

    The options are those of `RssiConfig`.

    Example:
        >>> import swiftwrf
        >>> train, test = swiftwrf.rssi_room(n=60).split()
        >>> prediction = RssiModel(validation="block").fit(train).predict(test.transmitter_position)
        >>> low, high = prediction.interval(0.8)
        >>> bool((low < prediction.mean).all())
        True
    """

    kind: ClassVar[str] = "rssi model"
    name = "swiftwrf"
    config_type = RssiConfig
    updates = True

    saved = "centre posterior covariance detection_field field_db noise_db"
    centre: Annotated[Tensor, "float64 3"]
    """centre of the measured positions, float64 (3,) [m]"""
    posterior: Annotated[RssiPosterior, "r"]
    """Gaussian processes of the receivers at positions less the centre, which `update` continues"""
    covariance: Annotated[Tensor, "float64 r 2 2"]
    """calibrated covariance of level and slope, float64 (R, 2, 2)"""
    detection_field: Annotated[DetectionField, "r"] | None
    """probability of a detection; None if every cell has a value, or if empty cells are ignored"""
    field_db: Annotated[Tensor, "float32 r"]
    """calibrated standard deviation of the field far from all measurements, (R,) [dB]; 0 without a field"""
    noise_db: Annotated[Tensor, "float32 r"]
    """calibrated standard deviation of a measurement about the field, (R,) [dB]"""
    held_out_db: dict[str, float]
    """mean absolute errors [dB] of the model and of the receivers' means at held-out rows, set by `fit`, not saved"""

    @single_thread()
    def _fit(
        self,
        train: Rssi,
        *,
        pool: Rssi,
        shift: Tensor,
        curve: Detection | None,
        device: torch.device = CPU,
        parallel: Map | None = None,
        progress: bool = False,
        **_: Any,
    ) -> None:
        config = self.config if curve is not None else replace(self.config, not_detected="unknown")
        of_lists = pool.margin_db is not None and config.not_detected == "auto"  # limits of rows, not of a receiver
        candidates = prepare(pool, columns_of(train.receiver_names, pool), config, shift, curve)
        parallel, candidates = parallel or _in_threads, candidates[: 1 if of_lists else None]
        every = some = torch.arange(len(train.receiver_names))
        if len(candidates) > 1 and len(every) > MAX_COMPARED:
            (some,) = subsample(candidates[0].limit.isfinite().any(dim=0).nonzero()[:, 0], rows=MAX_COMPARED)
        rest = config, device, parallel, progress
        fit, *others = (fit_receivers(training, some, {}, *rest) for training in candidates)
        for without_limits in others:  # as probable as values of a mean error that is 1 % lower
            is_better = without_limits.score > fit.score + 0.01 * float(fit.training.count.sum())
            fit = without_limits if is_better else fit
        if len(some) < len(every):
            chosen = candidates[fit.training.limit.isnan().all()]
            fit = fit_receivers(chosen, every, fit.results, *rest)
        self.detection_field, training, rows = None, fit.training, fit.training.bin_of_row
        if not of_lists:
            self.detection, self.detection_field = training.path_loss.detection, fit.detection_field
        predicted, std, means = fit.predicted[:, rows], fit.std[-1, rows], training.path_loss.shared(fit.distance)
        for out, kept in each_fold(training.fold):
            mean = training.rssi[kept].nanmean(dim=0)
            means[out] = mean.where(~mean.isnan(), means[out])
        errors = {self.name: predicted[0], "mean": means[rows]}
        self.held_out_db = {name: float((each - train.rssi_dbm).abs().nanmean()) for name, each in errors.items()}
        scale = self._calibrate(train, predicted[-1], std, training.field_db, fit.noise_db)
        detection = fit.detection[rows]
        self.scan_correlation = choose_correlation(predicted[-1], scale * std, detection, train.rssi_dbm)
        self.covariance, self.centre = scale.square()[:, None, None] * fit.covariance, training.centre
        self.posterior = RssiPosterior(
            kernel=training.kernel,
            heads=training.heads,
            huber=self.config.huber,
            receiver=training.receiver,
            position=training.position,
            measured=(~training.rssi.isnan()).T.double(),
            field_db=training.field_db,
            noise_db=training.noise_db,
            **fit.posterior,
        )

    def _calibrate(
        self, train: Rssi, predicted: Tensor, std: Tensor, field_db: Tensor, noise_db: Tensor, min_places: int = 30
    ) -> Tensor:
        """Calibrate the standard deviations by held-out predictions of the training rows, and return their factors (R,).

        `predicted` [dBm] and `std` [dB] are (n, R), the prior deviations of latent field and noise are (R,) [dB].
        A receiver with fewer than `min_places` places has the factor of all receivers. Not studied.
        """
        score, place = (train.rssi_dbm - predicted).abs() / (HALF_WIDTH * std), places(train.transmitter_position)
        count = torch.zeros(int(place.max()) + 1, score.shape[1]).index_add(0, place, score.isfinite().float())
        scale = torch.full_like(field_db, interval_factor(score, place))
        for r in ((count > 0).sum(dim=0) >= min_places).nonzero()[:, 0].tolist():
            scale[r] = interval_factor(score[:, r], place)
        self.field_db = (scale * field_db).float()
        self.noise_db = (scale * noise_db).clamp_min(rounding_std(train.rssi_dbm)).float()
        return scale

    @property
    def kernel(self) -> Kernel:
        """Kernel of the latent field, lengths in [m]."""
        return self.posterior.kernel

    @property
    def path_loss(self) -> PathLoss:
        """Path-loss model of each receiver, (R,)."""
        return self.posterior.path_loss

    @property
    def n_primitives(self) -> int:
        """Number of primitives a receiver; 0 if there is no field."""
        return self.config.n_primitives if bool(self.field_db.any()) else 0

    def region(self) -> Tensor:
        """Return the positions (n, 3) [m] of the location bins."""
        return self.posterior.position + self.centre

    @single_thread()
    def _update(self, new: Rssi) -> None:
        at = new.transmitter_position - self.centre
        if self.detection_field is not None:
            self.detection_field = self.detection_field.updated(at, new.detected)
        self.posterior = self.posterior.updated(at, new.rssi_dbm)

    def with_chosen_kernel(self, without: Tensor | None = None) -> Self:
        """Return the model fitted again to all rows that it has learnt, with kernel and noise chosen again.

        The rows follow from their residuals, the attenuation of floors is estimated again, and offsets stay as fitted. Rows
        that were averaged in location bins are bins here, so that the scatter of single measurements is unknown: standard
        deviations stay, too.

        Args:
            without: Numbers of rows that are forgotten first, in the order in which the model received them, int64. Defaults
                to none.

        Raises:
            InputError: A model that cannot be updated, or fewer than 10 measurements.

        Example:
            >>> import swiftwrf
            >>> model = RssiModel().fit(swiftwrf.rssi_room(n=60))
            >>> len(model.with_chosen_kernel(without=torch.arange(10)).region())
            50
        """
        self.check_fitted()
        self.check_updates()
        posterior = self.posterior
        kept = torch.ones(len(posterior.position), dtype=torch.bool)
        if without is not None:
            kept[without] = False
        at, rssi, attenuation = self.region()[kept], posterior.rssi[kept], self.attenuation
        rows = Rssi(
            self.value_centre + self.value_scale * (rssi if attenuation is None else rssi + attenuation.of(at)),
            at,
            quantity=self.quantity,
            unit=self.unit,
            receiver_position=self.receiver_position,
            receiver_names=self.receiver_names,
            origin=self.origin,
            floors=None if attenuation is None else attenuation.floors,
        )
        # the rows have lost their sessions
        validation = "block" if self.config.validation == "session" else self.config.validation
        model = type(self)(replace(self.config, validation=validation)).fit(rows)
        model.offsets, model.row_digests = self.offsets, self.row_digests
        if without is not None:
            model.row_digests = self._digests_without(without, len(posterior.position))
        # a mean of several measurements has a smaller variance than one measurement
        if bool(((posterior.variance > 0) & (posterior.variance < 0.99 * posterior.noise_db.square()[:, None])).any()):
            model.field_db, model.noise_db = self.field_db, self.noise_db
        return model

    @single_thread()
    def _predict(self, position: Tensor, max_alone: float = 1.5) -> tuple[Tensor, Tensor]:
        """Return mean and standard deviation of RSSI at positions.

        Where empty cells are no sign of a weak signal and rows have `max_alone` values or fewer on average, e.g. that of the
        associated receiver, the field of a receiver is known where it was measured itself. Not studied.
        """
        offset, posterior = position - self.centre, self.posterior
        mean = posterior.at(offset, self.kernel(offset.float(), posterior.position.float()))[0]
        is_alone = self.detection is None and float(posterior.measured.sum(dim=0).mean()) <= max_alone
        processes = posterior.own_trends if is_alone else [posterior.trend]
        of_receivers = posterior.receiver, self.field_db, self.noise_db, self.covariance
        parts = zip(processes, *(values.tensor_split(len(processes)) for values in of_receivers), strict=True)
        std = torch.cat(
            [
                predictive_std(process, receiver, offset, (field_db, noise_db), covariance)
                for process, receiver, field_db, noise_db, covariance in parts
            ],
            dim=1,
        )
        return mean.float(), std.float()

    def _detected(self, prediction: Prediction, offset_db: Tensor | float) -> Prediction:
        """Return the prediction of detected packets: near the limit of detection it is above that of all packets."""
        if self.detection is None or self.detection_field is None:
            return prediction
        assert prediction.std is not None
        level, std = prediction.mean.double() + offset_db, prediction.std.double()
        mean, std = self.detection.given_detection(level, std)
        return replace(prediction, mean=(mean - offset_db).float(), std=std.float())

    def _detection(self, prediction: Prediction, offset_db: Tensor | float) -> Tensor:
        if self.detection_field is None:
            return super()._detection(prediction, offset_db)
        assert prediction.position is not None
        level = prediction.mean.double() + offset_db
        return self.detection_field.probability(level, prediction.position - self.centre)

    def plot(self, receiver: str | None = None, height_m: float | None = None, ax: Axes | None = None) -> Axes:
        """Draw the map of the predicted RSSI over the measured region, seen from above.

        Args:
            receiver: Name of a receiver, or its number from 1. Defaults to the strongest RSSI at each position.
            height_m: Height of the transmitter. Defaults to the median of the measurements.
            ax: Axes to draw into. Defaults to those of a new figure.

        Raises:
            InputError: An unknown receiver, or a model that is not fitted.

        Example:
            >>> import swiftwrf
            >>> fit_rssi(swiftwrf.rssi_room(n=60)).plot("receiver03").get_title()
            'predicted RSSI of receiver03'
        """
        self.check_fitted()
        return RssiMap.predict(self, height=height_m).plot(receiver, ax)


def fit_rssi(train: Rssi, config: RssiConfig | None = None, **options: Any) -> RssiModel:
    """Fit an `RssiModel`; options and errors as of `RssiModel.fit`.

    Example:
        >>> import swiftwrf
        >>> fit_rssi(swiftwrf.rssi_room(n=60))
        RssiModel(fitted, 12 receivers)
    """
    return RssiModel(config).fit(train, **options)


class Fit(NamedTuple):
    """Fits of R receivers with one meaning of their empty cells, and their predictions of n bins by other folds.

    Args:
        training: Training rows by location bin.
        results: Results of `fit_receiver` by the number of the receiver.
        posterior: Arguments of `RssiPosterior` that depend on the receiver.
        covariance: Covariance of level and slope, (R, 2, 2).
        distance: log10 of the distances to the receivers, (n, R).
        predicted: RSSI of detected packets by each of the `folds`, (f, n, R) [dBm].
        std: Standard deviation of a detected measurement about it before calibration, (f, n, R) [dB].
        noise_db: Standard deviation of a measurement about the field, of which the last `std` is, (R,) [dB].
        detection_field: Probability of a detection; None if every cell has a value, or if empty cells are ignored.
        detection: Probability of a detection at the held-out RSSI, (n, R).
        score: Held-out log-likelihood of values and detections, less a constant.
    """

    training: RssiTraining
    results: Mapping[int, dict[str, Tensor]]
    posterior: dict[str, Tensor]
    covariance: Tensor
    distance: Tensor
    predicted: Tensor
    std: Tensor
    noise_db: Tensor
    detection_field: DetectionField | None
    detection: Tensor
    score: float


def fit_receivers(
    training: RssiTraining,
    number: Tensor,
    known: Mapping[int, dict[str, Tensor]],
    config: RssiConfig,
    device: torch.device,
    parallel: Map,
    progress: bool = False,
    *,
    session_noise: float = 0.3,
) -> Fit:
    """Fit receivers and predict each bin by the other folds.

    The likelihood of the values is that of errors with a Laplace distribution, whose scale is the mean absolute error.

    Args:
        training: Training rows by location bin.
        number: Numbers of the receivers, (R,).
        known: Results of `fit_receiver` that are known, by the number of the receiver.
        config: Options.
        device: Device to compute on.
        parallel: Function that maps a fit over receivers.
        progress: Show a progress bar on a terminal.
        session_noise: Least variance of a measurement of another session, relative to that of the field, for `calibration`:
            that of single packets. Not studied.
    """
    task = partial(fit_receiver, data=training, config=config, device=device)
    unknown, training = [each for each in number.tolist() if each not in known], training.columns(number)
    with progress_bar(progress) as bar:
        fits = bar.track(parallel(task, unknown), total=len(unknown), description="receivers")
        results = {**known, **dict(zip(unknown, fits, strict=True))}
    names = results[int(number[0])]
    fitted = {name: torch.stack([results[each][name] for each in number.tolist()]) for name in names}
    held_out, covariance = fitted.pop("held_out").permute(1, 2, 0), fitted.pop("covariance")
    loss, measured = training.path_loss, ~training.rssi.isnan()
    distance = log_distance(training.position, training.receiver)
    level = held_out.where(~held_out.isnan(), loss.each(distance)) + training.shift
    noise_db = [training.noise_db for _ in training.folds]
    if config.calibration is not None:  # rows of another day differ at one place, too
        noise_db[-1] = training.noise_db.maximum(math.sqrt(session_noise) * training.field_db)
    stds = [
        held_out_std(training, fold, training.kernel, (training.field_db, noise), covariance)
        for fold, noise in zip(training.folds, noise_db, strict=True)
    ]
    std = torch.stack(stds)
    detection_field, power, score, detection = None, level, 0.0, torch.ones_like(level[0])
    if loss.detection is not None:
        power, std = loss.detection.given_detection(level, std)
        if not bool(measured.all()):
            bins = training.position, measured, training.fold, level[0]
            detection_field, likelihood = DetectionField.fit(training.kernel, *bins, loss.detection.limit)
            score = float(likelihood.sum())
            detection = detection_field.probability(level[-1], training.position)
    predicted = power - training.shift
    error = (predicted[0] - training.rssi)[measured].abs()
    score -= len(error) * math.log(max(float(error.mean()), 1e-3))
    rest = covariance, distance, predicted, std, noise_db[-1], detection_field, detection, score
    return Fit(training, results, fitted, *rest)


def _in_threads(function: Callable[[Any], Any], items: Iterable[Any]) -> Iterable[Any]:
    """Apply a function to items as `map` does, in as many threads as torch has."""
    waiting = list(items)
    for start in range(0, len(waiting), RECEIVERS_AT_ONCE):
        yield from parallel_map(function, waiting[start : start + RECEIVERS_AT_ONCE])
