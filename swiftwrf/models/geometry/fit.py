"""Estimation of a room from training spectra: search, decisions by held-out spectra, and uncertainty."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Annotated

import torch
from annotated_types import Ge, Le
from torch import Tensor

from swiftwrf.array.beamforming import covariance
from swiftwrf.array.planar import LIGHT_SPEED, PlanarArray
from swiftwrf.data.spectra import Spectra
from swiftwrf.data.splits import MIN_TRAINING, each_fold, folds
from swiftwrf.errors import InputError
from swiftwrf.gp import subsample
from swiftwrf.models.base import FieldConfig
from swiftwrf.models.geometry.images import SIDES, PhaseObservations, PlaneSet, phase_period_m
from swiftwrf.models.geometry.phase_retrieval import correlations, retrieve_phases
from swiftwrf.models.geometry.planes import (
    MAX_ORDER,
    MIN_MISSING,
    Plane,
    RoomEstimate,
    advantage,
    correlation_score,
    plane_set,
    refine,
    refine_all,
    robust_advantage,
    sign_alternatives,
)
from swiftwrf.models.geometry.search import (
    N_STARTS,
    PERFECT_SCORE,
    SIGNS,
    Search,
    find_rooms,
    oblique_planes,
)
from swiftwrf.models.geometry.uncertainty import assess, conclusion, phase_alternatives
from swiftwrf.models.link import Link
from swiftwrf.runtime.progress import progress_bar
from swiftwrf.runtime.threads import single_thread
from swiftwrf.runtime.validation import NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt, configuration

N_FINAL = (
    400  # positions of the last moves, by the study in docs/development/architecture.md; fewer do not separate aliases
)


Splits = list[tuple[PhaseObservations, PhaseObservations]]  # kept and held-out positions


@configuration
class GeometryConfig(FieldConfig):
    """Options of the search for a room."""

    search_distance_m: PositiveFloat = 3.0
    """distance beyond the region of both ends up to which planes are searched [m]"""
    n_search_positions: PositiveInt = 100
    """number of positions in the search; all positions refine its result"""
    beam_width: PositiveInt = 8
    """width of the beam search for the first planes"""
    max_order: Annotated[int, Ge(1), Le(MAX_ORDER)] = 3
    """highest number of reflections of an image source"""
    max_extra_planes: NonNegativeInt = 3
    """maximum number of planes of any orientation beyond those of the six sides"""
    max_spectra: Annotated[int, Ge(MIN_TRAINING)] = 2000
    """maximum number of training spectra that the room is estimated from, evenly chosen"""
    significance: NonNegativeFloat = 2.5
    """standard errors by which held-out spectra must be better explained for a plane or a higher order to be added"""
    min_gain: NonNegativeFloat = 0.01
    """reflection gain below which a plane is dropped; 0.01 is 1e-4 of the power, the level of rounding and misfit"""


@single_thread()
def search_room(train: Spectra, config: GeometryConfig, progress: bool) -> RoomEstimate:
    """Estimate the planes of a room from training spectra.

    Args:
        train: Training spectra with array, rotation and fixed end.
        config: Options of the search.
        progress: Show a progress bar on a terminal.

    Raises:
        InputError: Fewer than 10 different positions, or spectra that the array cannot have produced.
    """
    observed, _ = observe(train, config)
    used, _ = _evenly(train, config.max_spectra)
    assert used.fixed_position is not None
    assert used.array is not None
    scene, few = observed.around(used.fixed_position), config.n_search_positions
    fold = folds(scene.moving, config.validation, config.seed)
    splits = split(scene, fold)
    (kept, held), *_ = splits
    some, more = (_some(scene, most, config.seed) for most in (few, max(few, N_FINAL)))
    with progress_bar(progress) as bar:
        task = bar.add_task("finding the room", total=N_STARTS + len(SIGNS) + 1)
        searched = _some(kept, few, config.seed)
        rooms = find_rooms(searched, config.search_distance_m, config.beam_width, tick=lambda: bar.advance(task))
        improved = []
        for signs, room in rooms:
            improved.append(Search(more, config.search_distance_m, signs).improve(room))
            bar.advance(task)
        room, (signs, start) = min(zip(improved, rooms, strict=True), key=lambda item: float(item[0].score))
        score = correlation_score(held, refine(kept, start), used.array)
        room = _pruned(_without_aliases(refine(scene, room), scene, config), scene, splits, config)
        room = _with_weak_planes(room, scene, some, splits, signs, config)
        room = _with_further_planes(room, scene, some, splits, config)
        room = _with_order(room, splits, config)
        if train.channel is not None:
            room = with_dielectrics(room, scene, splits, config)
    final = refine(observed, room.shifted(used.fixed_position))
    return assess(used, observed, final, score, searched=True)


@single_thread()
def refine_room(room: RoomEstimate, train: Spectra, config: GeometryConfig) -> RoomEstimate:
    """Refine a room on other spectra of the scene, without a search.

    Uncertainty, scores and conclusion are those of these spectra, and no plane moves to an alternative.

    Args:
        room: Estimate from the earlier spectra.
        train: Spectra with array, rotation and fixed end.
        config: Options of the search.

    Raises:
        InputError: As `search_room`.
    """
    scene, _ = observe(train, config)
    assert train.array is not None
    planes, fold = plane_set(room.planes, room.order), folds(scene.moving, config.validation, config.seed)
    (kept, held), *_ = split(scene, fold)
    score = correlation_score(held, refine(kept, planes), train.array)
    return assess(train, scene, refine(scene, planes), score, searched=False)


@single_thread()
def decided_room(room: RoomEstimate, train: Spectra, config: GeometryConfig) -> RoomEstimate:
    """Decide by other spectra of the scene which planes of a room exist, without a search, and refine these.

    Offsets, gains, scores and conclusion are those of these spectra. As in a search, a plane is dropped if it hardly
    reflects or does not explain held-out spectra significantly better. The highest order of an image source remains.

    Args:
        room: Planes that may exist.
        train: Spectra with array, rotation and fixed end.
        config: Options of the search.

    Raises:
        InputError: As `search_room`.
    """
    scene, _ = observe(train, config)
    assert train.array is not None
    splits = split(scene, folds(scene.moving, config.validation, config.seed))
    found = _pruned(refine(scene, plane_set(room.planes, room.order)), scene, splits, config)
    (kept, held), *_ = splits
    score = correlation_score(held, refine(kept, found), train.array)
    return assess(train, scene, refine(scene, found), score, searched=False)


def widened_room(room: RoomEstimate, planes: list[Plane], train: Spectra, config: GeometryConfig) -> RoomEstimate:
    """Add known planes to a room, of which those stay that explain held-out spectra significantly better.

    Args:
        room: Estimate without the planes.
        planes: Planes, e.g. of the room of another station.
        train: Spectra that the room was estimated from.
        config: Options of the search.

    Raises:
        InputError: As `search_room`.
    """
    found = decided_room(replace(room, planes=[*room.planes, *planes]), train, config)
    return found if len(found.planes) > len(room.planes) else room


def update_room(room: RoomEstimate, new: Spectra, config: GeometryConfig) -> RoomEstimate:
    """Refine a room on more spectra, without a search. The scores remain those of the earlier spectra.

    Each estimate is weighed by its covariance (R. E. Kalman, 1960), and the odds of each plane are multiplied.

    Args:
        room: Estimate from earlier spectra.
        new: More spectra of the scene, which replace none of the earlier ones.
        config: Options, of which the seed and the number of spectra count.

    Raises:
        InputError: As `search_room`.
    """
    latest = refine_room(room, new, config)
    weight = room.covariance @ torch.linalg.pinv(room.covariance + latest.covariance, hermitian=True)
    old, own = (plane_set(r.planes, r.order) for r in (room, latest))
    offset = old.offset[0] + weight @ (own.offset - old.offset)[0]
    gain = old.gain[0] + weight.diagonal().float() * (own.gain - old.gain)[0]
    remaining = room.covariance - weight @ room.covariance
    ratio = (remaining.diagonal() / room.covariance.diagonal()).nan_to_num(1.0)  # 0 / 0 for planes without uncertainty
    scale = ratio.clamp(0, 1).sqrt()
    both = [(p.probability, f.probability) for p, f in zip(room.planes, latest.planes, strict=True)]
    probability = [p * q / (p * q + (1 - p) * (1 - q)) for p, q in both]
    values = zip(room.planes, offset.tolist(), gain.tolist(), scale.tolist(), probability, strict=True)
    planes = [replace(p, offset_m=o, gain=g, std_mm=s * p.std_mm, probability=q) for p, o, g, s, q in values]
    return replace(room, planes=planes, covariance=remaining, conclusion=conclusion(planes))


def _evenly(train: Spectra, most: int) -> tuple[Spectra, Tensor]:
    """Return at most `most` of the spectra, evenly chosen, and their row numbers."""
    (rows,) = subsample(torch.arange(len(train)), rows=most)
    return train.subset(rows) if len(train) > most else train, rows


def _some(scene: PhaseObservations, most: int, seed: int) -> PhaseObservations:
    """Return at most `most` random positions."""
    rows = torch.randperm(len(scene), generator=torch.Generator().manual_seed(seed))[:most]
    return scene.subset(rows.sort().values)


def split(scene: PhaseObservations, fold: Tensor) -> Splits:
    """Return pairs of kept and held-out positions, one for each fold."""
    return [(scene.subset(kept), scene.subset(out)) for out, kept in each_fold(fold)]


def observe(train: Spectra, config: GeometryConfig | None = None) -> tuple[PhaseObservations, Tensor]:
    """Return the phases of the channel: those of the snapshots if there are any, otherwise retrieved from the spectra.

    Returns:
        Observed phases of the spectra whose phases could be retrieved, and the row numbers of these spectra.

    Raises:
        InputError: As `search_room`.
    """
    config = config or GeometryConfig()
    train, rows = _evenly(train, config.max_spectra)
    assert train.array is not None
    link = Link.from_spectra(train)
    if len(train.position.unique(dim=0)) < MIN_TRAINING:
        raise InputError(f"the positions of {train.name} are fewer than {MIN_TRAINING} different ones")
    if train.channel is not None:
        phases = carrier_phases(train.channel, train.frequency_hz, train.array)
        if train.frequency_hz is not None:
            frequency = train.frequency_hz[_nearest(train.frequency_hz, train.array)]
            link = replace(link, array=PlanarArray(train.array.element, LIGHT_SPEED / float(frequency)))
        return PhaseObservations.of_phases(train.position, link, phases, retrieved=False), rows
    if train.grid.n_elevation == 1:
        raise InputError(f"phases of the elements do not follow from a single row of azimuths, as in {train.name}")
    channel, error = retrieve_phases(correlations(train), train.array, config.seed)
    solved = (error < 0.1).nonzero()[:, 0]  # relative error of the autocorrelation
    if len(solved) < max(MIN_TRAINING, len(train) / 2):
        raise InputError(
            f"only {len(solved)} of {len(train)} spectra of {train.name} fit its array; check its geometry and carrier"
        )
    return PhaseObservations.of_phases(train.position[solved], link, channel[solved]), rows[solved]


def carrier_phases(channel: Tensor, frequency_hz: Tensor | None, array: PlanarArray) -> Tensor:
    """Return the phasors of the elements at the carrier, complex64 (n, K) of modulus 1.

    Args:
        channel: Snapshots, complex (n, S, K).
        frequency_hz: Their frequencies (S,) [Hz]. Of several snapshots at the carrier, the signal subspace counts.
        array: Array of the carrier.
    """
    if frequency_hz is not None:
        return channel[:, _nearest(frequency_hz, array)].sgn()
    if channel.shape[1] == 1:
        return channel[:, 0].sgn()
    signal: Tensor = torch.linalg.eigh(covariance(channel)).eigenvectors[..., -1]
    return signal.to(channel.dtype).sgn()


def _nearest(frequency_hz: Tensor, array: PlanarArray) -> int:
    """Return the number of the snapshot closest to the carrier."""
    return int((frequency_hz - LIGHT_SPEED / array.wavelength).abs().argmin())


def _held_out(rooms: list[PlaneSet], splits: Splits, steps: int = 4) -> list[Tensor]:
    """Return each room's coherence at held-out positions (n,), with offsets and gains refined on the other positions."""
    coherence = [[room.coherence(held) for room in refine_all(kept, rooms, steps)] for kept, held in splits]
    return [torch.cat(parts) for parts in zip(*coherence, strict=True)]


