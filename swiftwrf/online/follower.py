"""A model that follows its scene: each measurement is scored, tested for a change, and learnt."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from swiftwrf.data.rssi import Rssi
from swiftwrf.data.spectra import Spectra
from swiftwrf.data.splits import MIN_TRAINING
from swiftwrf.errors import InputError
from swiftwrf.models.base import FieldModel
from swiftwrf.models.geometry.images import PhaseObservations
from swiftwrf.models.geometry.model import GeometryModel
from swiftwrf.models.geometry.phase_retrieval import correlations, retrieve_phases
from swiftwrf.models.link import Link
from swiftwrf.models.process import ProcessModel
from swiftwrf.online.adaptation import adapted
from swiftwrf.online.change import Alarm
from swiftwrf.online.kernel import KernelMonitor, described
from swiftwrf.online.monitor import Monitor, MonitorConfig
from swiftwrf.online.prequential import Scores, learnt, score
from swiftwrf.rssi.model import RssiModel

ROOM_NOTICE = "the room no longer explains the spectra since measurement {}; fit it again, also if an obstacle appeared"
MIN_MISSING = 3e-3  # missing coherence that counts as none, phases of 3 degrees
MAX_RECENT = 500  # spectra that are kept to adapt the model to a change
MAX_WAITING = 5 * MIN_TRAINING  # spectra that wait for an update of a geometry


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
    Kernel and noise are chosen again while the data grow (`KernelMonitor`).
    With a room and training spectra, a notice reports once if the room no longer explains the spectra. The planes of a
    geometry are refined whenever 10 positions are new; until then, its spectra wait.

    Args:
        model: Fitted model with `update`.
        train: Training data of the model in their order, which calibrate the test for spectra.
        config: Options of the test.

    Raises:
        InputError: A model without `update`, or training spectra of another link than that of the model.

    Example:
        >>> import swiftwrf
        >>> data = swiftwrf.rssi_room(n=80)
        >>> follower = Follower(swiftwrf.RssiModel().fit(data.subset(torch.arange(79))))
        >>> follower.step(data.subset(torch.tensor([79]))).alarms
        ()
        >>> follower.count
        1
    """

    def __init__(
        self, model: FieldModel | RssiModel, train: Spectra | Rssi | None = None, config: MonitorConfig | None = None
    ) -> None:
        self.model, self.count = model, 0
        self.monitor = Monitor.of(model, train, config)
        self._kernel = KernelMonitor(self.monitor.config.false_alarm_rate)
        self.room: Monitor | None = None
        """test of the coherence of room and spectra; None without room or training spectra, and after its alarm"""
        self._found = model.room if isinstance(model, FieldModel) else None  # as it was before the test
        if self._found is not None and isinstance(train, Spectra):
            # furniture blocks paths in some regions, whose coherence is lower without any change
            whole = replace(self.monitor.config, n_regions=1)
            self.room = Monitor(train.position, (), unexplained(self._found, train), whole)
        self._recent: list[Spectra] = []
        self.waiting: Spectra | None = None
        """spectra that a geometry has not learnt yet, for its next update"""

    def step(self, new: Spectra | Rssi) -> Step:
        """Score one measurement, test it for a change, and learn it.

        Raises:
            InputError: As `update`.
        """
        scores = score(self.model, new)
        alarms = self.monitor.observe(scores.position[0], scores.innovation[0])
        words, correlation, notices = list(map(self.monitor.describe, alarms)), None, []
        if isinstance(new, Spectra):
            notices += self._check_room(new)
        notices += self._learn(new)
        self.count += 1
        if isinstance(new, Spectra) and isinstance(self.model, ProcessModel):
            self._recent = [*self._recent, new][-MAX_RECENT:]
            if alarms:
                correlation = self._adapt(self.model, alarms[0])
        if correlation is None and isinstance(self.model, ProcessModel | RssiModel):
            notices += self._choose_kernel(self.model, new, scores)
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
            if len(waiting) < MAX_WAITING:
                return []
            notices = [f"{len(waiting)} spectra were not learnt: {error}"]
        self.waiting = None
        return notices

    def _check_room(self, new: Spectra) -> list[str]:
        """Return a notice if the room no longer explains the spectra, which ends the test."""
        if self.room is None or self._found is None:
            return []
        alarms = self.room.observe(new.position[0], unexplained(self._found, new))
        if not alarms:
            return []
        self.room = None
        return [ROOM_NOTICE.format(alarms[0].since)]

    def _choose_kernel(self, model: ProcessModel | RssiModel, new: Spectra | Rssi, scores: Scores) -> list[str]:
        """Choose the kernel again; return a notice if another one predicts better."""
        found = self._kernel.observe(model, new, scores)
        if found is None:
            return []
        self.model, self.monitor = found, Monitor.of(found, None, self.monitor.config)
        change = described(model.kernel, found.kernel)
        return [f"kernel chosen again after {self.count} measurements: {change}"]

    def _adapt(self, model: ProcessModel, alarm: Alarm) -> float:
        """Adapt the model to a change, and calibrate the test with the next measurements."""
        n, learnt = min(alarm.at - alarm.since + 1, len(self._recent)), len(model.process.known)
        after = joined(self._recent[-n:])
        self.model, correlation = adapted(model.forget(torch.arange(learnt - n, learnt)), after)
        self.monitor = Monitor.of(self.model, None, self.monitor.config)
        self._kernel.restart()
        return correlation

    def state(self) -> dict[str, Any]:
        """Return the count of measurements and the state of the tests as plain values, without the spectra that wait."""
        room = None if self.room is None else self.room.state()
        return {"count": self.count, "monitor": self.monitor.state(), "room": room}

    def resume(self, state: dict[str, Any]) -> None:
        """Continue from a `state`; the model is that of the same moment."""
        self.count, self.monitor = int(state["count"]), self.monitor.continued(state["monitor"])
        if (known := state.get("room")) is not None:
            centre = torch.tensor(known["centre"], dtype=torch.float64)
            self.room = Monitor(centre, (), None, self.monitor.config).continued(known)


def unexplained(room: GeometryModel, spectra: Spectra) -> Tensor:
    """Return the missing coherence of the phases of each spectrum and of the paths of a room, float64 (n,)."""
    channel, _ = retrieve_phases(correlations(spectra), room.array, room.config.seed)
    scene = PhaseObservations.of(
        spectra.position, room.fixed_position, room.moving, room.array, room.rotation, channel.to(torch.complex64)
    )
    return (1 - room.tensors().coherence(scene) + MIN_MISSING).double()


def joined(parts: list[Spectra]) -> Spectra:
    """Return the spectra of all parts, of one scene, in memory."""
    first = parts[0]
    return Spectra(
        torch.cat([part.store[:] for part in parts]),
        torch.cat([part.position for part in parts]),
        grid=first.grid,
        name=first.name,
        **vars(Link.from_spectra(first)),
    )
