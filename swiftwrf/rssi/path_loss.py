"""Received power without a field: the log-distance path loss of each receiver, learnt together, and its directivity.

rssi = T - 10 gamma log10 d       [dBm]
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from swiftwrf.choices import NotDetected
from swiftwrf.positions import distance
from swiftwrf.rssi.detection import Detection, empty_given
from swiftwrf.runtime.threads import single_thread

MIN_DISTANCE_M = 0.3  # shorter distances count as this one: the model does not hold in the near field


def log_distance(position: Tensor, receiver: Tensor) -> Tensor:
    """Return the log10 of distances [m] from positions to receivers.

    Args:
        position: Positions of the transmitter, (n, 3) [m].
        receiver: Positions of the receivers, (R, 3) [m], nan where unknown.

    Returns:
        float64 (n, R). 0 for a receiver of unknown position, whose path-loss model is then its level.

    Example:
        >>> log_distance(torch.tensor([[0.0, 0.0, 10.0]]), torch.zeros(1, 3))
        tensor([[1.]], dtype=torch.float64)
    """
    known = ~receiver.isnan().any(dim=1)
    metres = distance(position.double(), receiver.double().nan_to_num(0.0))  # nan would be the gradient at a position
    return metres.clamp_min(MIN_DISTANCE_M).log10().where(known, 0.0)


def harmonics(position: Tensor, receiver: Tensor) -> Tensor:
    """Return the spherical harmonics of degree 1 and 2 of the directions from receivers (R, 3) to positions (n, 3).

    Returns:
        (n, R, 8), each of unit mean square over all directions. 0 for a receiver of unknown position (nan).
    """
    known = ~receiver.isnan().any(dim=1)[:, None]
    x, y, z = functional.normalize(position[:, None] - receiver.nan_to_num(0.0), dim=-1).unbind(-1)
    first = [math.sqrt(3) * c for c in (x, y, z)]
    second = [math.sqrt(15) * c for c in (x * y, y * z, z * x, (x * x - y * y) / 2)]
    return torch.stack([*first, *second, math.sqrt(5) / 2 * (3 * z * z - 1)], dim=-1).where(known, 0.0)


class PathLoss(NamedTuple):
    """The log-distance path-loss model, rssi = level + slope log10 d, for each of R receivers or one for all.

    Args:
        level: RSSI at 1 m, float64 (..., R) or (..., 1) [dBm].
        slope: -10 times the path-loss exponent, of the same shape [dB a decade]. A fitted exponent is at least 0.

    Example:
        >>> model = PathLoss(torch.tensor([-40.0]), torch.tensor([-20.0]))
        >>> model(torch.tensor([[0.0], [1.0]]))  # at 1 m and 10 m
        tensor([[-40.],
                [-60.]])
    """

    level: Tensor
    slope: Tensor

    def __call__(self, distance: Tensor) -> Tensor:
        """Return the RSSI (..., n, R) [dBm] at log10 distances (n, R)."""
        return self.level[..., None, :] + self.slope[..., None, :] * distance

    def where(self, usable: Tensor, other: PathLoss) -> PathLoss:
        """Return this model for the usable receivers (R,), and another model for the rest."""
        return PathLoss(self.level.where(usable, other.level), self.slope.where(usable, other.slope))


def fit_path_loss(distance: Tensor, rssi: Tensor, *, shared: bool = False) -> PathLoss:
    """Fit the path-loss model by least squares (Rappaport, "Wireless Communications", 2nd ed., 2002, section 4.9).

    The path-loss exponent is at least 0: a model whose RSSI rises with the distance rises without limit beyond the data.

    Args:
        distance: log10 of the distances [m], (n, R).
        rssi: Measurements (n, R) [dBm], nan where not detected.
        shared: Fit one model for all receivers.

    Returns:
        A model of shape (R,), or (1,) if shared. The slope is 0 for a receiver measured at one distance only. A receiver
        without measurements has nan.

    Example:
        >>> fit_path_loss(torch.tensor([[0.0], [1.0]]), torch.tensor([[-40.0], [-60.0]])).slope
        tensor([-20.])
    """
    detected = ~rssi.isnan()
    along = (0, 1) if shared else (0,)
    count = detected.sum(along)

    def mean(x: Tensor) -> Tensor:
        return x.where(detected, 0.0).sum(along) / count

    middle, centre = mean(rssi), mean(distance)
    offset = distance - centre
    variance = mean(offset.square())
    slope = (mean(offset * (rssi - middle)) / variance).where(variance > 1e-12, 0.0).clamp_max(0.0)
    return PathLoss((middle - slope * centre).reshape(-1), slope.reshape(-1))


class PathLosses(NamedTuple):
    """Path loss of R receivers that is learnt together: level and slope of each are normal about those of all.

    Args:
        each: Model of each receiver, (R,); that of all receivers where a receiver has no measurements.
        shared: Model of all receivers of its kind, of known or of unknown position, (R,).
        root: A factor of the covariance of the receivers' level and slope about the shared ones, with the uncertainty of the
            latter, root @ root^T, (R, 2, 2). Level and slope are independent at some distance.
        variance: Variance of the measurements about the receiver's model, (R,) [dB^2].
        detection: Curve of detection; None if no cell is empty, or if empty cells are ignored.
        floor_db: Attenuation of a floor for each receiver's kind, (R,) [dB]; 0 without floors.
    """

    each: PathLoss
    shared: PathLoss
    root: Tensor
    variance: Tensor
    detection: Detection | None
    floor_db: Tensor

    def columns(self, number: Tensor | slice) -> PathLosses:
        """Return the path loss of the receivers `number`."""
        each, shared = (PathLoss(*(value[number] for value in model)) for model in (self.each, self.shared))
        detection = self.detection and self.detection.columns(number)
        return PathLosses(each, shared, self.root[number], self.variance[number], detection, self.floor_db[number])


@single_thread()
def fit_path_losses(
    position: Tensor,
    receiver: Tensor,
    rssi: Tensor,
    not_detected: NotDetected = "auto",
    shift: Tensor | None = None,
    detection: Detection | None = None,
    crossed: Tensor | None = None,
    *,
    max_unexplained: float = 0.4,
    spread_db: float = 6.0,
) -> PathLosses:
    """Fit the path-loss models of all receivers together, by expectation maximisation.

    Level and slope of a receiver are shrunk to those of all receivers in proportion to how badly its rows determine them (a
    hierarchical model: A. Gelman et al., "Bayesian Data Analysis", 3rd ed., 2013, chapter 5). An empty cell is an upper
    limit of the power, see `Detection`, unless most empty cells of its receiver are where the path loss expects a value.

    Args:
        position: Positions of the transmitter, (n, 3) [m].
        receiver: Positions of the receivers, (R, 3) [m], nan where unknown.
        rssi: Measurements (n, R) [dBm], nan where not detected.
        not_detected: "weak" if empty cells are limits at all receivers, "unknown" if they are ignored.
        shift: Received power less `rssi`, e.g. by floors that were removed, (n, R) [dB]. Defaults to 0.
        detection: Curve of detection. Defaults to an estimate.
        crossed: Number of floors between both ends, float64 (n, R), whose attenuation is fitted, too. Distances are then
            horizontal. Defaults to none.
        max_unexplained: Fraction of the empty cells of a receiver where a value was expected, beyond which "auto" ignores
            them. Not studied.
        spread_db: Prior standard deviation of levels and slopes about those of all receivers [dB]. Not studied.

    Example:
        >>> import swiftwrf
        >>> room = swiftwrf.rssi_room(n=200)
        >>> losses = fit_path_losses(room.transmitter_position, room.receiver_position, room.rssi_dbm)
        >>> -30 < float(losses.each.slope.mean()) < -10
        True
    """
    shift = torch.zeros_like(rssi) if shift is None else shift
    plane = torch.tensor([1.0, 1.0, 1.0 if crossed is None else 0.0], dtype=torch.float64)
    located, distance = ~receiver.isnan().any(dim=1), log_distance(position * plane, receiver * plane)
    floors = torch.zeros_like(rssi) if crossed is None else crossed
    if not_detected == "unknown":
        detection = None
    elif detection is None:
        detection = Detection.estimate(position, rssi + shift)
    same, cells = _summed(position, rssi, floors, shift)
    distance, floors, shift = distance[same], floors[same], shift[same]
    extent = float((position.amax(dim=0) - position.amin(dim=0)).max()) or 1.0
    n_cells = len((position / (extent / 10)).round().unique(dim=0))
    repeats = max(1.0, len(rssi) / n_cells)  # rows near each other have like errors

    def fit(curve: Detection | None) -> tuple[PathLosses, Tensor]:
        mean, none = rssi.nanmean().repeat(len(receiver)), torch.zeros(len(receiver), dtype=torch.float64)
        # a kind of receivers that measured nothing has the mean of the others
        fields = {"each_level": mean, "shared_level": mean.clone(), "variance": none + spread_db**2}
        fields |= {name: none.clone() for name in ("each_slope", "shared_slope", "unexplained", "floor_db")}
        fields["root"] = spread_db * torch.eye(2, dtype=torch.float64).repeat(len(receiver), 1, 1)
        for kind in (located, ~located):
            if bool(rssi[:, kind].isfinite().any()):
                of_kind = curve and curve.columns(kind)
                variance = rssi[:, kind][~rssi[:, kind].isnan()].var(correction=0).clamp_min(1e-6)
                known = distance[:, kind], floors[:, kind], cells[..., kind], shift[:, kind]
                for name, value in _maximise(*known, variance, of_kind, repeats, spread_db).items():
                    fields[name][kind] = value
        each, shared = (PathLoss(fields[f"{of}_level"], fields[f"{of}_slope"] * located) for of in ("each", "shared"))
        fields["root"][~located, :, 1] = 0.0
        losses = PathLosses(each, shared, fields["root"], fields["variance"], curve, fields["floor_db"])
        return losses, fields["unexplained"]

    losses, unexplained = fit(detection)
    if not_detected == "auto" and detection is not None:
        explained = detection.is_limit & (unexplained <= max_unexplained)
        if bool((explained != detection.is_limit).any()):
            losses, _ = fit(replace(detection, is_limit=explained))
    return losses


def _summed(position: Tensor, rssi: Tensor, *others: Tensor) -> tuple[Tensor, Tensor]:
    """Return one row of each group of rows at one position that are equal in all others (n, R), and sums over the groups.

    Sums (4, m, R) are the numbers of empty cells and of values, the sum of the values, and that of their squares.
    """
    number = position.unique(dim=0, return_inverse=True)[1]
    order = torch.arange(len(number))

    def first() -> Tensor:
        return order.new_zeros(int(number.max()) + 1).scatter_reduce(0, number, order, "amin", include_self=False)

    for values in others:
        if not torch.equal(values[first()][number], values):
            number = torch.cat([number[:, None], values], dim=1).unique(dim=0, return_inverse=True)[1]
    value, same = rssi.nan_to_num(), first()
    parts = rssi.isnan(), ~rssi.isnan(), value, value.square()
    return same, torch.stack(
        [value.new_zeros(len(same), rssi.shape[1]).index_add(0, number, x.to(value)) for x in parts]
    )


def _maximise(
    distance: Tensor,
    crossed: Tensor,
    cells: Tensor,
    shift: Tensor,
    variance: Tensor,
    detection: Detection | None,
    repeats: float,
    spread_db: float,
    *,
    slope_prior: tuple[float, float] = (-30.0, 15.0),
    spread_worth: float = 4.0,
    floor_std_db: float = 20.0,
    rows_worth: float = 10.0,
) -> dict[str, Tensor]:
    """Fit the path loss of receivers of one kind, at log10 distances (n, R) [m]; see `fit_path_losses`.

    RSSI of receiver r in row i is y = f . (m + d_r) + noise of variance v_r, with f = (1, distance less its mean, -floors).
    The deviations d_r are normal with the diagonal covariance D, the coefficients m of all receivers have the prior mean p
    and precision P. With rows of weights w, A_r = sum f w f^T / v_r and h_r = sum f w y / v_r, a round of expectation
    maximisation is:

    1. m = (P + sum (I + A_r D)^-1 A_r)^-1 (P p + sum (I + A_r D)^-1 h_r).
    2. d_r = C_r (h_r - A_r m), with C_r = (D^-1 + A_r)^-1. If the slope is above 0, d_r is that given a slope of 0.
    3. D = mean of d_r d_r^T + C_r, and v_r = mean of w ((y - f . (m + d_r))^2 + variance of y), both shrunk.
    4. Empty cells have the expectations of y and w, see `_expected`, and receivers fractions of random misses.

    Args:
        distance: log10 distances (n, R) [m].
        crossed: Number of floors between both ends, (n, R).
        cells: Sums over the rows of equal distances, see `_summed`, (4, n, R).
        shift: Received power less RSSI, (n, R) [dB].
        variance: Variance of all values [dB^2].
        detection: Curve of detection; None if empty cells are ignored.
        repeats: Number of rows that count as one, since rows near each other have like errors.
        spread_db: See `fit_path_losses`.
        slope_prior: Mean and standard deviation of the slope of all receivers [dB a decade]: path-loss exponents of 1.5 to
            4.5 (T. S. Rappaport, "Wireless Communications", 2nd ed., 2002, table 4.2).
        spread_worth: Number of receivers that the prior `spread_db` counts as. Not studied.
        floor_std_db: Prior standard deviation of the attenuation of a floor about 0 [dB]: any that is measured. Not studied.
        rows_worth: Prior rows: a receiver with 10 rows weighs its own variance and the pooled one equally, and likewise the
            fractions of misses. Not studied.

    Returns:
        The fields of `PathLosses` by name, and the fraction `unexplained` (R,) of empty cells where a value was expected.
    """
    empty, count, total, squares = cells
    n_receivers, varies = distance.shape[1], bool(((distance - distance[0]).abs() > 0).any())
    middle = (count * distance).sum() / count.sum()
    feature = torch.stack([torch.ones_like(distance), distance - middle, -crossed])
    spread = torch.tensor([spread_db, spread_db, 1e-3]).double().square()  # diagonal of D; floors are alike
    prior = torch.tensor([1e-6, slope_prior[1] ** -2, floor_std_db**-2], dtype=torch.float64)  # diagonal of P
    prior_mean = torch.tensor([0.0, slope_prior[0], 0.0], dtype=torch.float64)

    weak, weak_value, weak_variance = (torch.zeros_like(total) for _ in range(3))
    variance = variance.expand(n_receivers)
    missed = torch.zeros(n_receivers).double() if detection is None else detection.missed
    unexplained, last = missed, None
    limited = torch.zeros_like(empty) if detection is None else empty * detection.is_limit
    for _ in range(40):
        believed = limited * weak
        weight, precision_of_row = count + believed, 1 / (variance * repeats)
        products = [[(weight * one * other).sum(dim=0) for other in feature] for one in feature]
        normal = torch.stack([torch.stack(row) for row in products]).permute(2, 0, 1) * precision_of_row[:, None, None]
        right = ((total + believed * weak_value) * feature).sum(dim=1).T * precision_of_row[:, None]
        shrink = torch.linalg.inv(torch.eye(3, dtype=torch.float64) + normal @ spread.diag())
        precision = prior.diag() + (shrink @ normal).sum(dim=0)
        shared = torch.linalg.solve(precision, prior * prior_mean + (shrink @ right[..., None]).sum(dim=0)[:, 0])
        posterior = torch.linalg.inv(spread.reciprocal().diag() + normal)
        deviation = (posterior @ (right - normal @ shared)[..., None])[..., 0]
        # received power does not rise with the distance; the level follows the slope
        excess = (shared[1] + deviation[:, 1]).clamp_min(0)
        deviation = deviation - posterior[:, :, 1] / posterior[:, 1:2, 1] * excess[:, None]
        moments = (deviation.square() + posterior.diagonal(dim1=1, dim2=2))[:, :2].sum(dim=0)
        spread[:2] = (moments + spread_worth * spread_db**2) / (n_receivers + spread_worth)
        each = shared + deviation
        mean = (feature * each.T[:, None]).sum(dim=0)
        of_values = squares - 2 * mean * total + count * mean.square()
        of_empty = believed * ((weak_value - mean).square() + weak_variance)
        variance = _shrunk((of_values + of_empty).sum(dim=0), weight.sum(dim=0), rows_worth).clamp_min(1e-6)
        if last is not None and float((each - last).abs().max()) < 0.01:
            break
        last = each
        if detection is not None and bool(limited.any()):
            limit = detection.limit - shift
            weak_value, weak, weak_variance = _expected(mean, variance, limit, detection.width, unexplained)
            if varies:  # without distances no power is expected anywhere; weak packets are missed at random, too
                others = (limited * (1 - weak)).sum(dim=0)
                unexplained = missed.maximum(_shrunk(others, (count + limited).sum(dim=0), rows_worth))
    each_level, shared_level = each[:, 0] - each[:, 1] * middle, shared[0] - shared[1] * middle
    level_std, slope_std = (spread + precision.inverse().diagonal())[:2].sqrt().tolist()
    root = torch.tensor([[level_std, -float(middle) * slope_std], [0.0, slope_std]], dtype=torch.float64)
    return {
        "each_level": each_level,
        "each_slope": each[:, 1],
        "shared_level": shared_level.expand(n_receivers),
        "shared_slope": shared[1].expand(n_receivers),
        "root": root.expand(n_receivers, 2, 2),
        "floor_db": shared[2].clamp_min(0).expand(n_receivers),
        "variance": variance,
        "unexplained": unexplained,
    }


def _shrunk(total: Tensor, count: Tensor, prior_count: float) -> Tensor:
    """Return total / count (R,) of each receiver, shrunk to that of all by a number of prior rows."""
    return (total + prior_count * total.sum() / count.sum()) / (count + prior_count)


def _expected(
    mean: Tensor, variance: Tensor, limit: Tensor, width: float, missed: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Return expectations of the value in empty cells, of its weight, and the variance of the value, each (n, R).

    The weight is the probability that the cell is empty because of a weak signal. Given that, the value is normal of `mean`
    (n, R) and `variance` (R,) below an uncertain limit: a truncated normal (C. E. Rasmussen and C. K. I. Williams, "Gaussian
    Processes for Machine Learning", 2006, section 3.9).
    """
    std = (variance + width**2).sqrt()
    z = (limit - mean) / std
    derivative, weak = empty_given(z, missed)
    hazard = (derivative / weak.clamp_min(1e-12)).clamp_max(40)
    remaining = (1 - variance / std.square() * hazard * (z + hazard)).clamp(0, 1)
    return mean - variance / std * hazard, weak, variance * remaining
