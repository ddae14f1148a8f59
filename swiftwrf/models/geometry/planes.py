"""Planes of a room, their refinement to the nearest minimum of the score, and the comparison of two rooms."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, fields, replace
from typing import Annotated, Any

import torch
from annotated_types import Ge, Gt, Le
from torch import Tensor

from swiftwrf.array.planar import PlanarArray
from swiftwrf.errors import InputError
from swiftwrf.models.geometry.images import (
    LinkAt,
    PhaseObservations,
    PlaneSet,
    Sequence,
    images,
    mirror,
    phase_period_m,
    reflections,
    tree_of,
    visibility,
)
from swiftwrf.models.geometry.phase_retrieval import autocorrelation
from swiftwrf.runtime.validation import NonNegativeFloat, check_value, configuration

MAX_PLANES, MAX_ORDER = 64, 4  # of a room, whose image sources number MAX_PLANES^MAX_ORDER at most
MIN_MISSING = 1e-5  # missing coherence by rounding of spectra and phases
MIN_FIELD, MIN_GAIN = 1e-9, 1e-6  # moduli by which derivatives are divided
IDENTIFIABLE = 0.9  # least probability of a plane that counts as identifiable


@configuration
class Plane:
    """A mirror plane normal . x = offset in world coordinates.

    Args:
        normal: Unit vector out of the room.
        offset_m: Offset [m].
        gain: Reflection gain (amplitude) with its sign, of a dielectric that at normal incidence.
        std_mm: Standard deviation of the offset within its mode [mm], which is a quarter of a phase period to either side.
        probability: Probability of that mode, in (0, 1]. The rest is that of alternative offsets.
        rival_m: Offset of the strongest alternative [m]. None if no alternative has a probability of 1 %.
        dielectric: The gain depends on the angle of incidence by Fresnel's equations for vertically polarised antennas.

    Raises:
        InputError: A normal that is no unit vector, or a number that is not finite.
    """

    normal: tuple[float, float, float]
    offset_m: float
    gain: float
    std_mm: NonNegativeFloat = 0.0
    probability: Annotated[float, Gt(0), Le(1)] = 1.0
    rival_m: float | None = None
    dielectric: bool = False

    @property
    def certain(self) -> bool:
        """True if the plane is identifiable: its mode has a probability of at least 0.9."""
        return self.probability >= IDENTIFIABLE

    def to_json(self) -> dict[str, Any]:
        """Return the fields and `certain` as plain values."""
        return asdict(self) | {"normal": list(self.normal), "certain": self.certain}

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> Plane:
        """Return the plane that `to_json` describes."""
        return cls(**{f.name: values[f.name] for f in fields(cls)} | {"normal": tuple(values["normal"])})

    def check(self) -> None:
        """Refuse a normal of another length and infinite numbers."""
        length = math.hypot(*self.normal)
        if abs(length - 1) > 1e-6:  # from rounding
            raise InputError(
                f"the normal of a plane must be a unit vector, got {self.normal} of length {length:.6g}; divide normal and "
                "offset_m by it"
            )
        if not (math.isfinite(self.offset_m) and math.isfinite(self.gain)):
            raise InputError(f"offset and gain of a plane must be finite, got {self.offset_m} m and {self.gain}")


@dataclass(frozen=True, eq=False)
class RoomEstimate:
    """Planes of a room with their uncertainty.

    Args:
        planes: Planes, an empty list if none explains the spectra.
        order: Highest number of reflections of an image source.
        score_held_out: 1 - correlation of predicted and observed co-array coefficients of the training spectra that were
            held out from the first stage of the search.
        unexplained: Fraction of the power of the co-array coefficients of the training spectra that is not predicted.
        conclusion: Result in one sentence.
        covariance: Covariance of the offsets (P, P) [m^2].

    Raises:
        InputError: More than 64 planes, or an order outside 0 to 4.
    """

    planes: Annotated[list[Plane], "p"]
    order: int
    score_held_out: float
    unexplained: float
    conclusion: str
    covariance: Annotated[Tensor, "float64 p p"]

    def __post_init__(self) -> None:
        check_value("order", self.order, Annotated[int, Ge(0), Le(MAX_ORDER)])
        check_value("the number of planes", len(self.planes), Annotated[int, Le(MAX_PLANES)])

    def to_json(self) -> dict[str, Any]:
        """Return the planes (normal . x = offset in world coordinates), order and scores as plain values."""
        scores = {"score_held_out": self.score_held_out, "unexplained": self.unexplained}
        return {"planes": [plane.to_json() for plane in self.planes], "order": self.order} | scores


def plane_set(planes: list[Plane], order: int) -> PlaneSet:
    """Return the planes of one room as tensors."""
    normal = torch.tensor([p.normal for p in planes], dtype=torch.float64).reshape(1, -1, 3)
    offset = torch.tensor([[p.offset_m for p in planes]], dtype=torch.float64)
    dielectric = torch.tensor([p.dielectric for p in planes]) if any(p.dielectric for p in planes) else None
    return PlaneSet(normal, offset, torch.tensor([[p.gain for p in planes]]), order, dielectric=dielectric)


def phase_jacobian(scene: LinkAt, planes: PlaneSet, movement: Tensor) -> tuple[Tensor, Tensor]:
    """Return the field h with the direct wave, complex64 (K, B, n), and the derivatives of its phase, (K, B, Q P, n).

    The Q parameters of each plane are offset [m], gain and, if planes tilt, two rotation angles of the normal [rad]. A
    change dh of the field changes its phase by Im(dh / h). The wave w of an image at position x, distance d and direction u
    changes by

        dw_k / w_k = j e_k . du - j k dd - dd / d,    dd = u . dx,    du = (dx - u dd) / d,

    where e_k . u is the phase at element k. So the derivatives are sums over images of a vector times dx.

    Args:
        scene: Positions.
        planes: Planes of B rooms.
        movement: `image_jacobian` of the planes.
    """
    ray = (images(scene, planes) - scene.receiver).permute(3, 0, 1, 2).float().contiguous()
    phase, length = scene.phases(ray)
    amplitude = planes.image_gain[..., None] * planes.angular_factor(scene) * visibility(scene, planes) / length
    wave = torch.complex(phase.cos() * amplitude, phase.sin() * amplitude)  # (K, B, S, n)
    total = scene.wave(scene.transmitter).T[:, None] + wave.sum(2)
    safe = torch.where(total.abs() < MIN_FIELD, torch.full_like(total, MIN_FIELD), total)
    ratio = wave * safe.reciprocal()[:, :, None]
    unit = ray / length
    real, imaginary = ratio.real / length, ratio.imag.contiguous()
    along = (scene.element @ unit.flatten(1)).view_as(real) + scene.wavenumber * length
    along = along.mul_(real).addcdiv_(imaginary, length)
    moved = torch.zeros(())
    for e, u, dx in zip(scene.element.T, unit, movement, strict=True):
        moved = moved + _over_images((real * e[:, None, None, None]).addcmul_(along, u, value=-1), dx)
    scaled = _over_images(imaginary, _log_gain_slope(planes, scene))
    n_planes = planes.gain.shape[1]
    return total, torch.cat([moved[:, :, :n_planes], scaled, moved[:, :, n_planes:]], dim=2)


def _over_images(values: Tensor, weights: Tensor) -> Tensor:
    """Return the sums over images of values (K, B, S, n) with weights (B, R, S, n or 1), (K, B, R, n)."""
    if weights.shape[-1] == 1:
        return weights[..., 0] @ values
    return torch.einsum("kbsn,brsn->kbrn", values, weights)


def _log_gain_slope(planes: PlaneSet, scene: LinkAt) -> Tensor:
    """Return the derivatives of the logarithms of the images' gains with respect to those of planes, (B, P, S, n or 1)."""
    count, gain = reflections(planes.sequence, planes.gain.shape[1])[..., None], planes.gain[..., None, None]
    here = gain * planes.plane_factor(scene)
    safe = torch.where(here.abs() < MIN_GAIN, torch.full_like(here, MIN_GAIN), here)
    if planes.dielectric is None:
        return count / safe
    step = 1e-3
    beside = (gain + step) * replace(planes, gain=planes.gain + step).plane_factor(scene)
    return count * (beside - here) / (step * safe)


