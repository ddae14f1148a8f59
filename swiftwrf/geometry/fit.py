"""From training spectra to a room: what is searched, what held-out spectra decide, what is certain."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from swiftwrf.data.spectra import Spectra, check_training
from swiftwrf.data.splits import MIN_TRAINING, Validation, folds
from swiftwrf.errors import InputError
from swiftwrf.geometry.images import Scene, Sequence, field, images, sequences
from swiftwrf.geometry.model import GeometryModel, Plane
from swiftwrf.geometry.observe import autocorrelation, correlations, element_phases
from swiftwrf.geometry.orient import GAIN, candidates
from swiftwrf.geometry.refine import deviations, refine
from swiftwrf.geometry.sample import Residual, residual_statistics
from swiftwrf.geometry.search import PERFECT, STARTS, Room, Search, find_room
from swiftwrf.progress import progress_bar

SOLVED = 0.1  # relative error of a spectrum's autocorrelation up to which its phases are used
NEEDED = 2.5  # standard errors by which held-out spectra must be better for a plane or an order
FURTHER = 4.0  # the same for a plane of any orientation, of which far more are tried
TRIED = 8  # candidates of any orientation that are refined
MANY = 300  # positions from which one held-out part decides, not all in turn
MISFIT = 0.02  # wavelengths that planes are off where nothing is explained: what is not modelled is no random noise
CERTAIN = 3.0  # the same against a rival place, for a plane to be certain
VAGUE = 0.5  # deviation [rad of phase] beyond which a plane is not certain
FLAT = 0.8  # spread of the positions in any direction [rad of phase] up to which they count as flat
SCALES = (0.95, 0.97, 0.98, 0.99, 1.01, 1.02, 1.03, 1.05)  # of the carrier that rivals the given one


@dataclass(frozen=True)
class GeometryConfig:
    """How a room is searched.

    Args:
        reach: how far beyond the region of both ends planes are looked for [m].
        positions: that planes are searched with; all are used to refine what was found.
        width: of the beams that the search starts from.
        max_order: of the images that are tried.
        further: planes of any orientation that are tried at most beyond those of the six sides.
    """

    reach: float = 3.0
    positions: int = 100
    width: int = 8
    max_order: int = 3
    further: int = 3


@dataclass(frozen=True)
class _Room:
    """Planes (1, P, 3), (1, P) [m] with gains (1, P), and the order of their images."""

    normal: Tensor
    offset: Tensor
    gain: Tensor
    order: int

    @classmethod
    def of(cls, found: Room) -> _Room:
        normal, offset, gain = found.tensors()
        return cls(normal, offset, gain, 2)

    @property
    def sequence(self) -> list[Sequence]:
        return sequences(self.normal[0], self.order) if self.normal.shape[1] else []

    def field(self, scene: Scene) -> Tensor:
        """(n, K)."""
        return scene.wave(scene.transmitter) + field(scene, self.normal, self.offset, self.gain, self.sequence)[0]

    def without(self, plane: int) -> _Room:
        keep = [i for i in range(self.normal.shape[1]) if i != plane]
        return replace(self, normal=self.normal[:, keep], offset=self.offset[:, keep], gain=self.gain[:, keep])

    def refined(self, scene: Scene, steps: int = 10, tilt: bool = False) -> _Room:
        if not self.sequence:
            return self
        _, normal, offset, gain = refine(
            scene, self.normal, self.offset, self.gain, self.sequence, steps=steps, tilt=tilt
        )
        return replace(self, normal=normal, offset=offset, gain=gain)


def fit_geometry(
    train: Spectra,
    config: GeometryConfig | None = None,
    *,
    validation: Validation = "random",
    seed: int = 0,
    progress: bool = True,
) -> GeometryModel:
    """Finds the planes that mirror the known fixed end.

    Args:
        train: the only spectra it sees, with array, rotation and fixed end.
        config: how to search.
        validation: how training spectra are held out to decide on planes and order.
        seed: of what is held out and what is searched with.
        progress: shows a bar on a terminal.

    Raises:
        InputError: no array, rotation or fixed end; fewer than 10 spectra, or something not finite; spectra that the
            array cannot have produced; all positions at one place.
    """
    config = config or GeometryConfig()
    scene, fold = _observe(train, validation, seed)
    kept, held = scene.subset((fold != 0).nonzero()[:, 0]), scene.subset((fold == 0).nonzero()[:, 0])
    with progress_bar(progress) as bar:
        task = bar.add_task("finding the room", total=STARTS)
        sign, found = find_room(
            _some(kept, config.positions, seed), config.reach, width=config.width, tick=lambda: bar.advance(task)
        )
    score = _correlation_score(held, _Room.of(found).refined(kept), train)
    found = Search(_some(scene, config.positions, seed), config.reach, sign).improve(found)
    room = _Room.of(found).refined(scene)
    splits = _splits(scene, fold)
    room = _extended(_pruned(room, scene, splits), scene, splits, config)
    room = _with_order(room, splits, config.max_order)
    return _model(train, scene, room.refined(scene), score, config.reach)


def _some(scene: Scene, most: int, seed: int) -> Scene:
    """At most so many positions, drawn at random."""
    rows = torch.randperm(len(scene), generator=torch.Generator().manual_seed(seed))[:most]
    return scene.subset(rows.sort().values)


def _splits(scene: Scene, fold: Tensor) -> list[tuple[Scene, Scene]]:
    """Kept and held-out positions; all folds in turn where there are few positions."""
    out = [fold == number for number in (fold.unique().tolist() if len(fold) < MANY else [0])]
    return [(scene.subset((~o).nonzero()[:, 0]), scene.subset(o.nonzero()[:, 0])) for o in out]


def _observe(train: Spectra, validation: Validation, seed: int) -> tuple[Scene, Tensor]:
    """What the solved spectra say, and the fold of each."""
    check_training(train)
    for value, what in ((train.array, "which array took the spectra"), (train.rotation, "how the array is turned")):
        if value is None:
            raise InputError(f"{train.name} does not say {what}; the room can only be found where it is known")
    if train.fixed_position is None:
        raise InputError(f"{train.name} does not say where the fixed end stands; the room can only be found from there")
    assert train.array is not None  # said above, which a type checker cannot follow
    assert train.rotation is not None
    if len(train.position.unique(dim=0)) < MIN_TRAINING:
        raise InputError(f"the positions of {train.name} are fewer than {MIN_TRAINING} different ones")
    channel, error = element_phases(correlations(train), train.array, seed)
    solved = (error < SOLVED).nonzero()[:, 0]
    if len(solved) < max(MIN_TRAINING, len(train) / 2):
        raise InputError(
            f"only {len(solved)} of {len(train)} spectra of {train.name} fit its array; check its geometry and carrier"
        )
    scene = Scene.of(
        train.position[solved], train.fixed_position, train.moving, train.array, train.rotation, channel[solved]
    )
    return scene, folds(train.position[solved], validation, seed)


def _advantage(a: Tensor, b: Tensor) -> float:
    """By how many standard errors the coherences a (n,) are higher than b."""
    difference = a - b
    return float(difference.mean() / (difference.std() / math.sqrt(len(difference))).clamp_min(1e-9))


def _held_out(room: _Room, splits: list[tuple[Scene, Scene]], steps: int = 4) -> Tensor:
    """Coherence at held-out positions (n,), planes and gains refined on the others."""
    return torch.cat([held.coherence(room.refined(kept, steps).field(held)) for kept, held in splits])


def _pruned(room: _Room, scene: Scene, splits: list[tuple[Scene, Scene]]) -> _Room:
    """Without the planes that held-out spectra do not need, the least needed first."""
    while room.normal.shape[1]:
        full = _held_out(room, splits)
        rest = [room.without(i).refined(scene, 4) for i in range(room.normal.shape[1])]
        needed = [_advantage(full, _held_out(r, splits)) for r in rest]
        least = min(range(len(rest)), key=needed.__getitem__)
        if needed[least] > NEEDED:
            break
        room = rest[least]
    return room


def _turn(scene: Scene, room: _Room, plane: int) -> float:
    """By how much a plane moves to turn the phase of its reflection by a full turn, on average [m]."""
    ray = images(scene, room.normal, room.offset, [(plane,)])[0, 0] - scene.receiver
    cosine = float((ray @ room.normal[0, plane] / ray.norm(dim=-1)).abs().mean().clamp_min(0.3))
    return math.pi / (scene.wavenumber * cosine)


def _flipped(scene: Scene, room: _Room, plane: int = -1) -> list[_Room]:
    """The rooms in which a plane reflects with the other sign, and its wave is in step again to either side."""
    plane %= room.normal.shape[1]
    turn, rooms = _turn(scene, room, plane), []
    for step in (-turn / 2, turn / 2):
        offset, gain = room.offset.clone(), room.gain.clone()
        offset[:, plane] += step
        gain[:, plane] *= -1
        rooms.append(replace(room, offset=offset, gain=gain))
    return rooms


def _extended(room: _Room, scene: Scene, splits: list[tuple[Scene, Scene]], config: GeometryConfig) -> _Room:
    """With further planes of any orientation, as long as held-out spectra need them."""
    some = _some(scene, config.positions, 0)
    for _ in range(config.further):
        if float(some.score(room.field(some))) < PERFECT:
            break
        wider = []
        for normal, offset, sign in candidates(scene, room.field(scene), config.reach, TRIED):
            normals = torch.cat([room.normal, normal[None, None]], dim=1)
            offsets = torch.cat([room.offset, torch.full((1, 1), offset, dtype=torch.float64)], dim=1)
            gains = torch.cat([room.gain, torch.full((1, 1), GAIN * sign)], dim=1)
            wider.append(_Room(normals, offsets, gains, room.order).refined(some, 8, tilt=True))
        wider.sort(key=lambda r: float(some.score(r.field(some))))
        wider = [r.refined(some, 20, tilt=True) for other in wider[:2] for r in (other, *_flipped(scene, other))]
        best = min(wider, key=lambda r: float(some.score(r.field(some)))).refined(scene, 15, tilt=True)
        if _advantage(scene.coherence(best.field(scene)), scene.coherence(room.field(scene))) < FURTHER:
            break
        best = _pruned(best, scene, splits)
        if _advantage(_held_out(best, splits), _held_out(room, splits)) < FURTHER:
            break
        room = best
    return room


def _with_order(room: _Room, splits: list[tuple[Scene, Scene]], most: int) -> _Room:
    """With images up to the order that explains held-out spectra best; a higher one must be clearly better."""
    if not room.normal.shape[1]:
        return replace(room, order=1)
    best, score = room, torch.empty(0)
    for order in range(1, most + 1):
        tried = replace(room, order=order)
        held = _held_out(tried, splits, 8)
        if not len(score) or _advantage(held, score) > NEEDED:
            best, score = tried, held
    return best


def _correlation_score(scene: Scene, room: _Room, train: Spectra) -> float:
    """1 - correlation of predicted and observed co-array numbers, both scaled freely."""
    assert train.array is not None
    h = room.field(scene)
    predicted = autocorrelation(h / h.abs().clamp_min(1e-12), train.array)
    seen = autocorrelation(scene.channel[:, 0], train.array)
    power = float(predicted.abs().square().sum() * seen.abs().square().sum())
    return 1 - float((predicted * seen.conj()).real.sum()) / math.sqrt(power)


def _model(train: Spectra, scene: Scene, room: _Room, score: float, reach: float) -> GeometryModel:
    """The model with its verdicts."""
    assert train.array is not None
    assert train.rotation is not None
    assert train.fixed_position is not None
    planes: list[Plane] = []
    covariance = torch.zeros(0, 0, dtype=torch.float64)
    residual = Residual()
    doubt = ""
    unexplained = 1 - (1 - _correlation_score(scene, room, train)) ** 2
    if room.normal.shape[1]:
        covariance = deviations(scene, room.normal, room.offset, room.gain, room.sequence)
        systematic = MISFIT * train.array.wavelength * math.sqrt(max(unexplained, 0))
        covariance = covariance + systematic**2 * torch.eye(len(covariance), dtype=torch.float64)
        direct = float(train.line_of_sight.double().mean())
        residual = residual_statistics(scene, room.normal, room.offset, room.gain, room.sequence, direct)
        doubt = _flat(scene) or _other_carrier(scene, room)
        std = covariance.diagonal().clamp_min(0).sqrt().tolist()
        rivals = [_rival(scene, room, i) for i in range(len(std))]
        lost = [rival <= CERTAIN or s * scene.wavenumber > VAGUE for s, (rival, _) in zip(std, rivals, strict=True)]
        # rooms most of whose planes could stand elsewhere may be wrong as a whole, each plane holding the others
        all_lost = bool(doubt) or sum(lost) > len(lost) / 2
        for i, (rival, distance) in enumerate(rivals):
            away = reach if all_lost else distance if rival <= CERTAIN else 0.0
            x, y, z = room.normal[0, i].tolist()
            offset, gain = float(room.offset[0, i]), float(room.gain[0, i])
            deviation = 1000 * max(std[i], away)
            planes.append(Plane((x, y, z), offset, gain, deviation, not (lost[i] or all_lost)))
    certain_planes = sum(p.certain for p in planes)
    verdict = (
        f"{len(planes)} planes, {certain_planes} of them certain{doubt}" if planes else "no plane explains the spectra"
    )
    return GeometryModel(
        array=train.array,
        grid=train.grid,
        rotation=train.rotation,
        fixed_position=train.fixed_position,
        moving=train.moving,
        planes=planes,
        order=room.order,
        score_held_out=score,
        unexplained=unexplained,
        verdict=verdict,
        covariance=covariance,
        residual=residual,
    )


def _rival(scene: Scene, room: _Room, plane: int) -> tuple[float, float]:
    """By how many standard errors the plane's place is better than the best rival's, and how far that is away [m].

    Rivals are the best place of a scan around the plane, and the places where a wave of the other sign is in step; each is
    refined together with all other planes.
    """
    turn = _turn(scene, room, plane)
    step = torch.arange(turn / 2, 3.5 * turn, 0.4 / scene.wavenumber, dtype=torch.float64)
    beside = torch.cat([-step.flip(0), step])
    offset = room.offset.repeat(len(beside), 1)
    offset[:, plane] += beside
    rest = [s for s in room.sequence if plane not in s]
    own = [s for s in room.sequence if plane in s]
    base = scene.wave(scene.transmitter) + field(scene, room.normal, room.offset, room.gain, rest)[0]
    value = torch.stack([scene.score(base + field(scene, room.normal, o[None], room.gain, own)[0]) for o in offset])
    moved = room.offset.clone()
    moved[:, plane] += beside[value.argmin()]
    here = scene.coherence(room.field(scene))
    nearest = math.inf, 0.0
    for rival in (replace(room, offset=moved), *_flipped(scene, room, plane)):
        other = rival.refined(scene, 5)
        distance = abs(float(other.offset[0, plane] - room.offset[0, plane]))
        if distance > turn / 4:
            nearest = min(nearest, (_advantage(here, scene.coherence(other.field(scene))), distance))
    return nearest


def _flat(scene: Scene) -> str:
    """A doubt where the positions lie on a line or in a plane, from where many rooms look alike."""
    moving = scene.transmitter if len(scene.transmitter) > 1 else scene.receiver
    extent = torch.linalg.svdvals(moving - moving.mean(0)) / math.sqrt(len(moving))
    if float(extent[2]) * scene.wavenumber > FLAT:
        return ""
    shape = "a line" if float(extent[1]) * scene.wavenumber <= FLAT else "a plane"
    return f"; the positions lie on {shape}, from where many rooms look alike"


def _other_carrier(scene: Scene, room: _Room) -> str:
    """A doubt where another carrier explains the spectra clearly better, else nothing."""
    for scale in SCALES:
        other = replace(scene, wavenumber=scale * scene.wavenumber)
        rival = other.coherence(room.refined(other, 6).field(other))
        if _advantage(rival, scene.coherence(room.field(scene))) > CERTAIN:
            return f"; a carrier {100 * (scale - 1):+.0f} % from the given one explains the spectra better"
    return ""
