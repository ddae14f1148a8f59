"""Obstacles in a room, from the paths that lost or gained strength.

A candidate obstacle stands on the floor and weakens every path that passes through it. Each measured spectrum compares, for
every candidate, the phases that the paths give with and without it: segments that lost power intersect in the obstacle, and
segments that did not exclude it.
"""

from __future__ import annotations

import math
from copy import copy
from dataclasses import dataclass
from itertools import permutations
from typing import Any

import torch
from torch import Tensor

from swiftwrf.data.spectra import Spectra
from swiftwrf.errors import InputError
from swiftwrf.models.geometry.images import PhaseObservations, images
from swiftwrf.models.geometry.model import GeometryModel
from swiftwrf.models.geometry.path_gains import paths
from swiftwrf.models.geometry.phase_retrieval import correlations, retrieve_phases
from swiftwrf.models.geometry.planes import PlaneSet
from swiftwrf.online.change import Alarm

BLOCKED_GAIN = 0.2  # amplitude factor of a path through an obstacle, 14 dB
CELL_M, SIDE_M = 0.25, 0.6  # spacing of the candidates in plan, and their side
HEIGHTS_M = (1.0, 1.8)  # of the candidates
MIN_MISSING = 3e-3  # missing coherence that counts as none, phases of 3 degrees
MIN_EVIDENCE = 2.5  # [nats] for an obstacle that the training spectra show
MAX_STANDING = 12  # such obstacles
MAX_NATS = 3.0  # of one spectrum, so that a single one raises no alarm
N_ERRORS = 2.0  # standard errors by which a box' mean evidence in the training spectra may be wrong
MIN_STD_NATS = 0.5  # of the evidence of one spectrum
REGION_NATS = 5.0  # below the best box, of the region where an obstacle can stand
BATCH_BOXES, BATCH_SPECTRA = 100, 50  # evaluated at a time


@dataclass(frozen=True, eq=False)
class Boxes:
    """M boxes with axes along x, y and z.

    Args:
        low, high: Opposite corners, float64 (M, 3) [m].

    Example:
        >>> corner = torch.tensor([[1.0, 1.0, 0.0]], dtype=torch.float64)
        >>> len(Boxes(corner, corner + 0.5))
        1
    """

    low: Tensor
    high: Tensor

    def __len__(self) -> int:
        return len(self.low)

    @classmethod
    def candidates(cls, room: GeometryModel) -> Boxes:
        """Return boxes on the floor of a room, all over the box around planes, positions and fixed end."""
        corners = torch.cat([room.region(), room.bounds, room.fixed_position[None]])
        low, high = corners.amin(0), corners.amax(0)
        ends = zip(low[:2].tolist(), high[:2].tolist(), strict=True)
        centre = torch.cartesian_prod(*(torch.arange(a + CELL_M / 2, b, CELL_M, dtype=torch.float64) for a, b in ends))
        lows, highs = [], []
        for height in HEIGHTS_M:
            floor = low[2].expand(len(centre), 1)
            lows.append(torch.cat([centre - SIDE_M / 2, floor], dim=1))
            highs.append(torch.cat([centre + SIDE_M / 2, floor + height], dim=1))
        return cls(torch.cat(lows), torch.cat(highs))

    def block(self, point: Tensor) -> Tensor:
        """Return whether each box blocks each path with corners (n, S, C, 3) [m], bool (M, n, S)."""
        start, step = point[:, :, :-1], point.diff(dim=2)
        step = step.where(step != 0, 1e-300)
        enter = torch.zeros(len(self), *step.shape[:-1])
        leave = torch.ones_like(enter)
        for axis in range(3):
            low, high = (
                (edge[:, axis, None, None, None] - start[..., axis]) / step[..., axis] for edge in (self.low, self.high)
            )
            enter = torch.maximum(enter, torch.minimum(low, high).float())
            leave = torch.minimum(leave, torch.maximum(low, high).float())
        return (enter < leave).any(-1)


def corners(room: GeometryModel, scene: PhaseObservations) -> Tensor:
    """Return the corners of the direct path and of each image's path, from the receiver to the transmitter.

    Returns:
        float64 (n, 1 + S, order + 2, 3) [m]. Shorter paths repeat the transmitter.
    """
    planes, n = room.tensors(), len(scene)
    receiver, transmitter = scene.receiver.expand(n, 3), scene.transmitter.expand(n, 3)
    size = room.order + 2
    found = [torch.stack([receiver] + [transmitter] * (size - 1), dim=1)]
    for sequence in planes.sequence:
        target = images(scene, planes.normal, planes.offset, [sequence])[0, 0]
        path = transmitter[:, None].repeat(1, size, 1)
        path[:, 0] = receiver
        # perpendicular planes give one image for both orders of reflection; each link takes the order that it can take
        for order in sorted(set(permutations(sequence))):
            if torch.allclose(images(scene, planes.normal, planes.offset, [order])[0, 0], target):
                point, possible = _reflections(scene, planes, order, receiver)
                path[possible, 1 : 1 + len(order)] = point[possible]
        found.append(path)
    return torch.stack(found, dim=1)


