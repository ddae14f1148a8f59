"""Image sources of paths that mirror planes reflect, and their waves at the array.

A path reflected by planes one after another arrives as if from the transmitter mirrored in them one after another, along a
straight line (J. B. Allen and D. A. Berkley, J. Acoust. Soc. Am. 65, 1979). Everything is batched over rooms that have
equally many planes; B rooms, P planes, S images, n positions, K elements.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from functools import lru_cache

import torch
from torch import Tensor

from swiftwrf.array.planar import PlanarArray
from swiftwrf.choices import Moving
from swiftwrf.models.geometry.chain import ElementChain

MAX_COSINE = 0.02  # of two planes that count as perpendicular; above 1 - MAX_COSINE**2 they count as parallel
ROUNDING_RAD = 1e-3  # of phase, to which positions are rounded in a search
N_POSITIONS = 36  # that many rooms are scored at
MAX_DISTANCE_M = 1e7  # from the fixed end; beyond, only the direction counts, because rounding destroys the phases
MIN_LENGTH_M = 1e-6  # of a path, whose amplitude is finite also between ends at one place

Sequence = tuple[int, ...]


@dataclass(frozen=True)
class PhaseObservations:
    """A link at n positions and the observed phases of its channel.

    Args:
        transmitter, receiver: Positions, float64 (n, 3), of the fixed end (1, 3) [m].
        end: The end that moves.
        element: Phase of a wave from unit vector u at each element is element @ u, float32 (K, 3) [rad].
        chain: The same phases in few steps, for many waves at once.
        wavenumber: Wavenumber [rad / m].
        channel: Observed phases, complex64 (n, 2, K) of unit modulus: the channel and its alternative, the conjugate
            observed by an array rotated by half a turn. Spectra cannot distinguish them if each element has an opposite one.
    """

    transmitter: Tensor
    receiver: Tensor
    end: Moving
    element: Tensor
    chain: ElementChain
    wavenumber: float
    channel: Tensor

    @classmethod
    def of(
        cls, position: Tensor, fixed: Tensor, moving: Moving, array: PlanarArray, rotation: Tensor, channel: Tensor
    ) -> PhaseObservations:
        """Return the link of a moving end (n, 3) [m] and a fixed end (3,) [m], with a channel (n, K) of modulus 1."""
        away = position - fixed
        size = away.abs().amax(dim=1, keepdim=True)
        position = torch.where(size > MAX_DISTANCE_M, fixed + MAX_DISTANCE_M * (away / size), position)
        transmitter, receiver = (position, fixed[None]) if moving == "transmitter" else (fixed[None], position)
        wavenumber = 2 * math.pi / array.wavelength
        element = wavenumber * array.element.double() @ rotation[:, :2].T.double()
        opposite = array.opposite
        both = torch.stack([channel, channel if opposite is None else channel.conj()[:, opposite]], dim=1)
        chain = ElementChain.of(array, element)
        return cls(transmitter, receiver, moving, element.float(), chain, wavenumber, both.to(torch.complex64))

    def __len__(self) -> int:
        return len(self.moving)

    @property
    def moving(self) -> Tensor:
        """Positions of the end that moves, (n, 3) [m]."""
        return self.transmitter if self.end == "transmitter" else self.receiver

    def subset(self, rows: Tensor) -> PhaseObservations:
        """Return the given positions."""
        moving = self.moving[rows]
        ends = (moving, self.receiver) if self.end == "transmitter" else (self.transmitter, moving)
        return replace(self, transmitter=ends[0], receiver=ends[1], channel=self.channel[rows])

    def few(self, most: int = N_POSITIONS) -> PhaseObservations:
        """Return at most `most` of the positions, evenly chosen, to score many rooms at."""
        return self.subset(self.few_rows(most))

    def few_rows(self, most: int) -> Tensor:
        """Return the numbers of at most `most` of the positions, evenly chosen."""
        return torch.linspace(0, len(self) - 1, min(most, len(self))).long()

    def around(self, origin: Tensor) -> PhaseObservations:
        """Return the link in coordinates from an origin (3,) [m], rounded to a thousandth of a radian of phase.

        Without rounding, near ties of a search would depend on the origin of the world coordinates.
        """
        step = ROUNDING_RAD / self.wavenumber
        transmitter, receiver = (((end - origin) / step).round() * step for end in (self.transmitter, self.receiver))
        return replace(self, transmitter=transmitter, receiver=receiver)

    def wave(self, source: Tensor) -> Tensor:
        """Return the wave exp(-j k d) / d of sources (..., n or 1, 3) [m] at each element, complex64 (..., n, K)."""
        ray = (source - self.receiver).float()
        length = ray.norm(dim=-1, keepdim=True).clamp_min(MIN_LENGTH_M)
        return spherical((ray / length) @ self.element.T - self.wavenumber * length, length)

    def waves(self, ray: Tensor, amplitude: Tensor) -> Tensor:
        """Return waves along rays times an amplitude, as `wave`, in the memory order for many waves.

        Args:
            ray: Vectors from the receiver to the source, float32 (3, ...) [m].
            amplitude: Real amplitudes that broadcast to (...).

        Returns:
            Waves, complex64 (K, ...).
        """
        length = ray.square().sum(0).sqrt().clamp_min(MIN_LENGTH_M)  # the norm over a first dimension is slow
        unit, amplitude = ray / length, amplitude / length
        wave = self.chain.phasors(unit.flatten(1), amplitude.flatten(), -self.wavenumber * length.flatten())
        return wave.reshape(len(self.element), *length.shape)

    def coherence(self, field: Tensor) -> Tensor:
        """Return |x^H h|^2 / K^2 of the observed and the given phases, (..., n, K) to (..., n), in [0, 1].

        The better of the two observed alternatives counts.
        """
        match = torch.einsum("...nk,nfk->...nf", field.sgn(), self.channel.conj())
        return match.abs().square().amax(-1) / field.shape[-1] ** 2

    def score(self, field: Tensor) -> Tensor:
        """Return 1 - the mean coherence, 0 if all phases agree, (..., n, K) to (...)."""
        return 1 - self.coherence(field).mean(-1)


def spherical(phase: Tensor, length: Tensor) -> Tensor:
    """Return exp(j phase) / length, complex64; cosine and sine are vectorised, torch.polar is not."""
    return torch.complex(phase.cos() / length, phase.sin() / length)


def sequences(normal: Tensor, order: int) -> list[Sequence]:
    """Return the sequences of reflecting planes, with outward normals (P, 3), of all images up to `order`.

    Planes that face alike cannot reflect each other's images, and of perpendicular ones both orders give one image.
    """
    cosine = (normal @ normal.T).tolist()
    planes = range(len(normal))
    found: list[Sequence] = [(i,) for i in planes]
    last = found
    for _ in range(order - 1):
        last = [
            (*s, i)
            for s, i in itertools.product(last, planes)
            if cosine[s[-1]][i] < 1 - MAX_COSINE**2
            and i != s[-1]
            and not (abs(cosine[s[-1]][i]) < MAX_COSINE and i < s[-1])
        ]
        found = found + last
    return found


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


def mirror(source: Tensor, normal: Tensor, offset: Tensor) -> Tensor:
    """Return sources (3, ...) [m] mirrored in planes normal . x = offset; the shapes (3, ...) and (...) broadcast.

    Coordinates are the first dimension, because sums over a last dimension of three are slow.
    """
    return source - 2 * ((source * normal).sum(0) - offset) * normal


def images(scene: PhaseObservations, normal: Tensor, offset: Tensor, sequence: list[Sequence]) -> Tensor:
    """Return the image positions, float64 (B, S, n or 1, 3) [m], in planes (B, P, 3) and (B, P) [m]."""
    tree, last, found = tree_of(tuple(sequence)), scene.transmitter.T[:, None, None].expand(-1, len(normal), 1, -1), []
    for parent, plane in tree.levels:
        last = mirror(last[:, :, parent], normal[:, plane].movedim(-1, 0)[..., None], offset[:, plane, None])
        found.append(last)
    return torch.cat(found, dim=2)[:, :, tree.rows].movedim(0, -1)


def phase_period_m(scene: PhaseObservations, normal: Tensor, offset: Tensor, plane: int) -> float:
    """Return the movement [m] of a plane of the room (1, P, 3), (1, P) that changes its phase by 2 pi on average."""
    ray = images(scene, normal, offset, [(plane,)])[0, 0] - scene.receiver
    cosine = float((ray @ normal[0, plane] / ray.norm(dim=-1)).abs().mean().clamp_min(0.3))
    return math.pi / (scene.wavenumber * cosine)


def field(scene: PhaseObservations, normal: Tensor, offset: Tensor, gain: Tensor, sequence: list[Sequence]) -> Tensor:
    """Return the sum of the waves of the given images, complex64 (B, n, K); gains (B, P), real or complex."""
    if not sequence:
        shape = (len(normal), len(scene), len(scene.element))
        return torch.zeros(shape, dtype=torch.complex64)
    source = images(scene, normal, offset, sequence)
    strength = image_gain(gain, sequence)[..., None] * visibility(scene, normal, offset, sequence)
    wave = scene.wave(source)
    return torch.einsum("bsnk,bsn->bnk", wave, strength.to(wave.dtype).expand(wave.shape[:3]))


def image_gain(gain: Tensor, sequence: list[Sequence]) -> Tensor:
    """Return the product of the gains (B, P) along each sequence, (B, S)."""
    tree, last, found = tree_of(tuple(sequence)), torch.ones(len(gain), 1), []
    for parent, plane in tree.levels:
        last = last[:, parent] * gain[:, plane]
        found.append(last)
    return torch.cat(found, dim=1)[:, tree.rows]


def visibility(scene: PhaseObservations, normal: Tensor, offset: Tensor, sequence: list[Sequence]) -> Tensor:
    """Return 1 where the path of each image exists, else 0, float32 (B, S, n or 1).

    Between parallel or perpendicular planes all paths exist, because the region is inside of all planes. Other paths are
    followed back from the receiver: they must meet their last plane from the inside, and so on.
    """
    facing = normal[:1] if normal.stride(0) == 0 else normal  # rooms that are expanded from one share their normals
    cosine = (facing @ facing.mT).abs()
    if not bool(((cosine > MAX_COSINE) & (cosine < 1 - MAX_COSINE**2)).any()):
        return torch.ones(len(normal), len(sequence), 1)
    there = torch.ones(len(normal), len(sequence), len(scene))
    for length in sorted({len(s) for s in sequence}):
        rows = [row for row, s in enumerate(sequence) if len(s) == length]
        point = scene.receiver.expand(len(normal), len(rows), -1, -1)
        for end in range(length, 0, -1):
            begun = [sequence[row][:end] for row in rows]
            last = [s[-1] for s in begun]
            n, o = normal[:, last, None], offset[:, last, None]
            towards = images(scene, normal, offset, begun) - point
            share = (o - (point * n).sum(-1)) / (towards * n).sum(-1)
            there[:, rows] *= ((share > 0) & (share < 1)).float()
            point = point + share[..., None] * towards
    return there
