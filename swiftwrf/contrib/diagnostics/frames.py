"""Check that spectra and positions share one coordinate frame, and diagnose the error if not.

The peak of a spectrum is often in the direction of the line of sight. The score of a frame is the agreement

    a(frame) = mean over positions of exp(-theta^2 / (2 sigma^2)),    sigma = 10 degrees,

with theta the angle between peak and line of sight in that frame, both folded to the directions that the array
distinguishes. For a linear array, theta is the difference of their angles to its axis. Of peaks of nearly equal height, the
nearest one counts. The chance level is the mean over pairs of different positions. Only the excess over it counts.

An error of frames is named if its agreement clearly exceeds that of the declared frame and it explains most of the peaks:
axes swapped, a quaternion in another order, millimetres, azimuths clockwise, elements in another order. So is any other
constant rotation, if both halves of the positions have it. With snapshots, most of the power must arrive along the lines of
sight that the error implies: peaks alone may agree by chance.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import minimize, minimize_scalar
from scipy.spatial.transform import Rotation
from scipy.stats import spearmanr
from torch import Tensor
from torch.nn import functional

from swiftwrf.array.angles import AngularGrid, folded_to_front, rotation_matrix
from swiftwrf.array.beamforming import PHASE
from swiftwrf.array.planar import PlanarArray
from swiftwrf.contrib.diagnostics import elements
from swiftwrf.data.snapshots import Snapshots
from swiftwrf.data.spectra import Spectra
from swiftwrf.data.splits import slabs, some_rows
from swiftwrf.errors import ranges

Frame = Literal["unknown", "fits", "in part", "explained", "turned", "undecided"]
MIN_CLEAR_POSITIONS = 20  # with line of sight, to check frames
MIN_SPAN_DEG = 10.0  # between lines of sight, to check frames
MAX_END_OFFSET = 1e-3  # of normalised coordinates from the ends of their interval
MIN_EVIDENCE = 0.15  # agreement above chance to accept a frame, and above the declared frame to prefer another one
# angle of a constant rotation that is reported, and the largest difference between those of two halves of the positions
MIN_TURN = math.radians(5)
COST, TIE = 0.03, 0.03  # of a fitted parameter; difference of errors that are not distinguished
MIN_POWER = 0.05  # of an error, above the declared frame, in the fraction of the power
MIN_EXPLAINED = 0.5  # agreement of an error
# fraction of the power in the best directions that an error must explain: without and with fitted parameters, and a carrier,
# whose scale stretched positions share in part
MIN_REACHED, MIN_REACHED_FITTED, MIN_REACHED_CARRIER = 0.8, 0.9, 0.97
MAX_DECLARED, MIN_EVIDENCE_IN_PART = 0.1, 0.25  # of the declared frame, and of an error above chance, that fits in part
REACH_GRID = AngularGrid.hemisphere(30, 120)
MAX_ELSEWHERE = 0.3  # of the positions, whose peak is elsewhere, in one frame
UNITS = {"millimetres": 1e-3, "centimetres": 1e-2, "feet": 0.3048}
CONSTANT = (
    "phases between elements hardly depend on the position: the delay to each element may be missing in them, or the "
    "elements may be another axis"
)
UNCALIBRATED = "elements have constant phases"  # which a calibration reports
SLOPE = "phases grow with the element's number, by another slope in each snapshot, as of elements sampled in turn"
AXES = torch.eye(3, dtype=torch.float64)
SWAPS = {"x and y": AXES[[1, 0, 2]], "y and z": AXES[[0, 2, 1]], "x and z": AXES[[2, 1, 0]]}
MIRRORS = {axis: AXES - 2 * torch.outer(unit, unit) for axis, unit in zip("xyz", AXES, strict=True)}
AZIMUTH_ERRORS = {  # maps from x, y of the line of sight to those of the peaks
    "azimuths of the spectra turn clockwise (or the array's y axis is reversed)": ((1, 0), (0, -1)),
    "azimuths of the spectra turn clockwise from -x (or the array's x axis is reversed)": ((-1, 0), (0, 1)),
    "azimuths of the spectra are half a turn off (or the array is, or phases have the wrong sign)": ((-1, 0), (0, -1)),
    "azimuths of the spectra count from y instead of x (or the array's x axis is at y)": ((0, 1), (-1, 0)),
    "azimuths of the spectra count from -y instead of x (or the array's x axis is at -y)": ((0, -1), (1, 0)),
    "azimuths turn clockwise from y, as on a compass (or the array's x and y are swapped)": ((0, 1), (1, 0)),
}


@dataclass(frozen=True, eq=False)
class _Frame:
    """Positions of the moving end (n, 3) and of the fixed one (3,), rotation (3, 3), sign of the line of sight, array."""

    position: Tensor
    fixed: Tensor
    rotation: Tensor
    sign: float
    array: PlanarArray | None

    def away(self) -> Tensor:
        """Return vectors along the line of sight in array coordinates, (n, 3) [m]."""
        return self.sign * (self.position - self.fixed) @ self.rotation

    def towards(self) -> Tensor:
        """Return unit vectors of the line of sight in array coordinates, (n, 3)."""
        return functional.normalize(self.away(), dim=1)

    def direction(self) -> Tensor:
        """Return `towards`, folded to the directions that the array distinguishes."""
        return self.folded(self.towards())

    def folded(self, direction: Tensor) -> Tensor:
        """Return directions (..., 3), folded to those that the array distinguishes."""
        return folded_to_front(direction) if self.array is None else self.array.folded(direction)

    @property
    def linear(self) -> bool:
        """True if the array is known to lie on a line."""
        return self.array is not None and self.array.axis is not None

    def peaks(self, spectra: Tensor, grid: AngularGrid) -> Tensor:
        """Return the directions of the largest magnitude and of others of nearly equal height, (n, P, 3)."""
        padded = functional.pad(functional.pad(spectra, (1, 1), mode="circular"), (0, 0, 1, 1), value=-math.inf)
        highest = spectra.amax(dim=(1, 2), keepdim=True)
        is_peak = (spectra == functional.max_pool2d(padded, 3, stride=1)) & (spectra >= 0.97 * highest)
        height, pixel = (spectra * is_peak).flatten(1).topk(min(8, spectra[0].numel()))
        used = height >= 0.97 * height[:, :1]
        pixel = pixel.where(used, pixel[:, :1])[:, : int(used.sum(dim=1).max())]
        return self.folded(grid.direction.flatten(0, 1)[pixel])

    def mapped(self, matrix: Tensor, both: bool = False) -> _Frame:
        """Return the frame with a matrix (3, 3) applied to the positions, and to the fixed one if `both`."""
        return replace(self, position=self.position @ matrix, fixed=self.fixed @ matrix if both else self.fixed)


@dataclass(frozen=True, eq=False)
class _Hypothesis:
    """A possible error and its evidence (n,): at most 1 at each position, 0 for random phases.

    `free` counts the parameters that were fitted. `seen` are the snapshots as they would be read, for what they can reach.
    `chance` is the mean evidence for the direct paths of other positions.
    """

    evidence: Tensor
    chance: float
    free: float = 0
    seen: Snapshots | None = None
    turn: NDArray[np.float64] | None = None

    @property
    def score(self) -> float:
        """Mean evidence less the costs of the fitted parameters."""
        return float(self.evidence.mean()) - COST * self.free


def check_frames(spectra: Spectra, snapshots: Snapshots | None = None) -> tuple[Frame, str, dict[str, Any]]:
    """Compare the peaks of the spectra with the lines of sight, in the declared frame and in others.

    Args:
        spectra: Spectra with known fixed end and orientation. Positions without line of sight are omitted.
        snapshots: Snapshots that the spectra were computed from, to try other orders of their elements and axes.

    Returns:
        The result in a word and in words, and numbers by name. "unknown" with fewer than 20 such positions or an unknown
        frame.

    Example:
        >>> from swiftwrf.data.simulated import simulated_room
        >>> check_frames(simulated_room(n=40))[0]
        'fits'
    """
    rows = spectra.line_of_sight.nonzero()[:, 0]
    if len(rows) < MIN_CLEAR_POSITIONS or spectra.fixed_position is None or spectra.rotation is None:
        needed = f"the fixed end, the orientation and {MIN_CLEAR_POSITIONS} positions with line of sight"
        return "unknown", f"Frames cannot be checked: that needs {needed}.", {}
    rows = rows[some_rows(len(rows), 300)]
    sign = 1.0 if spectra.moving == "transmitter" else -1.0
    frame = _Frame(spectra.position[rows], spectra.fixed_position, spectra.rotation, sign, spectra.array)
    peak, direction = frame.peaks(spectra.store[rows], spectra.grid), frame.direction()
    agreement, chance = _agreement(direction, peak)
    explanations, turn_deg, in_part = _explanations(spectra, rows, frame, peak, snapshots)
    angle_deg, limit_deg = _nearest(direction, peak).rad2deg(), 10.0
    if spectra.array is not None:  # up to which this array's peaks are in one frame with the lines of sight
        pixel = math.degrees(max(spectra.grid.elevation_step, spectra.grid.azimuth_step))
        limit_deg = min(limit_deg, math.degrees(spectra.array.resolution) + pixel / 2)
    median_deg, elsewhere = float(angle_deg.median()), float((angle_deg > 3 * limit_deg).double().mean())
    span_deg, peak_span_deg = _span_deg(direction), _span_deg(peak[:, 0])
    follows = agreement - chance >= MIN_EVIDENCE and not explanations and turn_deg is None
    fits = follows and median_deg <= limit_deg and elsewhere <= MAX_ELSEWHERE
    error_m = None if explanations or turn_deg is not None else _error_of_positions(frame, angle_deg)
    result: Frame
    if follows and error_m is not None:
        result = "explained"
        text = (
            f". They follow it, but errors grow towards the array, as of positions that are wrong by about {error_m:.1g} m: "
            "those of another point of a robot or person than its antenna"
        )
    elif not fits and (filled := _normalised(spectra.position)):
        result = "explained"
        text = f". All coordinates fill {filled} exactly, so positions look normalised; give metres"
    elif explanations:
        result = "explained"
        text = f". That would fit {'in part ' if in_part else ''}if {'; or if '.join(explanations)}"
    elif turn_deg:
        angle = math.hypot(*turn_deg)
        axis = ", ".join(f"{a / angle:.2f}" for a in turn_deg)
        result = "turned"
        text = (
            f". A constant rotation of {angle:.0f} degrees about ({axis}) in array coordinates would mend most of it: "
            "is the orientation right?"
        )
    elif fits:
        result = "fits"
        text = " and follow it: positions, orientation and angles are in one frame"
    elif span_deg < MIN_SPAN_DEG:
        result = "undecided"
        text = (
            f". All lines of sight have nearly one direction ({span_deg:.1f} degrees between two, median), so frames "
            "cannot be checked"
        )
    elif peak_span_deg < span_deg / 4:
        result = "undecided"
        text = (
            f". The spectra hardly differ: two peaks are {peak_span_deg:.1f} degrees apart, two lines of sight "
            f"{span_deg:.1f} degrees (medians)"
        )
    elif follows:
        result = "in part"
        text = (
            f". They follow it in part: one frame reaches {limit_deg:.0f} degrees with this array, and "
            f"{elsewhere:.0%} of the peaks are elsewhere. The rest is unexplained, e.g. reflections or wrong labels"
        )
    else:
        result = "undecided"
        text = (
            " and do not follow it in any frame that was tried: unexplained, e.g. reflections are stronger, or the "
            "elements' phases are not calibrated"
        )
    by = ", by the angle to the array's axis" if frame.linear else ""
    numbers = {
        "peak_to_line_of_sight_deg": median_deg,
        "agreement": agreement,
        "agreement_by_chance": chance,
        "behind_share": 0.0 if frame.linear else float((frame.away()[:, 2] < 0).double().mean()),
        "frame": result,
        "explanations": explanations,
        "turn_deg": turn_deg,
    }
    return result, f"Peaks are {median_deg:.1f} degrees beside the line of sight (median{by}){text}.", numbers


def _error_of_positions(
    frame: _Frame, angle_deg: Tensor, min_correlation: float = 0.3, min_error_deg: float = 3.0
) -> float | None:
    """Return the error of positions [m] that angles (n,) between peaks and lines of sight suggest, None without one.

    An error of positions subtends an angle that falls with the distance. Other errors do not. The bounds are not studied.
    """
    distance = frame.away().norm(dim=1)
    near = frame.array is not None and float(distance.min()) < frame.array.far_field_m
    if near or float(angle_deg.median()) < min_error_deg:
        return None
    correlation = spearmanr(angle_deg.numpy(), -distance.numpy()).statistic
    is_clear = correlation >= max(min_correlation, 3 / math.sqrt(len(distance)))
    return float((angle_deg.deg2rad() * distance).median()) if is_clear else None


def _explanations(
    spectra: Spectra, rows: Tensor, frame: _Frame, peak: Tensor, snapshots: Snapshots | None
) -> tuple[list[str], tuple[float, ...] | None, bool]:
    """Return errors with clearly more evidence than the declared frame at some rows, in words, and a constant rotation.

    Several errors are not distinguished. The rotation is a rotation vector in array coordinates [deg]. The errors explain
    the spectra in part if the declared frame has no evidence, and they have half of what the array can reach.
    """
    seen = None if snapshots is None else snapshots.subset(rows)
    declared = float(_evidence(frame.away(), frame, peak, seen).mean())
    time = None if snapshots is None else snapshots.time
    tried: dict[str, _Hypothesis] = {}
    for name, found in _hypotheses(spectra, rows, frame, peak, seen, time):
        tried[name] = max(found, tried.get(name, found), key=lambda each: each.score)
    best, names = best_explanations({name: each.score for name, each in tried.items()}, TIE)
    if best - declared < (MIN_EVIDENCE if seen is None else MIN_POWER):
        return [], None, False
    names = [name for name in names if name != UNCALIBRATED]
    explained = [name for name in names if _reaches(tried[name], seen)]
    in_part = not explained and seen is not None and declared < MAX_DECLARED
    if in_part:
        explained = [name for name in names if _reaches_half(tried[name])]
    turn = next((tried[name].turn for name in explained if tried[name].turn is not None), None)
    in_words = [name for name in explained if tried[name].turn is None]
    return in_words, None if turn is None else tuple(np.degrees(turn).tolist()), in_part


def _normalised(position: Tensor) -> str:
    """Return the interval that every coordinate of positions (n, 3) fills exactly, as normalised ones do, or an empty text.

    Coordinates without extent are left out; one coordinate alone is no evidence.
    """
    low, high = position.amin(dim=0), position.amax(dim=0)
    varying = high > low
    for name, start in (("[-1, 1]", -1.0), ("[0, 1]", 0.0)):
        ends = torch.cat([low[varying] - start, high[varying] - 1])
        if int(varying.sum()) >= 2 and bool((ends.abs() <= MAX_END_OFFSET).all()):
            return name
    return ""


def _evidence(away: Tensor, frame: _Frame, peak: Tensor, seen: Snapshots | None) -> Tensor:
    """Return the evidence (n,) for direct paths from points `away` (n, 3): power of snapshots, otherwise peaks."""
    if seen is not None:
        return elements.evidence(seen, away)
    return _kernel(_nearest(frame.folded(functional.normalize(away, dim=1)), peak))


def _reaches(found: _Hypothesis, declared: Snapshots | None) -> bool:
    """Return True if a hypothesis explains nearly what the array can reach, and more than by chance."""
    mean = float(found.evidence.mean())
    if mean - found.chance < MIN_EVIDENCE:
        return False
    if found.seen is None or declared is None:
        return mean >= MIN_EXPLAINED + 0.1 * found.free
    chance = 1 / found.seen.channel.shape[2]
    least = MIN_REACHED_FITTED if found.free else MIN_REACHED
    if found.free and found.seen.array.wavelength != declared.array.wavelength:
        least = MIN_REACHED_CARRIER
    return mean >= max(0.45 + chance, least * _reach(found.seen))


def _reaches_half(found: _Hypothesis) -> bool:
    """Return True if a hypothesis without fits, but a rotation, explains half of what the array can reach."""
    is_clear = float(found.evidence.mean()) - found.chance >= MIN_EVIDENCE_IN_PART
    if found.seen is None or not is_clear or (found.free and found.turn is None):
        return False
    return float(found.evidence.mean()) >= _reach(found.seen) / 2


def _reach(seen: Snapshots) -> float:
    """Return the mean evidence of snapshots in the best direction of each."""
    share = seen.array.spectrum(seen.channel, REACH_GRID, PHASE).square().amax(dim=(1, 2))
    return float(elements.excess(share, 1 / seen.channel.shape[2]).mean())


def _hypotheses(
    spectra: Spectra, rows: Tensor, frame: _Frame, peak: Tensor, seen: Snapshots | None, time: Tensor | None
) -> Iterator[tuple[str, _Hypothesis]]:
    """Yield each error in words and its evidence at some rows of the spectra."""
    away, other_rows = frame.away(), torch.randperm(len(rows), generator=torch.Generator().manual_seed(0))

    def at(away: Tensor, free: float = 0, seen: Snapshots | None = seen, peak: Tensor = peak) -> _Hypothesis:
        same, other = (_evidence(each, frame, peak, seen) for each in (away, away[other_rows]))
        return _Hypothesis(same, float(other.mean()), free, seen)

    for meaning, other in _frames(frame):
        yield meaning, at(other.away())
    for meaning, matrix in AZIMUTH_ERRORS.items():
        turned = torch.cat([away[:, :2] @ torch.tensor(matrix).double().T, away[:, 2:]], dim=1)
        yield meaning, at(turned)
    for axis in "xyz":
        meaning, mirrored = best_mirror(
            frame.position, frame.fixed[None], axis, lambda p: _agreement(replace(frame, position=p).direction(), peak)
        )
        yield meaning, at(replace(frame, position=mirrored).away(), free=1)

    def placed(position: Tensor, free: float = 0) -> _Hypothesis:
        return at(replace(frame, position=position[rows]).away(), free)

    for meaning, position, free in _labels(spectra.position, time, lambda position: placed(position).score):
        yield meaning, placed(position, free)
    turn = _constant_turn(frame, peak)
    if turn is not None:
        found = at(away @ rotation_matrix(turn), free=3)
        yield "a constant rotation", replace(found, turn=turn)
    if seen is None:
        for meaning, peak_there in _grids(spectra, rows, frame):
            yield meaning, at(away, peak=peak_there)
        return
    for meaning, fitted, reading in elements.other_readings(seen, away):
        yield meaning, at(away, fitted, reading)
    flipping, power = elements.flipping_elements(seen, away)
    named = f"{'element' if len(flipping) == 1 else 'elements'} {ranges(flipping)}, counted from 0,"
    for meaning, excess_power in {
        f"the phase of {named} jumps by half a turn from measurement to measurement": power,
        CONSTANT: elements.constant_phases(seen),
        SLOPE: elements.sloped(seen, away),
        UNCALIBRATED: elements.uncalibrated(seen, away),
    }.items():
        # constant phases fit channels whose phases hardly differ, too
        yield meaning, _Hypothesis(excess_power, 0.0, {CONSTANT: 5, UNCALIBRATED: 2}.get(meaning, 0), seen)


def best_explanations(score: Mapping[str, float], tie: float) -> tuple[float, list[str]]:
    """Return the highest score of the hypotheses, and the names of those whose score differs by less than a tie."""
    best = max(score.values(), default=0.0)
    return best, [name for name, value in score.items() if value >= best - tie]


def best_mirror(
    position: Tensor, others: Tensor, axis: str, score: Callable[[Tensor], Any], refined: bool = False
) -> tuple[str, Tensor]:
    """Return in words, and the positions (n, 3) in, the mirror c - x [m] along an axis with the highest score.

    The mirror lies in the range of the positions and of others (m, 3). Offsets are scanned, and then refined if asked for.
    """
    number = "xyz".index(axis)

    def mirrored(offset: float) -> Tensor:
        found = position.clone()
        found[:, number] = offset - position[:, number]
        return found

    every = 2 * torch.cat([position, others])[:, number]
    low, high = float(every.amin()), float(every.amax())
    offset = max(torch.linspace(low, high, 40).tolist(), key=lambda offset: score(mirrored(offset)))
    if refined:
        near = offset - (high - low) / 39, offset + (high - low) / 39
        offset = float(minimize_scalar(lambda c: -score(mirrored(float(c))), bounds=near, method="bounded").x)
    return f"{axis} of the positions counts from the other side ({axis} = {offset:.1f} - {axis})", mirrored(offset)


def _nearest(direction: Tensor, peak: Tensor) -> Tensor:
    """Return the angle [rad] between directions (..., n, 3) and the nearest of the peaks (n, P, 3) of each."""
    return (direction[..., None, :] * peak).sum(dim=-1).amax(dim=-1).clamp(-1, 1).arccos()


def _kernel(angle: Tensor) -> Tensor:
    return torch.exp(-0.5 * (angle / math.radians(10)).square())


def _agreement(direction: Tensor, peak: Tensor) -> tuple[float, float]:
    """Return the agreement of directions (n, 3) and peaks (n, P, 3) of the same positions, and of different ones."""
    n = len(peak)
    cosine = (direction @ peak.flatten(0, 1).T).reshape(n, n, -1).amax(dim=-1)
    kernel = _kernel(cosine.clamp(-1, 1).arccos())
    same = float(kernel.diagonal().mean())
    return same, float((kernel.sum() - kernel.diagonal().sum()) / (n * (n - 1)))


def _span_deg(direction: Tensor) -> float:
    """Return the median angle [deg] between two of the directions (n, 3)."""
    first, second = torch.triu_indices(len(direction), len(direction), offset=1)
    return float((direction @ direction.T)[first, second].clamp(-1, 1).arccos().rad2deg().median())


def _grids(spectra: Spectra, rows: Tensor, frame: _Frame) -> Iterator[tuple[str, Tensor]]:
    """Yield each error of the rows of spectra, and the peaks (n, P, 3) without it."""
    values, grid = spectra.store[rows], spectra.grid
    if not frame.linear:
        zenith = "rows of the spectra run from the zenith down; row 0 must be the lowest elevation"
        yield zenith, frame.peaks(values.flip(1), grid)
    half = grid.n_elevation // 2
    upper, lower = values[:, half:], values.flip(1)[:, half:]
    if half >= 2 and float(torch.corrcoef(torch.stack([upper.flatten(), lower.flatten()]))[0, 1]) > 0.95:
        sphere = (
            f"rows are elevations of -90 to 90 degrees, as their halves mirror each other: give spectrum[:, {half}:]"
        )
        yield sphere, frame.peaks(upper, AngularGrid.hemisphere(len(upper[0]), grid.n_azimuth))


def _labels(
    position: Tensor, time: Tensor | None, score: Callable[[Tensor], float]
) -> Iterator[tuple[str, Tensor, float]]:
    """Yield each error of the order of positions (n, 3), the positions without it, and its number of fitted parameters."""
    n = len(position)
    yield "positions are in reverse order", position.flip(0), 0
    mixed = "rows of positions or channels are in the order of text (1, 10, 11, ..., 2)"
    for start in (0, 1):
        by_text = torch.tensor(sorted(range(n), key=lambda row: str(row + start)))
        for order in (by_text, by_text.argsort()):
            yield mixed, position[order], 0
    meaning, moved = best_delay(position, time, score)
    yield meaning, moved, 1


def best_delay(position: Tensor, time: Tensor | None, score: Callable[[Tensor], float]) -> tuple[str, Tensor]:
    """Return in words, and the positions (n, 3) without, the delay of the positions with the highest score.

    All small numbers of rows and some of the larger ones are tried. The delay is in seconds, too, if times are known.
    """
    n = len(position)
    steps = (late for late in sorted({min(step, round(1.1**step)) for step in range(1, 60)}) if late <= n // 5)
    shifts = [sign * late for late in steps for sign in (1, -1)]
    rows = torch.arange(n)
    moved = {late: position[(rows - late).clamp(0, n - 1)] for late in shifts}  # at the ends the nearest one
    late = max(moved, key=lambda late: score(moved[late]))
    step = None if time is None else abs(late) * float(time.diff().nanmedian())
    by = f"{abs(late)} row{'s' if abs(late) > 1 else ''}"
    if step and step > 0:
        by = f"{step:.2g} s ({by})"
    side = "late" if late > 0 else "early"
    return f"positions and radio differ in time: the positions are {by} {side}", moved[late]


def _frames(frame: _Frame) -> Iterator[tuple[str, _Frame]]:
    """Yield the frame of positions and array under each error."""
    quaternion = Rotation.from_matrix(frame.rotation.numpy()).as_quat()
    reordered = torch.from_numpy(Rotation.from_quat(np.roll(quaternion, -1)).as_matrix())
    yield ("the quaternion is in the order w, x, y, z; it must be x, y, z, w", replace(frame, rotation=reordered))
    yield (
        "the quaternion turns world into array coordinates; it must turn array into world",
        replace(frame, rotation=frame.rotation.T),
    )
    for meaning, matrix in linear_errors("the array's is", "xyz").items():
        yield meaning, frame.mapped(matrix)
    for names, swap in SWAPS.items():
        yield f"{names} of positions and array are swapped against the orientation", frame.mapped(swap, both=True)
    for axis, matrix in MIRRORS.items():
        against = f"{axis} of positions and array has the wrong sign against the orientation"
        yield against, frame.mapped(matrix, both=True)
    for unit, scale in UNITS.items():
        metres = f"the array's position is in {unit}, the others are in metres"
        yield metres, replace(frame, fixed=scale * frame.fixed)


def linear_errors(other: str, varying: Collection[str]) -> dict[str, Tensor]:
    """Return the matrices (3, 3) that mend errors of positions, by the error in words; they show in varying axes."""
    shown = {names: swap for names, swap in SWAPS.items() if {names[0], names[-1]} <= {*varying}}
    return {
        **{f"{names} of the positions are swapped": swap for names, swap in shown.items()},
        **{f"the positions are in {unit}, {other} in metres": scale * AXES for unit, scale in UNITS.items()},
        **{f"{axis} of the positions has the wrong sign": MIRRORS[axis] for axis in "xyz" if axis in varying},
    }


def _constant_turn(frame: _Frame, peak: Tensor) -> NDArray[np.float64] | None:
    """Return the rotation vector of the array with most agreement [rad] if it is large and the same in halves of positions.

    A linear array does not determine its rotation, so it keeps the declared one.
    """
    if frame.linear:
        return None
    scanned = Rotation.random(4000, rng=np.random.default_rng(0))
    turns = Rotation.concatenate([Rotation.identity(), scanned])
    matrices, towards = torch.from_numpy(turns.as_matrix()).float(), frame.towards().float()
    score = torch.cat(
        [_kernel(_nearest(frame.folded(towards @ m), peak.float())).mean(-1) for m in matrices.split(200)]
    )
    turn = _refined([np.zeros(3), *(turns[int(i)].as_rotvec() for i in score.topk(3).indices)], frame, peak)
    if float(np.linalg.norm(turn)) < MIN_TURN:
        return None
    half = slabs(frame.position, 2)
    parts = [_refined([turn], replace(frame, position=frame.position[half == h]), peak[half == h]) for h in (0, 1)]
    first, second = (Rotation.from_rotvec(part) for part in parts)
    return turn if float((first.inv() * second).magnitude()) <= MIN_TURN else None


def _refined(starts: list[NDArray[np.float64]], frame: _Frame, peak: Tensor) -> NDArray[np.float64]:
    """Return the rotation vector with most agreement near some."""
    towards, found = frame.towards(), []

    def score(turn: NDArray[np.float64]) -> float:
        return float(_kernel(_nearest(frame.folded(towards @ rotation_matrix(turn)), peak)).mean())

    for start in starts:
        options = {"xatol": 1e-4, "fatol": 1e-6, "initial_simplex": np.vstack([start, start + 0.1 * np.eye(3)])}
        best = minimize(lambda turn: -score(turn), start, method="Nelder-Mead", options=options).x
        found.append(Rotation.from_rotvec(best).as_rotvec())  # the shortest
    return max(found, key=score)
