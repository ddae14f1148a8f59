"""A model that follows its scene: each measurement is scored, tested for a change, and learnt."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import torch
from annotated_types import Gt, Lt
from scipy import stats
from scipy.cluster.vq import kmeans2
from torch import Tensor

from swiftwrf.contrib.online.scores import ALLOWANCE, Alarm, Scores, alarm_threshold, learnt, score
from swiftwrf.data.rssi import Rssi
from swiftwrf.data.spectra import Spectra
from swiftwrf.data.splits import MIN_TRAINING, each_fold
from swiftwrf.errors import InputError
from swiftwrf.metrics import psnr
from swiftwrf.models.base import FieldModel
from swiftwrf.models.geometry.images import PhaseObservations
from swiftwrf.models.geometry.model import GeometryModel
from swiftwrf.models.geometry.phase_retrieval import correlations, retrieve_phases
from swiftwrf.models.interpolator import Interpolator
from swiftwrf.models.link import Link
from swiftwrf.positions import nearest
from swiftwrf.rssi.model import RssiModel
from swiftwrf.runtime.validation import checked

N_FOLDS = 5  # of the spectra after a change, and of the training spectra that give the reference
N_REGIONS = 8  # of the positions that are tested separately, beside all positions together
N_REFERENCE = 30  # measurements without alarm that calibrate the innovations if no reference is given
MIN_MISSING = 3e-3  # missing coherence that counts as none, phases of 3 degrees
FalseAlarmRate = Annotated[float, Gt(0), Lt(1)]  # false alarms a measurement, over all regions and receivers together


def adapted(before: Interpolator, after: Spectra) -> tuple[Interpolator, float]:
    """Return a model that has learnt spectra after a change, and the chosen correlation of the fields before and after it.

    The correlation is that with the highest mean PSNR of held-out spectra after the change. With 1, all spectra count alike.

    Args:
        before: Model of the spectra before the change.
        after: Spectra after the change.

    Raises:
        InputError: As `FieldModel.update`.

    Example:
        >>> import swiftwrf
        >>> data = swiftwrf.simulated_room(n=60)
        >>> model = swiftwrf.make_model("coarray").fit(data.subset(torch.arange(50)))
        >>> adapted(model, data.subset(torch.arange(50, 60)))[1] > 0.5
        True
    """
    parts = torch.arange(len(after)) % min(N_FOLDS, len(after))

    def held_out(model: Interpolator) -> float:
        scores = []
        for out, kept in each_fold(parts) if len(after) > 1 else ():
            held = after.subset(out)
            predicted = model.update(after.subset(kept)).synthesize(held.position)
            scores.append(psnr(predicted.cpu(), held.spectrum))
        return float(torch.cat(scores).mean()) if scores else 0.0

    best = max((1.0, 0.8, 0.6, 0.4, 0.2, 0.05), key=lambda correlation: held_out(before.aged(correlation)))
    return before.aged(best).update(after), best


class Monitor:
    """One-sided cumulative sums of innovations: of all positions and of each region; for RSSI of each receiver, up and down.

    A sum over its threshold is an alarm (E. S. Page, Biometrika 41, 1954).

    Innovations of spectra are replaced by normal scores, their rank among those of a reference. Innovations of RSSI are
    standard normal if the standard deviations of the model are right.

    Args:
        position: Positions around which the model was fitted, (n, 3) [m], which give the regions.
        receiver_names: Names of the receivers; none for spectra.
        reference: Innovations (n,) of spectra of the unchanged scene. Defaults to the first measurements.
        false_alarm_rate: False alarms a measurement, over all regions and receivers together.
        n_regions: Maximum number of regions, which are no more than a tenth of the positions, or than the different ones.

    Raises:
        InputError: A rate outside (0, 1).

    Example:
        >>> import swiftwrf
        >>> data = swiftwrf.simulated_room(n=60)
        >>> train, new = data.subset(torch.arange(50)), data.subset(torch.arange(50, 60))
        >>> model = swiftwrf.make_model("coarray").fit(train)
        >>> monitor = Monitor.of(model, train)
        >>> scores = score(model, new)
        >>> [alarm for at, z in zip(scores.position, scores.innovation) for alarm in monitor.observe(at, z)]
        []
    """

    @checked
    def __init__(
        self,
        position: Tensor,
        receiver_names: Sequence[str] = (),
        reference: Tensor | None = None,
        false_alarm_rate: FalseAlarmRate = 1e-4,
        n_regions: int = N_REGIONS,
    ) -> None:
        self.false_alarm_rate, self.receiver_names = false_alarm_rate, tuple(receiver_names)
        n_regions = min(n_regions, max(1, len(position) // 10), len(position.unique(dim=0)))
        self.centre = torch.from_numpy(kmeans2(position.double().numpy(), n_regions, seed=0, minit="++")[0])
        self.reference = torch.zeros(0, dtype=torch.float64) if reference is None else reference.double()
        n_series = (1 + n_regions) * (2 * len(self.receiver_names) or 1)
        self.value, self.count = torch.zeros(n_series, dtype=torch.float64), 0
        self.since = torch.zeros(n_series, dtype=torch.int64)
        self.threshold = alarm_threshold(false_alarm_rate, n_series)

    @classmethod
    def of(
        cls, model: FieldModel | RssiModel, train: Spectra | Rssi | None = None, false_alarm_rate: FalseAlarmRate = 1e-4
    ) -> Monitor:
        """Return the monitor of a fitted model.

        The training spectra, in their order, give the reference if the model can forget them. Errors of spectra that it has
        learnt are lower than those of new ones, which would raise false alarms.

        Raises:
            InputError: As `FieldModel.aligned`, or training spectra at other positions than those of the model.
        """
        if isinstance(model, RssiModel):
            return cls(model.region(), model.receiver_names, None, false_alarm_rate)
        reference = None
        if isinstance(train, Spectra):
            train = model.aligned(train)
            if isinstance(model, Interpolator):  # each fifth is predicted without itself
                known = model.region()
                if known.shape != train.position.shape or not torch.allclose(known, train.position, rtol=0, atol=1e-3):
                    raise InputError(
                        f"{train.name} does not have the positions of the {len(known)} spectra that the model has "
                        "learnt; give these spectra in their order"
                    )
                order = torch.randperm(len(train), generator=torch.Generator().manual_seed(0))
                parts = [score(model.forget(rows), train.subset(rows)) for rows in order.chunk(N_FOLDS)]
                reference = torch.cat([part.innovation[:, 0] for part in parts])[order.argsort()]
        return cls(model.region(), (), reference, false_alarm_rate)

    def observe(self, position: Tensor, innovation: Tensor) -> list[Alarm]:
        """Add the innovations of one measurement at a position (3,) [m], (1,) or (R,); return the alarms."""
        value = innovation.double()
        if self.receiver_names:
            standard = value.clamp(-3.0, 3.0)  # single outliers raise no alarm
            standard = torch.cat([standard, -standard])
        elif self.count == 0 and len(self.reference) < N_REFERENCE:
            self.reference = torch.cat([self.reference, value])
            return []
        else:
            rank = (self.reference < value).double().sum() + 0.5
            standard = torch.special.ndtri(rank / (len(self.reference) + 1))[None]
        series = torch.full((1 + len(self.centre), len(standard)), torch.nan, dtype=torch.float64)
        series[[0, 1 + int(nearest(position[None], self.centre, 1)[1])]] = standard
        return self.add(series.flatten())

    def add(self, series: Tensor) -> list[Alarm]:
        """Add one more value of each series (C,), nan for none, to its sum; return the alarms, largest sum first.

        A sum that raises an alarm starts again at 0.
        """
        added = (self.value + (series.double() - ALLOWANCE).nan_to_num(0.0)).clamp_min(0)
        self.since = self.since.where(self.value > 0, self.count)
        over = (added > self.threshold).nonzero()[:, 0]
        over = over[added[over].argsort(descending=True)]
        alarms = [Alarm(int(c), self.count, int(self.since[c])) for c in over]
        self.value, self.count = added.where(added <= self.threshold, 0.0), self.count + 1
        return alarms

    def state(self) -> dict[str, Any]:
        """Return reference, regions and sums as plain values."""
        sums = {"value": self.value.tolist(), "since": self.since.tolist(), "count": self.count}
        return {"reference": self.reference.tolist(), "centre": self.centre.tolist(), "cusum": sums}

    def resume(self, state: dict[str, Any]) -> None:
        """Continue with the reference, regions and sums of a `state`."""
        sums = state["cusum"]
        self.reference, self.centre, self.value = (
            torch.tensor(values, dtype=torch.float64) for values in (state["reference"], state["centre"], sums["value"])
        )
        self.since, self.count = torch.tensor(sums["since"]), int(sums["count"])
        self.threshold = alarm_threshold(self.false_alarm_rate, len(self.value))

    def describe(self, alarm: Alarm) -> str:
        """Return what changed and where, in words."""
        region, column = divmod(alarm.series, 2 * len(self.receiver_names) or 1)
        where = "everywhere"
        if region:
            where = "around " + ", ".join(f"{x:.1f}" for x in self.centre[region - 1].tolist()) + " m"
        if not self.receiver_names:
            return f"spectra {where}"
        change = "stronger" if column < len(self.receiver_names) else "weaker"
        return f"{self.receiver_names[column % len(self.receiver_names)]} {change} {where}"


@dataclass(frozen=True, eq=False)
class Step:
    """One followed measurement.

    Args:
        scores: Its scores before it was learnt, of length 1.
        alarms: Changes that it revealed, in words.
        correlation: Correlation of the fields before and after a change to which the model was adapted; None without one.
        notice: Another kernel, or that a room no longer explains the spectra, in words; empty without either.

    Example:
        >>> import swiftwrf
        >>> data = swiftwrf.simulated_room(n=50, grid=swiftwrf.AngularGrid.hemisphere(6, 12))
        >>> train, new = data.subset(torch.arange(49)), data.subset(torch.tensor([49]))
        >>> step = Follower(swiftwrf.make_model("gp").fit(train), train).step(new)
        >>> len(step.scores), step.correlation is None
        (1, True)
    """

    scores: Scores
    alarms: tuple[str, ...]
    correlation: float | None = None
    notice: str = ""


class Follower:
    """A fitted model that learns measurements one by one.

    An alarm of the innovations adapts models of spectra to the change, if these can forget spectra, and restarts the test.
    Kernel and noise are chosen again whenever the model has learnt 30 measurements and a tenth of its data more, by all data
    before these measurements. Others replace them if they predict these, each before it is learnt, with an error that is
    lower by a paired t-test of the log errors. The level of the test is the false-alarm rate times their number.

    With a room and training spectra, a notice reports once if the room no longer explains the spectra. The planes of a
    geometry are refined whenever 10 positions are new; until then, its spectra wait.

    Args:
        model: Fitted model with `update`.
        train: Training data of the model in their order. They calibrate the test of a room, and that of errors if the model
            can forget spectra.
        false_alarm_rate: False alarms a measurement, over all regions and receivers together.

    Raises:
        InputError: A model that is not fitted or without `update`, training spectra of another link than that of the model,
            or a rate outside (0, 1).

    Example:
        >>> import swiftwrf
        >>> data = swiftwrf.rssi_room(n=80)
        >>> follower = Follower(swiftwrf.RssiModel().fit(data.subset(torch.arange(79))))
        >>> follower.step(data.subset(torch.tensor([79]))).alarms
        ()
        >>> follower.count
        1
    """

    @checked
    def __init__(
        self,
        model: FieldModel | RssiModel,
        train: Spectra | Rssi | None = None,
        false_alarm_rate: FalseAlarmRate = 1e-4,
    ) -> None:
        model.check_fitted()
        self.model, self.count = model, 0
        self.monitor = Monitor.of(model, train, false_alarm_rate)
        self._unjudged: list[tuple[Spectra | Rssi, Scores]] = []  # measurements since the last choice of the kernel
        self.room: Monitor | None = None
        """test of the coherence of room and spectra; None without room or training spectra, and after its alarm"""
        self._found = model.room if isinstance(model, FieldModel) else None  # as it was before the test
        if self._found is not None and isinstance(train, Spectra):
            # furniture blocks paths in some regions, whose coherence is lower without any change
            self.room = Monitor(train.position, (), unexplained(self._found, train), false_alarm_rate, n_regions=1)
        self._recent: list[Spectra] = []
        self.waiting: Spectra | None = None
        """spectra that a geometry has not learnt yet, for its next update"""

    @checked
    def step(self, new: Spectra | Rssi) -> Step:
        """Score one measurement, test it for a change, and learn it.

        Raises:
            InputError: Any other number of measurements, one that the model has already learnt, or as `update`.
        """
        if len(new) != 1:
            raise InputError(f"a step follows one measurement, got {len(new)}; give one after the other")
        new = self.model.aligned(new)  # type: ignore[arg-type]  # a measurement of the model's kind
        if bool(self.model.is_learnt(new).any()):
            raise InputError(
                f"{new.name} row {int(new.index[0])}, counted from 0, is already in the model; leave it out"
            )
        scores = score(self.model, new)
        alarms = self.monitor.observe(scores.position[0], scores.innovation[0])
        words, correlation, notices = list(map(self.monitor.describe, alarms)), None, []
        if (
            isinstance(new, Spectra)
            and self.room is not None
            and self._found is not None
            and (changes := self.room.observe(new.position[0], unexplained(self._found, new)))
        ):
            self.room = None
            since = f"the room no longer explains the spectra since measurement {changes[0].since}"
            notices.append(f"{since}; fit it again, also if an obstacle appeared")
        notices += self._learn(new)
        self.count += 1
        if isinstance(new, Spectra) and isinstance(self.model, Interpolator):
            self._recent = [*self._recent, new][-500:]
            if alarms:
                correlation = self._adapt(self.model, alarms[0])
        if correlation is None and isinstance(self.model, Interpolator | RssiModel):
            self._unjudged.append((new, scores))
            notices += self._choose_kernel(self.model)
        return Step(scores, tuple(words), correlation, "; ".join(notices))

    def _learn(self, new: Spectra | Rssi) -> list[str]:
        """Learn a measurement. A geometry learns it with those that wait; return a notice if it gives them up."""
        if not isinstance(self.model, GeometryModel) or not isinstance(new, Spectra):
            self.model = learnt(self.model, new)
            return []
        self.waiting = waiting = new if self.waiting is None else joined([self.waiting, new])
        notices = []
        try:
            self.model = learnt(self.model, waiting)
        except InputError as error:  # fewer than 10 positions, or spectra that do not fit the array
            if len(waiting) < 5 * MIN_TRAINING:
                return []
            notices = [f"{len(waiting)} spectra were not learnt: {error}"]
        self.waiting = None
        return notices

    def _choose_kernel(self, model: Interpolator | RssiModel) -> list[str]:
        """Choose the kernel again if enough measurements are new; return a notice if another one predicts better."""
        count, n = len(self._unjudged), len(model.process.known if isinstance(model, Interpolator) else model.region())
        if count < max(30, 0.1 * (n - count)) or n - count < MIN_TRAINING:
            return []
        last, self._unjudged = self._unjudged, []
        other = model.with_chosen_kernel(without=torch.arange(n - count, n))
        old, new = model.kernel, other.kernel
        if new == old:
            return []
        found = []
        for one, _ in last:
            found.append(score(other, one))
            other = learnt(other, one)
        gain = Scores.joined([scores for _, scores in last]).error.log() - Scores.joined(found).error.log()
        better = stats.ttest_1samp(gain, 0.0, nan_policy="omit", alternative="greater")
        rate = self.monitor.false_alarm_rate
        if not better.pvalue < rate * count:
            return []
        self.model, self.monitor = other, Monitor.of(other, None, rate)
        lengths = f"correlation length {old.correlation_length:.2g} -> {new.correlation_length:.2g} m"
        change = f"{lengths}, noise {old.noise:.2g} -> {new.noise:.2g}"
        return [f"kernel chosen again after {self.count} measurements: {change}"]

    def _adapt(self, model: Interpolator, alarm: Alarm) -> float:
        """Adapt the model to a change, and calibrate the test with the next measurements."""
        n, learnt = min(alarm.at - alarm.since + 1, len(self._recent)), len(model.process.known)
        after = joined(self._recent[-n:])
        self.model, correlation = adapted(model.forget(torch.arange(learnt - n, learnt)), after)
        self.monitor = Monitor.of(self.model, None, self.monitor.false_alarm_rate)
        self._unjudged = []
        return correlation

    def state(self) -> dict[str, Any]:
        """Return the count of measurements and the state of the tests as plain values, without the spectra that wait."""
        room = None if self.room is None else self.room.state()
        return {"count": self.count, "monitor": self.monitor.state(), "room": room}

    def resume(self, state: dict[str, Any]) -> None:
        """Continue from a `state`; the model is that of the same moment."""
        self.count = int(state["count"])
        self.monitor.resume(state["monitor"])
        self.room = None
        if (known := state["room"]) is not None:
            self.room = Monitor(self.model.region(), (), None, self.monitor.false_alarm_rate)
            self.room.resume(known)


def unexplained(room: GeometryModel, spectra: Spectra) -> Tensor:
    """Return the missing coherence of the phases of each spectrum and of the paths of a room, float64 (n,)."""
    channel, _ = retrieve_phases(correlations(spectra), room.array, room.config.seed)
    scene = PhaseObservations.of_phases(spectra.position, room.link, channel)
    return (1 - room.tensors().coherence(scene) + MIN_MISSING).double()


def joined(parts: list[Spectra]) -> Spectra:
    """Return the spectra of all parts, of one scene, in memory, and their snapshots if all parts have them."""
    first, channels = parts[0], [part.channel for part in parts if part.channel is not None]
    return Spectra(
        torch.cat([part.store[:] for part in parts]),
        torch.cat([part.position for part in parts]),
        grid=first.grid,
        name=first.name,
        channel=torch.cat(channels) if len(channels) == len(parts) else None,
        **vars(Link.from_spectra(first)),
    )
