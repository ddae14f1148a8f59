"""Mirror planes, the image sources of paths that they reflect, and the waves of these at the array.

A path reflected by planes one after another arrives as if from the transmitter mirrored in them one after another, along a
straight line (J. B. Allen and D. A. Berkley, J. Acoust. Soc. Am. 65, 1979). Everything is batched over rooms that have
equally many planes; B rooms, P planes, S images, n positions, K elements.

A field is float32 (n, 2 K, B): at each position the real parts at the elements, then the imaginary parts, and the rooms
last. Sums and scores of many rooms are fast in this order of memory.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Self

import torch
from torch import Tensor

from swiftwrf.choices import Moving
from swiftwrf.models.link import Link

MAX_COSINE = 0.02  # of two planes that count as perpendicular; above 1 - MAX_COSINE**2 they count as parallel
N_POSITIONS = 36  # that many rooms are scored at
MAX_DISTANCE_M = 1e7  # from the fixed end; beyond, only the direction counts, because rounding destroys the phases
# outward normals
SIDES = torch.tensor([[-1, 0, 0], [1, 0, 0], [0, -1, 0], [0, 1, 0], [0, 0, -1], [0, 0, 1]], dtype=torch.float64)
FRAME = torch.cat([torch.zeros(3, 1), torch.eye(3)], dim=1).double()  # origin and ends of the unit vectors, (3, 4)
UNKNOWN = torch.tensor([math.nan])  # score of a room that was not refined

Sequence = tuple[int, ...]


@dataclass(frozen=True, eq=False)
class PlaneSet:
    """Planes of B rooms whose images have the same sequences of reflections.

    Args:
        normal: Outward unit normals, float64 (B, P, 3).
        offset: Offsets, float64 (B, P) [m].
        gain: Reflection gains, float32 (B, P).
        order: Highest number of reflections of an image.
        only: Sequences of reflections of the images to compute. Defaults to all up to the order.
        dielectric: Planes whose gains depend on the angle of incidence, bool (P,), see `Plane`. Defaults to none.
        score: 1 - the mean coherence of each room with the positions where it was last refined, (B,) or nan.
    """

    normal: Tensor
    offset: Tensor
    gain: Tensor
    order: int = 2
    only: tuple[Sequence, ...] | None = None
    score: Tensor = UNKNOWN
    dielectric: Tensor | None = None

    @classmethod
    def on_sides(cls, planes: dict[int, tuple[float, float]], order: int = 2, score: float = math.nan) -> PlaneSet:
        """Return a room with at most one plane on each of the six SIDES, from their offsets [m] and gains."""
        sides = sorted(planes)
        offset = torch.tensor([[planes[side][0] for side in sides]], dtype=torch.float64)
        gain = torch.tensor([[planes[side][1] for side in sides]])
        return cls(SIDES[sides][None], offset, gain, order, score=torch.tensor([score]))

    @property
    def side(self) -> Tensor:
        """Number of the side that each plane faces most, (B, P)."""
        return (self.normal @ SIDES.T).argmax(-1)

    def by_side(self) -> dict[int, tuple[float, float]]:
        """Return offset [m] and gain of the planes of one room by the side that each faces most."""
        planes = zip(self.offset[0].tolist(), self.gain[0].tolist(), strict=True)
        return dict(zip(self.side[0].tolist(), planes, strict=True))

    @cached_property
    def sequence(self) -> tuple[Sequence, ...]:
        """Sequences of reflections of the images."""
        return tuple(sequences(self.normal[0], self.order)) if self.only is None else self.only

    @property
    def image_gain(self) -> Tensor:
        """Product of the gains along each sequence, (B, S)."""
        tree, last, levels = tree_of(self.sequence), torch.ones(len(self.gain), 1), []
        for parent, plane in tree.levels:
            last = last[:, parent] * self.gain[:, plane]
            levels.append(last)
        return torch.cat(levels, dim=1)[:, tree.rows]

    def angular_factor(self, scene: LinkAt) -> Tensor:
        """Return the gain of each image at the positions of a scene, divided by `image_gain`, (B, S, n or 1)."""
        if self.dielectric is None:
            return torch.ones(1, len(self.sequence), 1)
        return (self.plane_factor(scene) ** reflections(self.sequence, self.gain.shape[1])[..., None]).prod(1)

    def plane_factor(self, scene: LinkAt) -> Tensor:
        """Return the gain of each plane on the path of each image, divided by `gain`, (B, P, S, n or 1).

        The ray of the image determines the angles at all planes if these are parallel or perpendicular.
        """
        if self.dielectric is None:
            return torch.ones(1, 1, 1, 1)
        ray = (images(scene, self) - scene.receiver).float()
        ray = torch.nn.functional.normalize(ray, dim=-1)[:, None]
        factor = _fresnel_factor(self.gain[..., None, None], self.normal.float()[:, :, None, None], ray)
        return factor.where(self.dielectric[:, None, None], 1.0)

    def shifted(self, by: Tensor) -> PlaneSet:
        """Return the planes in coordinates whose origin is at `-by` (3,) [m]."""
        return replace(self, offset=self.offset + self.normal @ by)

    def without(self, plane: int) -> PlaneSet:
        """Return the other planes."""
        keep = [i for i in range(self.normal.shape[1]) if i != plane]
        dielectric = None if self.dielectric is None else self.dielectric[keep]
        normal, offset, gain = (values[:, keep] for values in (self.normal, self.offset, self.gain))
        return replace(self, normal=normal, offset=offset, gain=gain, dielectric=dielectric)

    def joined(self, other: PlaneSet) -> PlaneSet:
        """Return these planes with those of another set, whose gains are constant."""
        normal, offset = torch.cat([self.normal, other.normal], dim=1), torch.cat([self.offset, other.offset], dim=1)
        gain, dielectric = torch.cat([self.gain, other.gain], dim=1), self.dielectric
        if dielectric is not None:
            dielectric = torch.nn.functional.pad(dielectric, (0, other.gain.shape[1]))
        return replace(self, normal=normal, offset=offset, gain=gain, dielectric=dielectric)

    def field(self, scene: LinkAt) -> Tensor:
        """Return the field with the direct wave at the positions of a scene, (n, 2 K, B)."""
        return scene.direct + field(scene, self)

    def channel(self, scene: LinkAt) -> Tensor:
        """Return the channel of one room at each element, complex64 (n, K)."""
        real, imaginary = self.field(scene)[..., 0].chunk(2, dim=1)
        return torch.complex(real, imaginary)

    def coherence(self, scene: PhaseObservations) -> Tensor:
        """Return the coherence of one room's field with the observed phases at each position, (n,)."""
        return scene.coherence(self.field(scene))[:, 0]

    def score_at(self, scene: PhaseObservations) -> float:
        """Return 1 - the mean coherence of one room."""
        return 1 - float(self.coherence(scene).mean())