def image_jacobian(planes: PlaneSet, transmitter: Tensor, tilt: bool = False) -> Tensor:
    """Return the derivatives of the image positions with respect to offset and, with `tilt`, two tilts of each plane.

    Without tilts they depend on the normals alone.

    Returns:
        Derivatives, float32 (3, B, P or 3 P, S, n or 1).
    """
    normal, offset, tree = planes.normal, planes.offset, tree_of(planes.sequence)
    (rooms, count), turns = offset.shape, 2 if tilt else 0
    across = torch.linalg.svd(normal[:, :, None]).Vh[:, :, 1:].permute(3, 2, 0, 1)  # (3, 2, B, P)
    point = transmitter.T[:, None, None].expand(-1, rooms, 1, -1)
    last, levels = point.new_zeros(3, rooms, 1, count, 1 + turns, len(transmitter) if tilt else 1), []
    for parent, plane in tree.levels:
        n, o, point = normal[:, plane].movedim(-1, 0)[..., None], offset[:, plane, None], point[:, :, parent]
        last = mirror(last[:, :, parent], n[..., None, None], o.new_zeros(()))  # as points in planes through the origin
        rows = torch.arange(len(plane))
        last[:, :, rows, plane, 0] += 2 * n
        for q in range(turns):
            turn = across[:, q, :, plane, None]
            last[:, :, rows, plane, 1 + q] -= 2 * ((point * turn).sum(0) * n + ((point * n).sum(0) - o) * turn)
        point = mirror(point, n, o)
        levels.append(last)
    return torch.cat(levels, dim=2)[:, :, tree.rows].permute(0, 1, 4, 3, 2, 5).flatten(2, 3).float()


