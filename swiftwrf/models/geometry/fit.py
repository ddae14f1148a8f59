"""From training spectra to a room: what is searched, what held-out spectra decide, what is certain."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Annotated

import torch
from annotated_types import Ge, Le
from torch import Tensor

from swiftwrf.data.spectra import Spectra
from swiftwrf.data.splits import MIN_TRAINING, folds
from swiftwrf.errors import InputError
from swiftwrf.gp import thinned
from swiftwrf.models.base import FieldConfig
from swiftwrf.models.geometry.ambiguity import turned
from swiftwrf.models.geometry.images import Scene
from swiftwrf.models.geometry.orient import GAIN, candidates
from swiftwrf.models.geometry.phase_retrieval import correlations, element_phases
from swiftwrf.models.geometry.planes import FLOOR, Planes, RoomEstimate, advantage, clearly, correlation_score, in_step
from swiftwrf.models.geometry.search import PERFECT, STARTS, WEAK, Search, find_room
from swiftwrf.models.geometry.uncertainty import assess
from swiftwrf.runtime.progress import progress_bar
from swiftwrf.runtime.threads import single_thread
from swiftwrf.runtime.validation import NonNegativeInt, PositiveFloat, PositiveInt, configuration

SOLVED = 0.1  # relative error of a spectrum's autocorrelation up to which its phases are used
NEEDED = 2.5  # standard errors by which held-out spectra must be better for a plane or an order, all of them for turns
ROUNDS = 3  # in which planes move by turns
FURTHER = 4.0  # standard errors for a plane of any orientation, of which far more are tried
FAINT = 0.01  # gain below which a plane is none: a ten-thousandth of the power is what rounding and misfits look like
TRIED = 8  # candidates of any orientation that are refined
MAX_ORDER = 4  # of the images that may be tried
MOST = 2000  # spectra that are looked at: a room is a few dozen numbers
ENOUGH = 300  # held-out positions to decide by: as many parts are held out in turn as that takes


@configuration
class GeometryConfig(FieldConfig):
    """Options of the search for a room."""

    reach: PositiveFloat = 3.0
    """distance beyond the region of both ends up to which planes are searched [m]"""
    positions: PositiveInt = 100
    """number of positions in the search; all positions refine its result"""
    width: PositiveInt = 8
    """width of the beam search for the first planes"""
    max_order: Annotated[int, Ge(1), Le(MAX_ORDER)] = 3
    """highest number of reflections of an image source"""
    further: NonNegativeInt = 3
    """maximum number of planes of any orientation beyond those of the six sides"""


@single_thread()
def search_room(train: Spectra, config: GeometryConfig, progress: bool = False) -> RoomEstimate:
    """Estimate the planes of a room from at most 2000 of the training spectra, evenly chosen.

    Args:
        train: Training spectra with array, rotation and fixed end.
        config: Options of the search.
        progress: Show a progress bar on a terminal.

    Raises:
        InputError: Fewer than 10 different positions, or spectra that the array cannot have produced.
    """
    train, _ = _evenly(train)
    assert train.array is not None
    assert train.fixed_position is not None
    observed, _ = observe(train, config.seed)
    scene = observed.around(train.fixed_position)
    fold = folds(scene.moving, config.validation, config.seed)
    kept, held = scene.subset((fold != 0).nonzero()[:, 0]), scene.subset((fold == 0).nonzero()[:, 0])
    with progress_bar(progress) as bar:
        task = bar.add_task("finding the room", total=STARTS)
        signs, found = find_room(
            _some(kept, config.positions, config.seed), config.reach, config.width, tick=lambda: bar.advance(task)
        )
    score = correlation_score(held, Planes.of(found).refined(kept), train.array)
    some = _some(scene, config.positions, config.seed)
    found = Search(some, config.reach, signs).improve(found)
    room = Planes.of(found).refined(scene)
    splits = split(scene, fold)
    room = _pruned(_settled(room, scene), scene, splits)
    room = _completed(room, scene, some, splits, signs, config.reach)
    room = _extended(room, scene, some, splits, config)
    room = _with_order(room, splits, config.max_order)
    return assess(train, observed, room.shifted(train.fixed_position).refined(observed), score, config.reach)


@single_thread()
def refine_room(room: RoomEstimate, planes: Planes, train: Spectra, seed: int) -> RoomEstimate:
    """Refine offsets and gains of a room on other spectra of the scene, without a search, in under a second.

    Args:
        room: Estimate from other spectra.
        planes: Its planes as tensors.
        train: Spectra to refine on.
        seed: Seed of the phase retrieval.

    Raises:
        InputError: As `search_room`.
    """
    scene, _ = observe(train, seed)
    new = planes.refined(scene)
    found = zip(room.planes, new.normal[0].tolist(), new.offset[0].tolist(), new.gain[0].tolist(), strict=True)
    return replace(room, planes=[replace(p, normal=tuple(n), offset_m=o, gain=g) for p, n, o, g in found])


def _evenly(train: Spectra) -> tuple[Spectra, Tensor]:
    """At most 2000 of the spectra, evenly chosen, and their numbers."""
    (rows,) = thinned(torch.arange(len(train)), rows=MOST)
    return train.subset(rows) if len(train) > MOST else train, rows


def _some(scene: Scene, most: int, seed: int) -> Scene:
    """At most so many positions, drawn at random."""
    rows = torch.randperm(len(scene), generator=torch.Generator().manual_seed(seed))[:most]
    return scene.subset(rows.sort().values)


def split(scene: Scene, fold: Tensor) -> list[tuple[Scene, Scene]]:
    """Kept and held-out positions, of one part after the other until enough of them have been held out."""
    numbers, sizes = fold.unique(return_counts=True)
    needed = int((sizes.cumsum(0) < ENOUGH).sum()) + 1
    out = [fold == number for number in numbers[:needed]]
    return [(scene.subset((~o).nonzero()[:, 0]), scene.subset(o.nonzero()[:, 0])) for o in out]


def observe(train: Spectra, seed: int = 0) -> tuple[Scene, Tensor]:
    """What the spectra say of the channel, at most 2000 of them, and the numbers of those that say it.

    Raises:
        InputError: as `fit_geometry`.
    """
    train, rows = _evenly(train)
    assert train.array is not None
    assert train.rotation is not None
    assert train.fixed_position is not None
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
    return scene, rows[solved]


def _held_out(room: Planes, splits: list[tuple[Scene, Scene]], steps: int = 4) -> Tensor:
    """Coherence at held-out positions (n,), planes and gains refined on the others."""
    return torch.cat([held.coherence(room.refined(kept, steps).field(held)) for kept, held in splits])


def _pruned(room: Planes, scene: Scene, splits: list[tuple[Scene, Scene]]) -> Planes:
    """Without the planes that held-out spectra do not need, or that hardly reflect, the least needed first."""
    while room.normal.shape[1]:
        full = _held_out(room, splits)
        rest = [room.without(i).refined(scene, 4) for i in range(room.normal.shape[1])]
        faint = (room.gain[0].abs() < FAINT).tolist()
        needed = [0.0 if f else clearly(full, _held_out(r, splits)) for f, r in zip(faint, rest, strict=True)]
        least = min(range(len(rest)), key=needed.__getitem__)
        if needed[least] > NEEDED:
            break
        room = rest[least]
    return room


def _settled(room: Planes, scene: Scene) -> Planes:
    """With planes whole and half turns away where the spectra clearly say so.

    The search moves few planes at once, and takes one sign for all walls and one for floor and ceiling. Half a turn away a
    wrong one explains planes that are often hidden nearly as well, hence a lower score alone does not count.
    """
    for _ in range(ROUNDS):
        here = scene.coherence(room.field(scene))
        others = (r for r in turned(scene, room) if clearly(scene.coherence(r.field(scene)), here) > NEEDED)
        other = next(others, None)
        if other is None:
            break
        room = other
    return room


def _completed(
    room: Planes, scene: Scene, some: Scene, splits: list[tuple[Scene, Scene]], signs: Tensor, reach: float
) -> Planes:
    """With weak planes on sides that have none, sought with some positions and kept if held-out spectra need them.

    The search looks for strong planes: one that is hidden from most positions makes the score worse where it stands.
    """
    found = room.by_side()
    if not 0 < len(found.gain) < len(signs) or float(some.score(room.field(some))) < FLOOR:
        return room
    known = signs.clone()
    for side, gain in found.gain.items():
        known[side] = math.copysign(1, gain)
    found = Search(some, reach, known, usual=WEAK).improve(found)
    return _pruned(_settled(Planes.of(found).refined(scene), scene), scene, splits)


def _extended(
    room: Planes, scene: Scene, some: Scene, splits: list[tuple[Scene, Scene]], config: GeometryConfig
) -> Planes:
    """With further planes of any orientation, sought with some positions, as long as held-out spectra need them."""
    for _ in range(config.further):
        if float(some.score(room.field(some))) < PERFECT:
            break
        wider = []
        for normal, offset, sign in candidates(scene, room.field(scene), config.reach, TRIED):
            normals = torch.cat([room.normal, normal[None, None]], dim=1)
            offsets = torch.cat([room.offset, torch.full((1, 1), offset, dtype=torch.float64)], dim=1)
            gains = torch.cat([room.gain, torch.full((1, 1), GAIN * sign)], dim=1)
            wider.append(Planes(normals, offsets, gains, room.order).refined(some, 8, tilt=True))
        wider.sort(key=lambda r: float(some.score(r.field(some))))
        wider = [r.refined(some, 20, tilt=True) for other in wider[:2] for r in (other, *in_step(scene, other))]
        best = min(wider, key=lambda r: float(some.score(r.field(some)))).refined(scene, 15, tilt=True)
        if advantage(scene.coherence(best.field(scene)), scene.coherence(room.field(scene))) < FURTHER:
            break
        best = _pruned(best, scene, splits)
        if advantage(_held_out(best, splits), _held_out(room, splits)) < FURTHER:
            break
        room = best
    return room


def _with_order(room: Planes, splits: list[tuple[Scene, Scene]], most: int) -> Planes:
    """With images up to the order that explains held-out spectra best; a higher one must be clearly better."""
    if not room.normal.shape[1]:
        return replace(room, order=1)
    best, score = room, torch.empty(0)
    for order in range(1, most + 1):
        tried = replace(room, order=order)
        held = _held_out(tried, splits, 8)
        if not len(score) or advantage(held, score) > NEEDED:
            best, score = tried, held
    return best