@dataclass(frozen=True, eq=False)
class LinkAt:
    """The ends of a link at n positions of the moving one, and the waves between them.

    Args:
        transmitter, receiver: Positions, float64 (n, 3), of the fixed end (1, 3) [m].
        end: The end that moves.
        element: Phase of a wave from unit vector u at each element is element @ u, float32 (K, 3) [rad].
        wavenumber: Wavenumber [rad / m].
    """

    transmitter: Tensor
    receiver: Tensor
    end: Moving
    element: Tensor
    wavenumber: float

    @classmethod
    def of(cls, position: Tensor, link: Link, **values: Tensor) -> Self:
        """Return a link with array and fixed end at positions of the moving end (n, 3) [m], and what was observed there."""
        assert link.fixed_position is not None
        assert link.array is not None
        assert link.rotation is not None
        fixed, wavenumber = link.fixed_position, 2 * math.pi / link.array.wavelength
        away = position - fixed
        size = away.abs().amax(dim=1, keepdim=True)
        farthest = fixed + MAX_DISTANCE_M * (away / size.clamp_min(MAX_DISTANCE_M))
        position = torch.where(size > MAX_DISTANCE_M, farthest, position)
        ends = (position, fixed[None]) if link.moving == "transmitter" else (fixed[None], position)
        element = wavenumber * link.array.element.double() @ link.rotation[:, :2].T.double()
        return cls(*ends, link.moving, element.float(), wavenumber, **values)

    def __len__(self) -> int:
        return len(self.moving)

    @property
    def moving(self) -> Tensor:
        """Positions of the end that moves, (n, 3) [m]."""
        return self.transmitter if self.end == "transmitter" else self.receiver

    @property
    def fixed(self) -> Tensor:
        """Position of the fixed end, (3,) [m]."""
        return (self.receiver if self.end == "transmitter" else self.transmitter)[0]

    def subset(self, rows: Tensor) -> Self:
        """Return the given positions."""
        moving = self.moving[rows]
        return replace(self, transmitter=moving) if self.end == "transmitter" else replace(self, receiver=moving)

    def few_rows(self, most: int) -> Tensor:
        """Return the numbers of at most `most` of the positions, evenly chosen."""
        return torch.linspace(0, len(self) - 1, min(most, len(self))).long()

    def around(self, origin: Tensor) -> Self:
        """Return the link in coordinates from an origin (3,) [m], rounded to a thousandth of a radian of phase.

        Without rounding, near ties of a search would depend on the origin of the world coordinates.
        """
        step = 1e-3 / self.wavenumber
        transmitter, receiver = (((end - origin) / step).round() * step for end in (self.transmitter, self.receiver))
        return replace(self, transmitter=transmitter, receiver=receiver)

    @cached_property
    def direct(self) -> Tensor:
        """Field of the direct wave, (n, 2 K, 1)."""
        wave = self.wave(self.transmitter)
        return torch.cat([wave.real, wave.imag], dim=1)[..., None]

    def waves(self, source: Tensor, frequency: Tensor) -> Tensor:
        """Return the waves of `wave` at frequencies (F,) relative to the carrier, complex64 (S, n, F, K)."""
        phase, length = self.phases((source - self.receiver).float().movedim(-1, 0))
        # positions first in memory: products at each position follow
        phase = phase.permute(2, 1, 0).contiguous()[:, :, None] * frequency.float()[:, None]
        amplitude = length.reciprocal().T[:, :, None, None]
        wave = torch.complex(phase.cos() * amplitude, phase.sin() * amplitude)
        return wave.expand(len(self), -1, -1, -1).transpose(0, 1)

    def wave(self, source: Tensor) -> Tensor:
        """Return the wave exp(-j k d) / d of sources (..., n or 1, 3) [m] at each element, complex64 (..., n, K)."""
        phase, length = self.phases((source - self.receiver).float().movedim(-1, 0))
        return torch.complex(phase.cos() / length, phase.sin() / length).movedim(0, -1)

    def phases(self, ray: Tensor) -> tuple[Tensor, Tensor]:
        """Return the phase at each element (K, ...) [rad] of waves along rays, and the lengths of the rays (...) [m].

        Args:
            ray: Vectors from the receiver to the source, float32 (3, ...) [m].
        """
        # the norm over a first dimension is slow; amplitude and gradient are finite also between ends at one place
        length = ray.square().sum(0).clamp_min(1e-12).sqrt()
        phase = (self.element @ (ray / length).flatten(1)).reshape(len(self.element), *length.shape)
        return phase - self.wavenumber * length, length