def _pruned(room: PlaneSet, scene: PhaseObservations, splits: Splits, config: GeometryConfig) -> PlaneSet:
    """Drop planes that hardly reflect or do not explain held-out spectra significantly, the least significant first."""
    while room.normal.shape[1]:
        rest = refine_all(scene, [room.without(i) for i in range(room.normal.shape[1])], 4)
        full, *held = _held_out([room, *rest], splits)
        faint = (room.gain[0].abs() < config.min_gain).tolist()
        needed = [0.0 if f else robust_advantage(full, h) for f, h in zip(faint, held, strict=True)]
        least = min(range(len(rest)), key=needed.__getitem__)
        if needed[least] > config.significance:
            break
        room = rest[least]
    return room


def _without_aliases(room: PlaneSet, scene: PhaseObservations, config: GeometryConfig) -> PlaneSet:
    """Move planes by whole and half phase periods if the spectra are explained significantly better there.

    The search moves few planes at once, and takes one sign for all walls and one for floor and ceiling. Half a period away
    the wrong sign explains planes that are often hidden nearly as well, so a lower score alone does not count.
    """
    for _ in range(3):  # moves to other phase aliases
        here = room.coherence(scene)
        others = phase_alternatives(scene, room)
        other = next((r for r in others if robust_advantage(r.coherence(scene), here) > config.significance), None)
        if other is None:
            break
        room = other
    return room


