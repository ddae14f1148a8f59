"""Maximum a posteriori of some receivers in closed form, and what it would have said of rows that are held out.

The motion c of a receiver's responses is a Gaussian process; level, slope and directivity have Gaussian priors; the error
is Gaussian in the middle and linear in the tails (P. J. Huber, 1964). With the head taken along its tangent, that is
weighted least squares, solved again until weights and tangent stay (Gauss-Newton).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from swiftwrf.errors import FitError
from swiftwrf.gp import Kernel, held_out_errors
from swiftwrf.rssi.config import RssiConfig
from swiftwrf.rssi.head import Head, Table
from swiftwrf.rssi.law import Law, harmonics, log_distance
from swiftwrf.runtime.threads import side_by_side, single_thread

LAW_DB = 30.0  # prior deviation of level and slope from their least squares: as good as none
DIRECTIVITY_DB = 2.0  # prior deviation of each harmonic of a receiver's antenna and surroundings
ITERATIONS, SETTLED = 30, 3e-3  # of the weights, each in (0, 1]
SHRINKS = 0.9  # share of the last change of the motion beyond which steps go to and fro
STILL_DB = 0.1  # mean change of the motion that is none


@dataclass(frozen=True)
class Group:
    """What is known of some receivers before their fit.

    Args:
        receiver: positions (R, 3) [m].
        position: of the sites (n, 3) [m].
        local: the same less their centre, where rounding is least.
        rssi: mean at each site (n, R) [dBm], nan where not heard.
        count: measurements behind each mean, (n, R).
        fold: number of the fold of each site, (n,).
        law: of each receiver.
        field_db, noise_db: prior deviation of the motion and of one measurement, (R,) [dB].
    """

    receiver: Tensor
    position: Tensor
    local: Tensor
    rssi: Tensor
    count: Tensor
    fold: Tensor
    law: Law
    field_db: Tensor
    noise_db: Tensor


class Fitted(NamedTuple):
    """What a fit has found of R receivers."""

    level: Tensor  # (R,) [dBm]
    slope: Tensor  # (R,) [dB a decade]
    directivity: Tensor  # (R, 8) [dB]
    coefficient: Tensor  # (n, R): the motion is the kernel to the sites times these
    drawn: Tensor  # (R, 2, 2, directions): what the head draws
    held_out: Tensor  # (n, R) [dBm] what was predicted where it was held out, nan elsewhere


def solve(group: Group, kernel: Kernel, config: RssiConfig, n_primitives: int, device: torch.device) -> Fitted:
    """Fits the receivers of a group.

    Raises:
        FitError: a system that cannot be solved, as positions or values are not of this world.
    """
    with single_thread():  # in several, sums are added up in another order
        head = Head(len(group.receiver), n_primitives, config.seed).requires_grad_(False)
        drawn = head.draw()
        local = group.local.to(device)
        covariance = kernel(local, local)
        feature = torch.cat(
            [
                LAW_DB * torch.ones_like(group.rssi)[..., None],
                LAW_DB * log_distance(group.position, group.receiver)[..., None],
                DIRECTIVITY_DB * harmonics(group.position, group.receiver),
            ],
            dim=-1,
        ).to(device)
        left = (group.rssi - group.law(log_distance(group.position, group.receiver))).to(device)
    coefficient, error = torch.zeros_like(left), torch.full_like(left, torch.nan)
    linear = torch.zeros(left.shape[1], feature.shape[2], dtype=torch.float64)

    def fit(r: int) -> None:  # the others' columns are theirs
        heard = (~left[:, r].isnan()).nonzero()[:, 0]
        if not len(heard):
            return
        one = _Receiver(
            left=left[heard, r],
            feature=feature[heard, r],
            covariance=float(group.field_db[r]) ** 2 * covariance[heard][:, heard],
            noise_db=float(group.noise_db[r]) / group.count.to(device)[heard, r].sqrt(),
            table=Table(drawn[r : r + 1].to(device)),
        )
        try:
            dual, slope = one.solve(config.huber)
            error[heard, r] = one.held_out(dual, group.fold.to(device)[heard])
        except torch.linalg.LinAlgError as reason:  # type: ignore[attr-defined]
            raise FitError(
                f"the RSSI fit of receiver {r} of its group broke ({reason}); are its values sane?"
            ) from None
        coefficient[heard, r] = float(group.field_db[r]) ** 2 * slope * dual
        linear[r] = (dual @ feature[heard, r]).cpu()

    side_by_side(fit, range(left.shape[1]))
    return Fitted(
        level=group.law.level + LAW_DB * linear[:, 0],
        slope=group.law.slope + LAW_DB * linear[:, 1],
        directivity=DIRECTIVITY_DB * linear[:, 2:],
        coefficient=coefficient.cpu(),
        drawn=drawn,
        held_out=group.rssi - error.cpu(),
    )


@dataclass
class _Receiver:
    """The least squares of one receiver over the n sites where it was heard: what the law leaves = feature b + head(c) +
    noise, b standard normal, c with the given covariance (n, n)."""

    left: Tensor
    feature: Tensor
    covariance: Tensor
    noise_db: Tensor
    table: Table

    def solve(self, huber: float) -> tuple[Tensor, Tensor]:
        """The dual variables (n,) - the inverse of the whole covariance times the data - and the tangent's slope (n,)."""
        zero = self.table(torch.zeros(1, 1, dtype=torch.float64, device=self.left.device))[0]
        weight, motion = torch.ones_like(self.left), torch.zeros_like(self.left)
        step, last = 1.0, math.inf
        for _ in range(ITERATIONS):
            head, slope = (x[:, 0] for x in self.table(motion[:, None]))
            target = self.left - (head - zero[0, 0]) + slope * motion
            variance = self.noise_db.square() / weight
            whole = (slope[:, None] * self.covariance).mul_(slope).addmm_(self.feature, self.feature.T)
            whole.diagonal().add_(variance)
            self.factor = torch.linalg.cholesky(whole)
            dual = torch.cholesky_solve(target[:, None], self.factor)[:, 0]
            change = self.covariance @ (slope * dual) - motion
            moved = float(change.abs().mean())
            if moved > SHRINKS * last:  # jumps to and fro where the head bends
                step /= 2
            motion, last = motion + step * change, moved
            before, error = weight, (variance * dual).abs()  # of the data about the tangent
            weight = (huber * self.noise_db / error.clamp_min(1e-12)).clamp_max(1)
            if float((weight - before).abs().max()) < SETTLED and (step == 1 or moved < STILL_DB):
                break
        return dual, slope

    def held_out(self, dual: Tensor, fold: Tensor) -> Tensor:
        """Error of what all other folds say of each site, (n,)."""
        precision = torch.cholesky_inverse(self.factor)
        error = torch.empty_like(dual)
        for number in fold.unique():
            part = (fold == number).nonzero()[:, 0]
            error[part] = held_out_errors(precision, dual, part)
        return error