@dataclass(frozen=True, eq=False)
class PhaseObservations(LinkAt):
    """A link and the observed phases of its channel.

    Args:
        channel: Observed phases, complex64 (n, T, K) of unit modulus. Of spectra T is 2: the channel and its alternative,
            the conjugate observed by an array rotated by half a turn. Spectra cannot distinguish them if each element has an
            opposite one. Of measured channels T is 1.
    """

    channel: Tensor

    @classmethod
    def of_phases(cls, position: Tensor, link: Link, channel: Tensor, retrieved: bool = True) -> Self:
        """Return the observations at positions of the moving end.

        Args:
            position: Positions of the moving end (n, 3) [m].
            link: Link with array, rotation and fixed end.
            channel: Phasors of the elements, complex (n, K) of modulus 1.
            retrieved: True for phases from spectra, which have an alternative. False for those of measured channels.
        """
        assert link.array is not None
        opposite = link.array.opposite if retrieved else None
        observed = [channel] if opposite is None else [channel, channel.conj()[:, opposite]]
        return cls.of(position, link, channel=torch.stack(observed, dim=1).to(torch.complex64))

    def subset(self, rows: Tensor) -> Self:
        return replace(super().subset(rows), channel=self.channel[rows])

    def few(self, most: int = N_POSITIONS) -> Self:
        """Return at most `most` of the positions, evenly chosen, to score many rooms at."""
        return self.subset(self.few_rows(most))

    def coherence(self, field: Tensor) -> Tensor:
        """Return |x^H h|^2 / K^2 of the observed phases and those of a field (n, 2 K, B), (n, B), in [0, 1].

        The better of the two observed alternatives counts.
        """
        size = field.shape[1] // 2
        real, imaginary = field[:, :size], field[:, size:]
        inverse = (real * real).addcmul_(imaginary, imaginary).clamp_min_(1e-30).rsqrt_()
        observed = self.channel
        match = torch.cat([observed.real, -observed.imag], dim=1) @ (real * inverse)
        match += torch.cat([observed.imag, observed.real], dim=1) @ (imaginary * inverse)
        coherence: Tensor = match.square_().unflatten(1, (2, -1)).sum(1).amax(1) / size**2
        return coherence

    def score(self, field: Tensor) -> Tensor:
        """Return 1 - the mean coherence, 0 if all phases agree, (n, 2 K, B) to (B,)."""
        return 1 - self.coherence(field).mean(0)