def _with_weak_planes(
    room: PlaneSet,
    scene: PhaseObservations,
    some: PhaseObservations,
    splits: Splits,
    signs: Tensor,
    config: GeometryConfig,
    *,
    gain: float = 0.3,
) -> PlaneSet:
    """Add weak planes on sides without a plane, searched with some positions and kept if they are significant.

    A plane that is hidden from most positions makes the score worse even at its true offset with the usual gain. So gains of
    a smaller modulus are tried apart (its value is not studied).
    """
    planes, known = room.by_side(), signs.clone()
    if not 0 < len(planes) < len(signs) or room.score_at(some) < MIN_MISSING:
        return room
    for side, (_, strong) in planes.items():
        known[side] = math.copysign(1, strong)
    search = Search(some, config.search_distance_m, known, usual=gain)
    wider = refine(scene, search.improve(PlaneSet.on_sides(planes)))
    return _pruned(_without_aliases(wider, scene, config), scene, splits, config)


def _with_further_planes(
    room: PlaneSet,
    scene: PhaseObservations,
    some: PhaseObservations,
    splits: Splits,
    config: GeometryConfig,
    *,
    significance: float = 4.0,
) -> PlaneSet:
    """Add planes of any orientation, searched with some positions, as long as they are significant.

    Far more planes are tried than on the six sides, so they need more standard errors (their number is not studied).
    """
    for _ in range(config.max_extra_planes):
        if room.score_at(some) < PERFECT_SCORE:
            break
        further = oblique_planes(scene, room.field(scene), config.search_distance_m, 8)
        wider = refine_all(some, [room.joined(plane) for plane in further], 8, tilt=True)
        wider.sort(key=lambda r: r.score_at(some))
        now = room.coherence(some)
        if not wider or advantage(wider[0].coherence(some), now) < 1.0:  # standard errors
            break
        wider = [r for other in wider[:2] for r in (other, *sign_alternatives(scene, other))]
        best = min(refine_all(some, wider, 20, tilt=True), key=lambda r: r.score_at(some))
        best = refine(scene, best, 15, tilt=True)
        if advantage(best.coherence(scene), room.coherence(scene)) < significance:
            break
        best = _pruned(best, scene, splits, config)
        if advantage(*_held_out([best, room], splits)) < significance:
            break
        room = best
    return room