def normal_equations(
    scene: PhaseObservations, total: Tensor, jacobian: Tensor, exact: bool = False
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the score (B,), half its gradient at each position (B, Q P, n) and its Gauss-Newton matrix (B, Q P, Q P).

    Gradient and matrix are times n. Only phases count, and one phase of each position is free. With `exact`, the matrix
    includes the phase errors, as standard deviations require. It may then be singular.
    """
    match = total.sgn()[..., None] * scene.channel.conj().permute(2, 0, 1)[:, None]
    better = match.sum(0).abs().argmax(-1, keepdim=True)
    chosen = match.gather(-1, better.expand(*total.shape, 1))[..., 0]
    mean = chosen.mean(0)
    score = 1 - mean.abs().square().mean(-1)
    error = chosen * (mean.conj() / len(chosen))  # |mean| exp(-j arg mean) / K
    turn = jacobian.clamp(-1e3, 1e3)
    turn = turn - turn.mean(0)
    slope = (turn * error.imag[:, :, None]).sum(0)
    weight = error.real[:, :, None] if exact else mean.abs()[:, None] / len(chosen)
    return score, slope, ((turn * weight) @ turn.mT).sum(0)


def refine(
    scene: PhaseObservations,
    planes: PlaneSet,
    steps: int = 10,
    *,
    tilt: bool = False,
    signs: Tensor | None = None,
    limit: float = 0.03,
) -> PlaneSet:
    """Return the planes of B rooms and their scores after Levenberg-Marquardt steps on offsets and gains.

    Args:
        scene: Observed phases.
        planes: Planes to start from.
        steps: Number of steps.
        tilt: True to rotate the normals, too.
        signs: Fixed signs of the gains on the six SIDES (6,). Defaults to free signs.
        limit: Maximum movement [m] or tilt [rad] of a plane in one step.
    """
    if not planes.sequence:
        return replace(planes, score=scene.score(planes.field(scene)))
    here, own = replace(planes, only=planes.sequence), None if signs is None else signs[planes.side]
    damping = torch.full((len(planes.offset),), 1e-2)
    movement = image_jacobian(here, scene.transmitter, tilt)
    score, slope, curve = normal_equations(scene, *phase_jacobian(scene, here, movement))
    for _ in range(steps):
        diagonal = curve.diagonal(dim1=1, dim2=2)
        system = curve + torch.diag_embed(damping[:, None] * diagonal + 1e-6 * diagonal.mean(1, keepdim=True) + 1e-9)
        step = -torch.linalg.solve(system, slope.sum(-1, keepdim=True))[..., 0]
        step = step.reshape(len(damping), -1, here.gain.shape[1])
        normal, offset = here.normal, here.offset + step[:, 0].clamp(-limit, limit).double()
        gain = here.gain + step[:, 1].clamp(-0.3, 0.3)
        if own is not None:
            gain = own * (own * gain).clamp(0.02, 1.5)
        if tilt:
            across = torch.linalg.svd(normal[:, :, None]).Vh[:, :, 1:]
            turn = step[:, 2:].clamp(-limit, limit).double()
            normal = normal + (turn.transpose(1, 2)[..., None] * across).sum(2)
            normal = normal / normal.norm(dim=-1, keepdim=True)
        trial = replace(here, normal=normal, offset=offset, gain=gain)
        if tilt:
            movement = image_jacobian(trial, scene.transmitter, tilt)
        after = normal_equations(scene, *phase_jacobian(scene, trial, movement))
        better = after[0] < score
        damping = torch.where(better, damping * 0.3, damping * 6).clamp(1e-6, 1e4)
        row, matrix = better[:, None], better[:, None, None]
        here = replace(
            here,
            normal=torch.where(matrix, normal, here.normal),
            offset=torch.where(row, offset, here.offset),
            gain=torch.where(row, gain, here.gain),
        )
        score, slope = torch.where(better, after[0], score), torch.where(matrix, after[1], slope)
        curve = torch.where(matrix, after[2], curve)
    return replace(here, only=planes.only, score=score)


def refine_all(scene: PhaseObservations, rooms: list[PlaneSet], steps: int = 10, **options: Any) -> list[PlaneSet]:
    """Return single rooms, each as by `refine`. Rooms with the same sequences are computed together."""
    refined = list(rooms)
    groups: dict[tuple[Sequence, ...], list[int]] = {}
    for number, room in enumerate(rooms):
        groups.setdefault(room.sequence, []).append(number)
    for sequence, numbers in groups.items():
        normal, offset, gain = (
            torch.cat([getattr(rooms[i], name) for i in numbers]) for name in ("normal", "offset", "gain")
        )
        start = replace(rooms[numbers[0]], normal=normal, offset=offset, gain=gain, only=sequence)
        together = refine(scene, start, steps, **options)
        parts = (t.split(1) for t in (together.normal, together.offset, together.gain, together.score))
        for number, n, o, g, score in zip(numbers, *parts, strict=True):
            refined[number] = replace(rooms[number], normal=n, offset=o, gain=g, score=score)
    return refined


def offset_covariance(scene: PhaseObservations, room: PlaneSet) -> Tensor:
    """Return the covariance of the offsets (P, P) [m^2] of one room.

    The sandwich estimator, inverse curvature around the scatter of the positions' gradients, counts unexplained paths as
    noise (P. J. Huber 1967).
    """
    jacobian = phase_jacobian(scene, room, image_jacobian(room, scene.transmitter))
    _, slope, curve = normal_equations(scene, *jacobian, exact=True)
    n, q, planes = len(scene), curve.shape[-1], room.gain.shape[1]
    inverse = torch.linalg.pinv(curve[0].double(), hermitian=True)
    scatter = slope[0].double() @ slope[0].double().T * (n / max(n - q, 1))
    covariance: Tensor = (inverse @ scatter @ inverse)[:planes, :planes]
    return covariance


def advantage(a: Tensor, b: Tensor) -> float:
    """Return how many standard errors the mean coherence a (n,) is above b."""
    difference = a - b
    return float(difference.mean() / (difference.std() / math.sqrt(len(difference))).clamp_min(1e-9))


def log_explained(coherence: Tensor) -> Tensor:
    """Return minus the logarithm of each spectrum's missing coherence, (n,)."""
    return -(1 - coherence + MIN_MISSING).log()


def log_advantage(a: Tensor, b: Tensor) -> float:
    """Return the `advantage` of coherences a over b by `log_explained`."""
    return advantage(log_explained(a), log_explained(b))


def robust_advantage(a: Tensor, b: Tensor) -> float:
    """Return the larger of `advantage` and `log_advantage` of coherences a over b.

    Linear differences are skewed if spectra are few. Logarithms hide improvements of badly explained spectra.
    """
    return max(advantage(a, b), log_advantage(a, b))


def sign_alternatives(scene: PhaseObservations, room: PlaneSet, plane: int = -1) -> list[PlaneSet]:
    """Return the rooms in which a plane has a gain of the other sign and its wave the same phase, to either side."""
    plane %= room.normal.shape[1]
    period, rooms = phase_period_m(scene, room, plane), []
    for step in (-period / 2, period / 2):
        offset, gain = room.offset.clone(), room.gain.clone()
        offset[:, plane] += step
        gain[:, plane] *= -1
        rooms.append(replace(room, offset=offset, gain=gain))
    return rooms


def correlation_score(scene: PhaseObservations, room: PlaneSet, array: PlanarArray) -> float:
    """Return 1 - correlation of predicted and observed co-array coefficients."""
    predicted = autocorrelation(room.channel(scene).sgn(), array)
    seen = autocorrelation(scene.channel[:, 0], array)
    power = float(predicted.abs().square().sum() * seen.abs().square().sum())
    return 1 - float((predicted * seen.conj()).real.sum()) / math.sqrt(power)
