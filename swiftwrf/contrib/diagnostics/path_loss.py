"""Check that RSSI decreases with the distance from the receivers, and diagnose the error of frames or units if not.

The score of a frame is the fraction of the variance of RSSI that path-loss models explain. Its upper limit is the fraction
with the receivers' positions fitted to RSSI. An error is named if its fraction clearly exceeds that of the declared frame
and comes close to the limit, because a wrong frame may also be better than the declared one. Errors that the positions
cannot show are not tried, e.g. swaps with an axis along which all positions are equal.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from scipy.optimize import minimize_scalar
from torch import Tensor

from swiftwrf.contrib.diagnostics.frames import best_delay, best_explanations, best_mirror, linear_errors
from swiftwrf.data.rssi import Rssi
from swiftwrf.data.splits import MIN_TRAINING, some_rows
from swiftwrf.rssi.path_loss import PathLoss, fit_path_loss, log_distance

MIN_EXPLAINED = 0.25  # of the variance, by an error that is named
TIE = 0.02  # difference in explained variance of errors that are not distinguished


@dataclass(frozen=True)
class PathLossReport:
    """Result of `check_path_loss`.

    Args:
        explained: Fraction of the variance of RSSI that path-loss models of each receiver explain.
        level_dbm: RSSI at 1 m by one path-loss model of all receivers [dBm].
        exponent: Path-loss exponent of that model.
        explanation: Errors of frames that explain nearly all that can be explained, in words, or an empty text.
        attainable: Fraction with the receivers' positions fitted to RSSI, of the receivers that detected most rows.
        misplaced: True if the declared frame explains far less than that, and no error that was tried explains it.
    """

    explained: float
    level_dbm: float
    exponent: float
    explanation: str = ""
    attainable: float = 1.0
    misplaced: bool = False


def check_path_loss(data: Rssi) -> PathLossReport | None:
    """Compare RSSI with the distances from the receivers, in the declared frame and in others.

    Returns:
        The report, or None if the receivers' positions are unknown.

    Example:
        >>> from swiftwrf import rssi_room
        >>> check_path_loss(rssi_room(n=100)).explanation
        ''
    """
    if not data.located:
        return None
    model = fit_path_loss(log_distance(data.transmitter_position, data.receiver_position), data.rssi_dbm, shared=True)
    data = _by_floor(data)
    report = PathLossReport(_explained(data.transmitter_position, data), float(model.level), float(-model.slope / 10))
    data = data.columns(data.detected.sum(dim=0).argsort(descending=True, stable=True)[:20].tolist())
    walk, rows = data, some_rows(len(data), 2000)
    data, place = data.subset(rows), data.transmitter_position[rows]
    extent = place.amax(dim=0) - place.amin(dim=0)
    varying = [axis for axis, size in zip("xyz", extent.tolist(), strict=True) if size > 1e-6]
    errors = linear_errors("the receivers'", varying)
    found = {meaning: _explained(place @ matrix, data) for meaning, matrix in errors.items()}
    fitted, located = dict[str, float](), data.receiver_position[data.receiver_located]
    for axis in varying:
        meaning, mirrored = best_mirror(place, located, axis, lambda p: _explained(p, data), refined=True)
        fitted[meaning] = _explained(mirrored, data)
    meaning, scaled = best_scale(place, lambda p: _explained(p, data))
    fitted[meaning] = _explained(scaled, data)
    if len(walk) >= 5:  # a delay is at most a fifth of the rows
        meaning, moved = best_delay(walk.transmitter_position, walk.time, lambda p: _explained(p[rows], data))
        fitted[meaning] = _explained(moved[rows], data)
    best = max(found.values(), default=0.0)
    found |= {meaning: value for meaning, value in fitted.items() if value >= best + TIE}
    best, names = best_explanations(found, TIE)
    declared, attainable = _explained(place, data), _attainable(data)
    report = replace(report, attainable=attainable)
    if best >= max(MIN_EXPLAINED, 0.9 * attainable) and best - declared >= 0.1:
        return replace(report, explanation="; or if ".join(names))
    return replace(report, misplaced=attainable >= MIN_EXPLAINED and declared < attainable / 2)


def _by_floor(data: Rssi) -> Rssi:
    """Return RSSI with a column for each receiver and floor, whose level contains the attenuation between the floors."""
    if data.floors is None:
        return data
    number = data.floors.number(data.transmitter_position)[:, None]
    on = [data.rssi_dbm.where(number == floor, torch.nan) for floor in number.unique()]
    names = [f"{name}, {floor}" for floor in range(len(on)) for name in data.receiver_names]
    split = Rssi(
        torch.cat(on, dim=1),
        data.transmitter_position,
        receiver_position=data.receiver_position.repeat(len(on), 1),
        receiver_names=names,
        time=data.time,
    )
    return split.columns((split.detected.sum(dim=0) >= MIN_TRAINING).nonzero()[:, 0].tolist() or [0])


def best_scale(position: Tensor, score: Callable[[Tensor], float]) -> tuple[str, Tensor]:
    """Return in words, and the positions (n, 3) in, the scale of x and y with the highest score, e.g. pixels in a metre."""

    def scaled(exponent: float) -> Tensor:
        return position / torch.tensor([10.0**exponent, 10.0**exponent, 1.0], dtype=position.dtype)

    best = max(torch.linspace(-3, 3, 121).tolist(), key=lambda exponent: score(scaled(exponent)))
    near = best - 0.05, best + 0.05
    best = float(minimize_scalar(lambda e: -score(scaled(float(e))), bounds=near, method="bounded").x)
    return f"x and y of the positions have {10**best:.3g} units in a metre (--scale {10**best:.3g})", scaled(best)


def _explained(position: Tensor, data: Rssi) -> float:
    """Return the fraction of the variance of RSSI that path-loss models explain, if RSSI decreases with distance."""
    distance = log_distance(position, data.receiver_position)
    constant = PathLoss(data.rssi_dbm.nanmean(dim=0), torch.zeros(data.rssi_dbm.shape[1], dtype=torch.float64))
    model = fit_path_loss(distance, data.rssi_dbm)
    residual = data.rssi_dbm - model.where(model.slope < 0, constant)(distance)
    return 1 - float(residual.square().nansum() / (data.rssi_dbm - constant.level).square().nansum().clamp_min(1e-12))


def _attainable(data: Rssi) -> float:
    """Return the fraction of the variance of RSSI that path-loss models explain with fitted positions of the receivers.

    The position of each receiver is that of a grid around the positions with the highest fraction, then of finer grids.
    """
    data = data.subset(some_rows(len(data), 400))
    residual = total = 0.0
    for rssi, detected in zip(data.rssi_dbm.T, data.detected.T, strict=True):
        if int(detected.sum()) < MIN_TRAINING:
            continue
        place, level = data.transmitter_position[detected], rssi[detected] - rssi[detected].mean()
        variance = float(level.square().sum())
        residual += variance - _fitted_receiver(place, level)
        total += variance
    return 1 - residual / total if total else 0.0


def _fitted_receiver(place: Tensor, level: Tensor) -> float:
    """Return the sum of squares of RSSI less its mean (n,) that a path-loss model explains with a fitted position.

    The transmitter is at positions (n, 3).
    """
    low, high = place.amin(dim=0), place.amax(dim=0)
    centre, reach = (low + high) / 2, high - low
    width = float(reach.sort().values[1]) or float(reach.max())
    flat = int(reach.argmin())
    reach[flat] = reach[flat].clamp_min(width / 2)  # receivers may hang above or below all positions
    explained = 0.0
    for _ in range(4):
        axes = [
            centre[axis] + reach[axis] * torch.linspace(-1, 1, 5 if axis == flat else 11, dtype=torch.float64)
            for axis in range(3)
        ]
        receiver = torch.cartesian_prod(*axes)
        distance = torch.cdist(receiver, place).clamp_min(1e-3 * width).log10()
        offset = distance - distance.mean(dim=1, keepdim=True)
        covariance, variance = offset @ level, offset.square().sum(dim=1)
        value = (covariance.square() / variance.clamp_min(1e-12)).where(covariance < 0, 0.0)
        explained = max(explained, float(value.max()))
        centre, reach = receiver[int(value.argmax())], reach / 4
    return explained