def _reflections(
    scene: PhaseObservations, planes: PlaneSet, order: tuple[int, ...], receiver: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the points of reflection, last one first, (n, len(order), 3) [m], and whether the path exists, (n,)."""
    point, points, possible = receiver, [], torch.ones(len(receiver), dtype=torch.bool)
    for end in range(len(order), 0, -1):
        towards = images(scene, planes.normal, planes.offset, [order[:end]])[0, 0] - point
        normal, offset = planes.normal[0, order[end - 1]], planes.offset[0, order[end - 1]]
        share = (offset - point @ normal) / (towards @ normal)
        possible &= (share >= 0) & (share <= 1)
        point = point + share[:, None] * towards
        points.append(point)
    return torch.stack(points, dim=1), possible


def missing_coherence(scene: PhaseObservations, wave: Tensor, gain: Tensor, blocked: Tensor) -> Tensor:
    """Return the missing coherence (M, n) of each alternative and the observed phases; arguments as of `evidence`."""

    def missing(some: Tensor) -> Tensor:
        factor = torch.where(some, BLOCKED_GAIN, 1.0) * gain
        return 1 - scene.coherence(torch.einsum("mns,nsk->mnk", factor.to(wave.dtype), wave)) + MIN_MISSING

    return torch.cat([missing(part) for part in blocked.split(BATCH_BOXES)])


def evidence(scene: PhaseObservations, wave: Tensor, gain: Tensor, base: Tensor, blocked: Tensor) -> Tensor:
    """Return the log likelihood ratios of alternatives and of the base, given the phases of each spectrum.

    Args:
        scene: Observed phases at n positions.
        wave: Waves of the paths (n, S, K).
        gain: Gains of the paths (S,).
        base: Which paths the base has blocked, bool (n, S).
        blocked: Which paths each alternative has blocked, bool (M, n, S).

    Returns:
        (M, n) [nats], at most 3 in size.
    """
    ratio = missing_coherence(scene, wave, gain, base[None]) / missing_coherence(scene, wave, gain, blocked)
    return ((wave.shape[-1] - 1) / 2 * ratio.log()).clamp(-MAX_NATS, MAX_NATS)


class ObstacleMonitor:
    """Sequential test for obstacles that appeared in a room or left it, and a map of where they can stand.

    Every candidate has a cumulative sum of weighted log likelihood ratios w r. A sum above log(candidates / rate) is an
    alarm, which bounds the rate of false alarms if E exp(w r) <= 1 without a change (G. Lorden, Annals of Mathematical
    Statistics 42, 1971). A normal r of mean m < 0 and variance s^2 has this property for w <= -2 m / s^2. The training
    spectra whose paths a box touches give m and s. The weight is at most 1, that of an exact room, and 0 for a box that
    the training spectra do not exclude: it may have stood there before. The next alarm needs all sums to fall below the
    region of the last one.

    Args:
        room: Fitted room.
        train: Spectra of the unchanged scene, which calibrate the weights and show what stands in the room already. Without
            them all weights are 1.
        false_alarm_rate: False alarms a measurement.

    Example:
        >>> import swiftwrf
        >>> data = swiftwrf.simulated_room(n=40)
        >>> room = swiftwrf.GeometryModel(width=1, further=0).fit(data)
        >>> monitor = ObstacleMonitor(room, data)
        >>> monitor.value.shape == (len(monitor.boxes),)
        True
    """

    def __init__(self, room: GeometryModel, train: Spectra | None = None, false_alarm_rate: float = 1e-3) -> None:
        self.room, self.candidates = room, Boxes.candidates(room)
        self.standing = Boxes(torch.zeros(0, 3).double(), torch.zeros(0, 3).double())
        """obstacles that the training spectra show"""
        self.threshold = math.log(len(self.candidates) / false_alarm_rate)
        self.weight = torch.ones(len(self.candidates))
        """weight of the evidence for each box, (M,)"""
        if train is not None:
            self._learn(train)
        self.value = torch.zeros(len(self.boxes))
        """cumulative sum of each box [nats]"""
        self.since = torch.zeros(len(self.boxes), dtype=torch.int64)
        self.count, self.armed = 0, True

    @property
    def boxes(self) -> Boxes:
        """Candidates that can have appeared, then obstacles that can have left."""
        return Boxes(
            *(torch.cat([getattr(b, end) for b in (self.candidates, self.standing)]) for end in ("low", "high"))
        )

    def _learn(self, train: Spectra) -> None:
        """Find standing obstacles one after the other, and the weight of the evidence for every box."""
        scene, wave, gain, point = _links(self.room, train)
        blocked = self.candidates.block(point)
        base = torch.zeros(point.shape[:2], dtype=torch.bool)
        chosen: list[int] = []
        while True:
            ratio = evidence(scene, wave, gain, base, base | blocked)
            best = int(ratio.sum(1).argmax())
            if ratio[best].sum() < MIN_EVIDENCE or len(chosen) == MAX_STANDING:
                break
            chosen.append(best)
            base |= blocked[best]
        self.standing = Boxes(self.candidates.low[chosen], self.candidates.high[chosen])
        base, alternatives = self._alternatives(point)
        ratio, touched = evidence(scene, wave, gain, base, alternatives), (alternatives != base).any(-1)
        count = touched.sum(1).clamp_min(1)
        mean = (ratio * touched).sum(1) / count
        std = ((ratio - mean[:, None]).square() * touched).sum(1).div(count).sqrt().clamp_min(MIN_STD_NATS)
        least = mean + N_ERRORS * std / count.sqrt()
        self.weight = (-2 * least / std.square()).clamp(0, 1) * touched.any(1)

    def _alternatives(self, point: Tensor) -> tuple[Tensor, Tensor]:
        """Return which paths with corners (n, S, C, 3) [m] are blocked, (n, S), and if each box came or left, (M, n, S)."""
        came, here = self.candidates.block(point), self.standing.block(point)
        base = here.any(0)
        others = [torch.cat([here[:k], here[k + 1 :]]).any(0) for k in range(len(here))]
        return base, torch.cat([base | came, *(other[None] for other in others)])

    def observe(self, new: Spectra) -> list[Alarm]:
        """Add spectra in order; return the alarms, each of the box with the largest sum."""
        return [a for rows in torch.arange(len(new)).split(BATCH_SPECTRA) for a in self._observe(new.subset(rows))]

    def _observe(self, new: Spectra) -> list[Alarm]:
        scene, wave, gain, point = _links(self.room, new)
        base, alternatives = self._alternatives(point)
        touched = (alternatives != base).any(-1)  # (M, n)
        ratio = evidence(scene, wave, gain, base, alternatives) * self.weight[:, None] * touched
        alarms = []
        for column in ratio.T:
            self.since = self.since.where(self.value > 0, self.count)
            self.value = (self.value + column).clamp_min(0)
            best = int(self.value.argmax())
            highest = float(self.value[best])
            if self.armed and highest > self.threshold:
                alarms.append(Alarm(best, self.count, int(self.since[best])))
            self.armed = highest < self.threshold - REGION_NATS or (self.armed and highest <= self.threshold)
            self.count += 1
        return alarms

    def unexplained(self, spectra: Spectra) -> Tensor:
        """Return the missing coherence of each spectrum and the paths of the room with its standing obstacles, (n,)."""
        scene, wave, gain, point = _links(self.room, spectra)
        return missing_coherence(scene, wave, gain, self.standing.block(point).any(0)[None])[0].double()

    def describe(self, alarm: Alarm) -> str:
        """Return what changed and where, in words."""
        x, y, _ = ((self.boxes.low + self.boxes.high)[alarm.series] / 2).tolist()
        return f"an obstacle {'left' if alarm.series >= len(self.candidates) else 'appeared'} around {x:.1f}, {y:.1f} m"

    def state(self) -> dict[str, Any]:
        """Return obstacles, weights and sums as plain values."""
        names = ("weight", "value", "since")
        tensors = {
            "low": self.standing.low,
            "high": self.standing.high,
            "candidates_low": self.candidates.low,
            "candidates_high": self.candidates.high,
            **{name: getattr(self, name) for name in names},
        }
        return {"count": self.count, "armed": self.armed, **{name: tensor.tolist() for name, tensor in tensors.items()}}

    def continued(self, state: dict[str, Any]) -> ObstacleMonitor:
        """Return this monitor, made without training spectra, with the obstacles, weights and sums of a `state`."""
        monitor = copy(self)

        def boxes(low: str, high: str) -> Boxes:
            return Boxes(*(torch.tensor(state[end], dtype=torch.float64).reshape(-1, 3) for end in (low, high)))

        monitor.standing = boxes("low", "high")
        if "candidates_low" in state:  # the room of the model has grown since the test began
            monitor.candidates = boxes("candidates_low", "candidates_high")
            monitor.threshold = self.threshold + math.log(len(monitor.candidates) / len(self.candidates))
        monitor.count, monitor.armed = int(state["count"]), bool(state["armed"])
        monitor.weight, monitor.value = torch.tensor(state["weight"]), torch.tensor(state["value"])
        monitor.since = torch.tensor(state["since"], dtype=torch.int64)
        if not len(monitor.weight) == len(monitor.value) == len(monitor.since) == len(monitor.boxes):
            raise InputError("the state is of another room")
        return monitor

    def region(self) -> Tensor:
        """Return which boxes explain the changes nearly as well as the best one, bool (M,); none below the threshold."""
        best = self.value.max()
        return (self.value > best - REGION_NATS) & (best > self.threshold)


def _links(room: GeometryModel, spectra: Spectra) -> tuple[PhaseObservations, Tensor, Tensor, Tensor]:
    """Return observed phases, waves (n, S, K) and gains (S,) of the paths, and their corners (n, S, C, 3) [m]."""
    channel, _ = retrieve_phases(correlations(spectra), room.array, room.config.seed)
    scene = PhaseObservations.of(
        spectra.position, room.fixed_position, room.moving, room.array, room.rotation, channel.to(torch.complex64)
    )
    return scene, *paths(room, scene), corners(room, scene)