def sequences(normal: Tensor, order: int) -> list[Sequence]:
    """Return the sequences of reflecting planes, with outward normals (P, 3), of all images up to `order`.

    Planes that face alike cannot reflect each other's images, and of perpendicular ones both orders give one image.
    """
    cosine = (normal @ normal.T).tolist()
    planes = range(len(normal))
    every: list[Sequence] = [(i,) for i in planes]
    last = every
    for _ in range(order - 1):
        last = [
            (*s, i)
            for s, i in itertools.product(last, planes)
            if cosine[s[-1]][i] < 1 - MAX_COSINE**2
            and i != s[-1]
            and not (abs(cosine[s[-1]][i]) < MAX_COSINE and i < s[-1])
        ]
        every = every + last
    return every


@dataclass(frozen=True)
class Tree:
    """Sequences and their prefixes by length, so that all images of one order are computed at once.

    Args:
        levels: For each length, the rows of the prefixes among those of the length before, and the last planes.
        rows: Rows of the sequences among those of all lengths, one length after the other.
    """

    levels: list[tuple[Tensor, Tensor]]
    rows: Tensor


@lru_cache(maxsize=1024)
def tree_of(sequence: tuple[Sequence, ...]) -> Tree:
    """Return the tree of these sequences."""
    before: dict[Sequence, int] = {(): 0}
    row: dict[Sequence, int] = {}
    levels = []
    for length in range(1, max(map(len, sequence)) + 1):
        these = list(dict.fromkeys(s[:length] for s in sequence if len(s) >= length))
        levels.append((torch.tensor([before[s[:-1]] for s in these]), torch.tensor([s[-1] for s in these])))
        before = {s: number for number, s in enumerate(these)}
        row |= {s: number + len(row) for s, number in before.items()}
    return Tree(levels, torch.tensor([row[s] for s in sequence]))


@lru_cache(maxsize=1024)
def reflections(sequence: tuple[Sequence, ...], planes: int) -> Tensor:
    """Return how many times each plane reflects each sequence, (P, S)."""
    return torch.tensor([[float(s.count(plane)) for s in sequence] for plane in range(planes)])


def _fresnel_factor(gain: Tensor, normal: Tensor, ray: Tensor) -> Tensor:
    """Return the Fresnel reflection coefficient of vertically polarised waves, relative to that at normal incidence.

    The components of the electric field perpendicular and parallel to the plane of incidence are reflected by

        r_s = (root - c) / (root + c),    r_p = (e c - root) / (e c + root),    root = sqrt(e - 1 + c^2),

    with cosine c of the angle of incidence and relative permittivity e. The polarisation that the reflection turns away
    from the vertical is lost.

    Args:
        gain: Gain g at normal incidence, which determines the permittivity, sqrt(e) = (1 + |g|) / (1 - |g|).
        normal: Unit normal of the plane, (..., 3).
        ray: Unit vector along the ray, (..., 3).
    """
    gain = gain.abs().clamp(0.02, 0.98)
    permittivity = ((1 + gain) / (1 - gain)).square()
    cosine = (ray * normal).sum(-1).abs()
    across = (ray[..., 0] * normal[..., 1] - ray[..., 1] * normal[..., 0]).square()
    # fraction of the power that is perpendicular to the plane of incidence; any at normal incidence
    across = (across / ((1 - cosine.square()) * (1 - ray[..., 2].square())).clamp_min(1e-6)).clamp_max(1.0)
    root = (permittivity - 1 + cosine.square()).sqrt()
    perpendicular = (root - cosine) / (root + cosine)
    parallel = (permittivity * cosine - root) / (permittivity * cosine + root)
    return (across * perpendicular + (1 - across) * parallel) / gain


