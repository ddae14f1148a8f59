"""Refinement of planes and gains to the nearest minimum of the score, of many rooms at once."""

from __future__ import annotations

import torch
from torch import Tensor

from swiftwrf.models.geometry.images import (
    PhaseObservations,
    Sequence,
    image_gain,
    images,
    mirror,
    spherical,
    tree_of,
    visibility,
)


def derivatives(
    scene: PhaseObservations, normal: Tensor, offset: Tensor, gain: Tensor, sequence: list[Sequence], tilt: bool
) -> tuple[Tensor, Tensor]:
    """Return the field with the direct wave, (B, n, K), and its derivatives (B, Q, P, n, K).

    The Q parameters of each plane are offset [m], gain and, with `tilt`, two rotation angles of its normal [rad].

    Args:
        sequence: All `sequences` up to an order.
    """
    source = images(scene, normal, offset, sequence)
    ray = (source - scene.receiver).float()
    length = ray.norm(dim=-1, keepdim=True)
    unit = ray / length
    phase = unit @ scene.element.T - scene.wavenumber * length
    strength = image_gain(gain, sequence)[..., None] * visibility(scene, normal, offset, sequence)
    wave = spherical(phase, length) * strength[..., None]
    total = scene.wave(scene.transmitter) + wave.sum(1)
    change = torch.zeros(len(normal), 4 if tilt else 2, normal.shape[1], *total.shape[1:], dtype=total.dtype)
    safe = torch.where(gain.abs() < 1e-6, torch.full_like(gain, 1e-6), gain)
    for owner, steps in tangents(normal, offset, scene.transmitter, sequence, tilt):
        part, ray, far = (t[:, -len(owner) :] for t in (wave, unit, length))  # the longest sequences are the last ones
        change[:, 1].index_add_(1, owner, part / safe[:, owner, None, None])
        for q, step in zip([0, 2, 3] if tilt else [0], steps, strict=True):
            along = (ray * step.float()).sum(-1, keepdim=True)
            turned = (step.float() - ray * along) / far
            advance = turned @ scene.element.T - scene.wavenumber * along
            change[:, q].index_add_(1, owner, part * torch.complex((-along / far).expand_as(advance), advance))
    return total, change


def tangents(
    normal: Tensor, offset: Tensor, transmitter: Tensor, sequence: list[Sequence], tilt: bool
) -> list[tuple[Tensor, list[Tensor]]]:
    """Return the derivatives of the image positions with respect to offset and tilts of the planes that make them.

    Returns:
        One entry for the first plane of the sequences, the second plane of those that have one, and so on: the number of the
        plane (R,), and for each of the 1 or 3 parameters the derivative (B, R, n or 1, 3). The R sequences are the last ones
        of `sequence`.
    """
    across = torch.linalg.svd(normal[:, :, None]).Vh[:, :, 1:].unbind(2) if tilt else ()
    here = offset.new_zeros(())  # displacements are mirrored as points are in planes through the origin
    point = transmitter.expand(len(normal), 1, -1, -1)
    last: list[tuple[Tensor, list[Tensor]]] = []
    found: list[list[tuple[Tensor, list[Tensor]]]] = []
    for parent, plane in tree_of(tuple(sequence)).levels:
        n, o, point = normal[:, plane, None], offset[:, plane, None, None], point[:, parent]
        distance = (point * n).sum(-1, keepdim=True) - o
        last = [(owner[parent], [mirror(step[:, parent], n, here) for step in steps]) for owner, steps in last]
        turns = [tilted[:, plane, None] for tilted in across]
        own = [-2 * (point * turn).sum(-1, keepdim=True) * n - 2 * distance * turn for turn in turns]
        own = [2 * n.expand_as(point), *own]
        last, point = [*last, (plane, own)], point - 2 * distance * n
        found.append(last)
    whole = []
    for member in range(len(found)):
        owners, steps = zip(*[level[member] for level in found[member:]], strict=True)
        whole.append((torch.cat(owners), [torch.cat(q, dim=1) for q in zip(*steps, strict=True)]))
    return whole


def normal_equations(
    scene: PhaseObservations, total: Tensor, change: Tensor, exact: bool = False
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the score (B,), half its gradient at each position (B, Q, n) and its Gauss-Newton matrix (B, Q, Q), times n.

    Only phases count: a change dh of the field h changes its phase by Im(dh / h), and one phase of each position is free.
    With `exact`, the matrix includes the phase errors, as standard deviations require; it may then be singular.
    """
    change = change.flatten(1, 2)
    safe = torch.where(total.abs() < 1e-9, torch.full_like(total, 1e-9), total)
    match = torch.einsum("bnk,nfk->bnfk", safe.sgn(), scene.channel.conj())
    sum_ = match.sum(-1)
    better = sum_.abs().argmax(-1)
    pick = better[..., None, None].expand(*better.shape, 1, match.shape[-1])
    chosen = match.gather(2, pick)[:, :, 0]
    mean = chosen.mean(-1)
    score = 1 - mean.abs().square().mean(-1)
    error = chosen * torch.polar(torch.ones_like(mean.abs()), -mean.angle())[..., None]
    inverse = (1 / safe)[:, None]
    turn = (change.real * inverse.imag + change.imag * inverse.real).clamp(-1e3, 1e3)
    turn = turn - turn.mean(-1, keepdim=True)
    weight = mean.abs()[:, None, :, None] / match.shape[-1]
    slope = (turn * weight * error.imag[:, None]).sum(-1)
    curve = torch.einsum("bqnk,brnk->bqr", turn * weight * (error.real[:, None] if exact else 1), turn)
    return score, slope, curve


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
        signs: Fixed signs of the gains (P,). Defaults to free signs.
        limit: Maximum movement [m] or tilt [rad] of a plane in one step.
    """
    damping = torch.full((len(normal),), 1e-2)
    total, change = derivatives(scene, normal, offset, gain, sequence, tilt)
    score, slope, curve = normal_equations(scene, total, change)
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
        total, change = derivatives(scene, trial_normal, trial_offset, trial_gain, sequence, tilt)
        after = normal_equations(scene, total, change)
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
    total, change = derivatives(scene, normal, offset, gain, sequence, tilt=False)
    _, slope, curve = normal_equations(scene, total, change, exact=True)
    n, q = len(scene), curve.shape[-1]
    inverse = torch.linalg.pinv(curve[0].double(), hermitian=True)
    scatter = slope[0].double() @ slope[0].double().T * (n / max(n - q, 1))
    planes = normal.shape[1]
    covariance: Tensor = (inverse @ scatter @ inverse)[:planes, :planes]
    return covariance
