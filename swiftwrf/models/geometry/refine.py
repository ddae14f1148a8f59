"""Refinement of planes and gains to the nearest minimum of the score, of many rooms at once."""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor

from swiftwrf.models.geometry.images import (
    PhaseObservations,
    Sequence,
    image_gain,
    images,
    mirror,
    tree_of,
    visibility,
)

MIN_FIELD, MIN_GAIN = 1e-9, 1e-6  # moduli by which derivatives are divided


def phase_jacobian(
    scene: PhaseObservations, normal: Tensor, offset: Tensor, gain: Tensor, sequence: list[Sequence], movement: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the field h with the direct wave, complex64 (K, B, n), and the derivatives of its phase, (K, B, Q P, n).

    The Q parameters of each plane are offset [m], gain and, if planes tilt, two rotation angles of the normal [rad]. A
    change dh of the field changes its phase by Im(dh / h). The wave w of an image at position x, distance d and direction u
    changes by

        dw_k / w_k = j e_k . du - j k dd - dd / d,    dd = u . dx,    du = (dx - u dd) / d,

    where e_k . u is the phase at element k. So the derivatives are sums over images of a vector times dx.

    Args:
        scene: Observed phases.
        normal: Normals of the planes (B, P, 3).
        offset: Offsets of the planes (B, P) [m].
        gain: Gains of the planes (B, P).
        sequence: Sequences of reflections.
        movement: `image_jacobian` of the planes.
    """
    ray = (images(scene, normal, offset, sequence) - scene.receiver).permute(3, 0, 1, 2).float().contiguous()
    strength = image_gain(gain, sequence)[..., None] * visibility(scene, normal, offset, sequence)
    wave = scene.waves(ray, strength)  # (K, B, S, n)
    total = scene.wave(scene.transmitter).T[:, None] + wave.sum(2)
    safe = torch.where(total.abs() < MIN_FIELD, torch.full_like(total, MIN_FIELD), total)
    ratio = wave * safe.reciprocal()[:, :, None]
    length = ray.square().sum(0).sqrt()
    unit = ray / length
    real, imaginary = ratio.real / length, ratio.imag.contiguous()
    along = (scene.element @ unit.flatten(1)).view_as(real) + scene.wavenumber * length
    along = along.mul_(real).addcdiv_(imaginary, length)
    moved = torch.zeros(())
    for e, u, dx in zip(scene.element.T, unit, movement, strict=True):
        moved = moved + _over_images((real * e[:, None, None, None]).addcmul_(along, u, value=-1), dx)
    planes = gain.shape[1]
    safe_gain = torch.where(gain.abs() < MIN_GAIN, torch.full_like(gain, MIN_GAIN), gain)
    scaled = (_reflections(tuple(sequence), planes) / safe_gain[..., None]) @ imaginary
    return total, torch.cat([moved[:, :, :planes], scaled, moved[:, :, planes:]], dim=2)


def _over_images(values: Tensor, weights: Tensor) -> Tensor:
    """Return the sums over images of values (K, B, S, n) with weights (B, R, S, n or 1), (K, B, R, n)."""
    if weights.shape[-1] == 1:
        return weights[..., 0] @ values
    return torch.einsum("kbsn,brsn->kbrn", values, weights)


@lru_cache(maxsize=1024)
def _reflections(sequence: tuple[Sequence, ...], planes: int) -> Tensor:
    """Return how many times each plane reflects each sequence, (P, S)."""
    return torch.tensor([[float(s.count(plane)) for s in sequence] for plane in range(planes)])


def image_jacobian(normal: Tensor, offset: Tensor, transmitter: Tensor, sequence: list[Sequence], tilt: bool) -> Tensor:
    """Return the derivatives of the image positions with respect to offset and, with `tilt`, two tilts of each plane.

    Without tilts they depend on the normals alone.

    Returns:
        Derivatives, float32 (3, B, P or 3 P, S, n or 1).
    """
    (rooms, planes), turns = offset.shape, 2 if tilt else 0
    across = torch.linalg.svd(normal[:, :, None]).Vh[:, :, 1:].permute(3, 2, 0, 1)  # (3, 2, B, P)
    point = transmitter.T[:, None, None].expand(-1, rooms, 1, -1)
    last, found = point.new_zeros(3, rooms, 1, planes, 1 + turns, len(transmitter) if tilt else 1), []
    tree = tree_of(tuple(sequence))
    for parent, plane in tree.levels:
        n, o, point = normal[:, plane].movedim(-1, 0)[..., None], offset[:, plane, None], point[:, :, parent]
        last = mirror(last[:, :, parent], n[..., None, None], o.new_zeros(()))  # as points in planes through the origin
        rows = torch.arange(len(plane))
        last[:, :, rows, plane, 0] += 2 * n
        for q in range(turns):
            turn = across[:, q, :, plane, None]
            last[:, :, rows, plane, 1 + q] -= 2 * ((point * turn).sum(0) * n + ((point * n).sum(0) - o) * turn)
        point = mirror(point, n, o)
        found.append(last)
    return torch.cat(found, dim=2)[:, :, tree.rows].permute(0, 1, 4, 3, 2, 5).flatten(2, 3).float()


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
    normal: Tensor,
    offset: Tensor,
    gain: Tensor,
    sequence: list[Sequence],
    *,
    steps: int = 8,
    tilt: bool = False,
    signs: Tensor | None = None,
    limit: float = 0.03,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return score (B,), normals (B, P, 3), offsets and gains (B, P) after Levenberg-Marquardt steps.

    Args:
        scene: Observed phases.
        normal: Normals of the planes (B, P, 3).
        offset: Offsets of the planes (B, P) [m].
        gain: Gains of the planes (B, P).
        sequence: Sequences of reflections.
        steps: Number of steps.
        tilt: True to rotate the normals, too.
        signs: Fixed signs of the gains (P,). Defaults to free signs.
        limit: Maximum movement [m] or tilt [rad] of a plane in one step.
    """
    damping = torch.full((len(normal),), 1e-2)
    movement = image_jacobian(normal, offset, scene.transmitter, sequence, tilt)
    jacobian = phase_jacobian(scene, normal, offset, gain, sequence, movement)
    score, slope, curve = normal_equations(scene, *jacobian)
    planes = normal.shape[1]
    for _ in range(steps):
        diagonal = curve.diagonal(dim1=1, dim2=2)
        system = curve + torch.diag_embed(damping[:, None] * diagonal + 1e-6 * diagonal.mean(1, keepdim=True) + 1e-9)
        step = -torch.linalg.solve(system, slope.sum(-1, keepdim=True))[..., 0]
        step = step.reshape(len(normal), -1, planes)
        trial_offset = offset + step[:, 0].clamp(-limit, limit).double()
        trial_gain = gain + step[:, 1].clamp(-0.3, 0.3)
        if signs is not None:
            trial_gain = signs * (signs * trial_gain).clamp(0.02, 1.5)
        trial_normal = normal
        if tilt:
            across = torch.linalg.svd(normal[:, :, None]).Vh[:, :, 1:]
            turn = step[:, 2:].clamp(-limit, limit).double()
            trial_normal = normal + (turn.transpose(1, 2)[..., None] * across).sum(2)
            trial_normal = trial_normal / trial_normal.norm(dim=-1, keepdim=True)
            movement = image_jacobian(trial_normal, trial_offset, scene.transmitter, sequence, tilt)
        jacobian = phase_jacobian(scene, trial_normal, trial_offset, trial_gain, sequence, movement)
        after = normal_equations(scene, *jacobian)
        better = after[0] < score
        damping = torch.where(better, damping * 0.3, damping * 6).clamp(1e-6, 1e4)
        offset, gain = (torch.where(better[:, None], a, b) for a, b in ((trial_offset, offset), (trial_gain, gain)))
        normal = torch.where(better[:, None, None], trial_normal, normal)
        score, slope = torch.where(better, after[0], score), torch.where(better[:, None, None], after[1], slope)
        curve = torch.where(better[:, None, None], after[2], curve)
    return score, normal, offset, gain


def offset_covariance(
    scene: PhaseObservations, normal: Tensor, offset: Tensor, gain: Tensor, sequence: list[Sequence]
) -> Tensor:
    """Return the covariance of the offsets (P, P) [m^2] of one room (1, P, 3).

    The sandwich estimator, inverse curvature around the scatter of the positions' gradients, counts unexplained paths as
    noise (P. J. Huber 1967).
    """
    movement = image_jacobian(normal, offset, scene.transmitter, sequence, tilt=False)
    jacobian = phase_jacobian(scene, normal, offset, gain, sequence, movement)
    _, slope, curve = normal_equations(scene, *jacobian, exact=True)
    n, q = len(scene), curve.shape[-1]
    inverse = torch.linalg.pinv(curve[0].double(), hermitian=True)
    scatter = slope[0].double() @ slope[0].double().T * (n / max(n - q, 1))
    planes = normal.shape[1]
    covariance: Tensor = (inverse @ scatter @ inverse)[:planes, :planes]
    return covariance