def _with_order(room: PlaneSet, splits: Splits, config: GeometryConfig) -> PlaneSet:
    """Choose the order of the images by held-out spectra; a higher order must be significantly better."""
    if not room.normal.shape[1]:
        return replace(room, order=1)
    best, score = room, torch.empty(0)
    for order in range(1, config.max_order + 1):
        tried = replace(room, order=order)
        (held,) = _held_out([tried], splits, 8)
        if not len(score) or advantage(held, score) > config.significance:
            best, score = tried, held
    return best


def with_dielectrics(
    room: PlaneSet, scene: PhaseObservations, splits: Splits, config: GeometryConfig, *, start_gain: float = 0.4
) -> PlaneSet:
    """Make all planes dielectrics if this explains held-out positions significantly better than constant gains.

    At grazing incidence a dielectric floor reflects with the sign of a wall, near the normal with the other one. A constant
    gain of the wrong sign leads to an offset half a phase period away, so both sides are tried.

    Args:
        room: Planes of constant gain.
        scene: Observed phases.
        splits: Kept and held-out positions.
        config: Options, of which the significance counts.
        start_gain: Modulus at normal incidence that a fit starts from, that of a relative permittivity of 5.4.
    """
    signs = 2 * SIDES[:, 2].square().float() - 1
    sign = signs[room.side]
    gain = sign * room.gain.abs().clamp_min(start_gain)
    dielectric = torch.ones(room.gain.shape[1], dtype=torch.bool)
    best = refine(scene, replace(room, gain=gain, dielectric=dielectric), signs=signs)
    for plane in (sign * room.gain < 0)[0].nonzero()[:, 0].tolist():
        tried = [best]
        for half_period in (-0.5, 0.5):
            offset, gain = best.offset.clone(), best.gain.clone()
            offset[0, plane] = room.offset[0, plane] + half_period * phase_period_m(scene, room, plane)
            gain[0, plane] = sign[0, plane] * start_gain
            tried.append(replace(best, offset=offset, gain=gain))
        best = min(refine_all(scene, tried, signs=signs), key=lambda r: float(r.score))
    return best if advantage(*_held_out([best, room], splits, 8)) > config.significance else room