def mirror(source: Tensor, normal: Tensor, offset: Tensor) -> Tensor:
    """Return sources (3, ...) [m] mirrored in planes normal . x = offset; the shapes (3, ...) and (...) broadcast.

    Coordinates are the first dimension, because sums over a last dimension of three are slow.
    """
    return source - 2 * ((source * normal).sum(0) - offset) * normal


def images(scene: LinkAt, planes: PlaneSet) -> Tensor:
    """Return the image positions, float64 (B, S, n or 1, 3) [m]."""
    normal, offset, tree = planes.normal, planes.offset, tree_of(planes.sequence)
    # the origin and the ends of the unit vectors are mirrored, and positions follow by one product
    last, levels = FRAME[:, None, None].expand(-1, len(normal), 1, -1), []
    for parent, plane in tree.levels:
        last = mirror(last[:, :, parent], normal[:, plane].movedim(-1, 0)[..., None], offset[:, plane, None])
        levels.append(last)
    origin, ends = torch.cat(levels, dim=2)[:, :, tree.rows].split([1, 3], dim=-1)
    position: Tensor = origin + (ends - origin) @ scene.transmitter.T
    return position.movedim(0, -1)


def phase_period_m(scene: LinkAt, room: PlaneSet, plane: int) -> float:
    """Return the movement [m] of a plane of one room that changes its phase by 2 pi on average."""
    ray = images(scene, replace(room, only=((plane,),)))[0, 0] - scene.receiver
    cosine = float((ray @ room.normal[0, plane] / ray.norm(dim=-1)).abs().mean().clamp_min(0.3))
    return math.pi / (scene.wavenumber * cosine)


def field(scene: LinkAt, planes: PlaneSet) -> Tensor:
    """Return the sum of the waves of the images, without the direct wave, (n, 2 K, B)."""
    if not planes.sequence:
        return torch.zeros(len(scene), 2 * len(scene.element), len(planes.offset))
    ray = (images(scene, planes) - scene.receiver).permute(3, 1, 2, 0).float().contiguous()
    gain = planes.image_gain[..., None] * planes.angular_factor(scene)
    strength = (gain * visibility(scene, planes)).permute(1, 2, 0)
    size = max(1, 2**15 // max(1, ray[0, 0].numel()))  # there may be no rooms
    total = torch.zeros(())
    for some, part in zip(ray.split(size, dim=1), strength.split(size), strict=True):
        phase, length = scene.phases(some)
        amplitude = part / length
        total = total + torch.stack([phase.cos().mul_(amplitude).sum(1), phase.sin_().mul_(amplitude).sum(1)])
    return total.permute(2, 0, 1, 3).flatten(1, 2)


def visibility(scene: LinkAt, planes: PlaneSet) -> Tensor:
    """Return 1 where the path of each image exists, else 0, float32 (B, S, n or 1).

    Between parallel or perpendicular planes all paths exist, because the region is inside of all planes. Other paths are
    followed back from the receiver: they must meet their last plane from the inside, and so on.
    """
    normal, offset, sequence = planes.normal, planes.offset, planes.sequence
    facing = normal[:1] if normal.stride(0) == 0 else normal  # rooms that are expanded from one share their normals
    cosine = (facing @ facing.mT).abs()
    if not bool(((cosine > MAX_COSINE) & (cosine < 1 - MAX_COSINE**2)).any()):
        return torch.ones(len(normal), len(sequence), 1)
    there = torch.ones(len(normal), len(sequence), len(scene))
    for length in sorted({len(s) for s in sequence}):
        rows = [row for row, s in enumerate(sequence) if len(s) == length]
        point = scene.receiver.expand(len(normal), len(rows), -1, -1)
        for end in range(length, 0, -1):
            begun = tuple(sequence[row][:end] for row in rows)
            last = [s[-1] for s in begun]
            n, o = normal[:, last, None], offset[:, last, None]
            towards = images(scene, replace(planes, only=begun)) - point
            fraction = (o - (point * n).sum(-1)) / (towards * n).sum(-1)
            there[:, rows] *= ((fraction > 0) & (fraction < 1)).float()
            point = point + fraction[..., None] * towards
    return there
