"""The regression of one receiver: a MAP estimate by iteratively reweighted least squares.

The latent field c of its head is a Gaussian process; level, slope and directivity have Gaussian priors; the error is
Gaussian in the middle and linear in the tails (P. J. Huber, 1964). With the head replaced by its tangent this is weighted
least squares, solved again until weights and tangent converge (Gauss-Newton). An empty cell is an upper limit, by
expectation propagation.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from swiftwrf.data.splits import each_fold
from swiftwrf.errors import FitError
from swiftwrf.gp import held_out_errors
from swiftwrf.rssi.config import RssiConfig
from swiftwrf.rssi.detection import empty_given
from swiftwrf.rssi.head import Heads
from swiftwrf.rssi.path_loss import log_distance
from swiftwrf.rssi.posterior import covariance_of, huber_weight, regressors
from swiftwrf.rssi.training import RssiTraining
from swiftwrf.runtime.threads import single_thread


@single_thread()  # several threads add up sums in another order
def fit_receiver(number: int, data: RssiTraining, config: RssiConfig, device: torch.device) -> dict[str, Tensor]:
    """Fit one receiver by its number.

    Returns:
        Tensors by name.

        - dual (n,), tangent (n,), variance (n,), prior (2,) and root (2, 2); see `RssiPosterior`. If RSSI would rise with
          the distance, slope and its standard deviation are 0.
        - covariance (2, 2) of level and slope, given the rows.
        - held_out (f, n), predictions of all bins by the others in each of the `folds` [dBm], nan without a bin in the fit.

    Raises:
        FitError: A system that cannot be solved, for positions or values beyond any measurement.
    """
    rssi, limit, loss = data.rssi[:, number], data.limit[:, number], data.path_loss
    prior, root = torch.stack([loss.shared.level[number], loss.shared.slope[number]]), loss.root[number].clone()
    receiver, field_db = data.receiver[number, None], float(data.field_db[number])
    distance = log_distance(data.position, receiver)[:, 0]
    used = torch.cat([(~rssi.isnan() & limit.isnan()).nonzero()[:, 0], (~limit.isnan()).nonzero()[:, 0]])
    dual, tangent, variance = (torch.zeros_like(rssi) for _ in range(3))
    covariance, held_out = root @ root.T, rssi.new_full((len(data.folds), len(rssi)), torch.nan)
    if len(used):
        at, weak = data.position[used].to(device), limit[used].isnan().logical_not()
        feature = regressors(data.position[used], receiver, root[None])[0]
        noise_db = (data.noise_db[number] / data.count[used, number].clamp_min(1).sqrt()).to(device)
        detection = loss.detection
        censored = None if detection is None or not weak.any() else (detection.width, float(detection.missed[number]))
        across = field_db**2 * data.kernel(data.position.to(device), at)

        def solved() -> tuple[Tensor, ...]:
            value = (rssi.where(limit.isnan(), limit) - prior[0] - prior[1] * distance)[used].to(device)
            system = value, weak.to(device), feature.to(device), across[used], noise_db
            return solve(*system, data.heads, config.huber, censored)

        try:
            *solution, factor = solved()
            trend = feature[:, :2].to(device)
            remaining = torch.eye(2).double() - (trend.T @ torch.cholesky_solve(trend, factor)).cpu()
            covariance = root @ remaining @ root.T  # a slope that is held at 0 is as uncertain as a free one
            if float(prior[1] + root[1, 1] * (solution[0].cpu() @ feature[:, 1])) > 0:
                # at the distance where level and slope are independent
                prior = torch.stack([prior[0] - prior[1] * root[0, 1] / root[1, 1], torch.zeros(()).double()])
                root[:, 1], feature[:, 1] = 0.0, 0.0
                *solution, factor = solved()
            precision, feature = torch.cholesky_inverse(factor), regressors(data.position, receiver, root[None])[0]
            system = used, across, feature.to(device), precision
            others = [held_out_means(fold, *system, solution, data.heads).cpu() for fold in data.folds]
            held_out = prior[0] + prior[1] * distance + torch.stack(others)
        except torch.linalg.LinAlgError as reason:  # type: ignore[attr-defined]
            raise FitError(
                f"the RSSI fit of receiver {data.receiver_names[number]!r} broke ({reason}); are its values sane?"
            ) from None
        dual[used], tangent[used], variance[used], _ = (x.cpu() for x in solution)
    rows = {"dual": dual, "tangent": field_db * tangent, "variance": variance, "held_out": held_out}
    return rows | {"prior": prior, "root": root, "covariance": covariance}


def held_out_means(
    fold: Tensor,
    used: Tensor,
    across: Tensor,
    feature: Tensor,
    precision: Tensor,
    solution: Sequence[Tensor],
    heads: Heads,
) -> Tensor:
    """Return how the bins of all other folds predict RSSI less the prior path loss, (n,) [dB].

    Args:
        fold: Fold of each bin, (n,).
        used: Numbers of the u bins of the fit.
        across: Covariance of the latent field between all bins and those of the fit, (n, u) [dB^2].
        feature: Regressors of all bins, (n, k).
        precision: Inverse covariance of the bins of the fit, (u, u).
        solution: Dual coefficients and slopes of the tangent, each (u,), of `solve`.
        heads: Head of the receiver.
    """
    (dual, slope, *_), predicted = solution, torch.empty_like(across[:, 0])
    for out, _ in each_fold(fold):
        part = torch.isin(used, out).nonzero()[:, 0].to(dual.device)
        others = dual - precision[:, part] @ held_out_errors(precision, dual[:, None], part)[:, 0]
        latent = across[out] @ (slope * others)
        predicted[out] = feature[out] @ (feature[used].T @ others) + heads(latent[:, None])[0][:, 0]
    return predicted


def solve(
    value: Tensor,
    weak: Tensor,
    feature: Tensor,
    covariance: Tensor,
    noise_db: Tensor,
    heads: Heads,
    huber: float,
    censored: tuple[float, float] | None = None,
    *,
    damping: float = 0.7,
    acceleration: float = 1.4,
    weight_tolerance: float = 1e-2,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Fit value = F b + head(c) + noise in n bins, with b standard normal and c of covariance K.

    Three steps alternate until they change nothing.

    1. Gauss-Newton. The head is replaced by its tangent at c, which has the slope s. Then value + s c - head(c) has the
       covariance S = s K s^T + F F^T + V, the dual coefficients are a = S^-1 (value + s c - head(c)), and c = K s a.
    2. Huber's loss. The residuals are V a. A value has the weight w = min(1, huber noise_db / |V a|) and V = noise_db^2 / w.
    3. Expectation propagation (C. E. Rasmussen and C. K. I. Williams, "Gaussian Processes for Machine Learning", 2006,
       section 3.6). An upper limit enters as a value t and a variance V that match the moments of its likelihood. All other
       bins predict it with the mean t - a / Q and the variance 1 / Q - V, where Q is its diagonal element of S^-1.

    Args:
        value: RSSI, or its upper limit, less the prior mean, (n,) [dB].
        weak: Whether a value is an upper limit, bool (n,), true at the last values alone.
        feature: Regressors F, (n, k).
        covariance: Covariance K of the latent field c, (n, n) [dB^2].
        noise_db: Standard deviation of the noise, (n,) [dB].
        heads: Head of the receiver.
        huber: See `RssiConfig`.
        censored: Width of the limits [dB] and fraction of random misses. None without limits.
        damping: Fraction of each change of an upper limit that is applied, below 1 so that neighbouring limits converge.
            Not studied.
        acceleration: Power of the factor by which a weight changes, above 1 because weights approach their limits from one
            side. With 1.4 the systems of ts-tut2 and of a simulated survey need 20 % fewer steps.
        weight_tolerance: Largest change of a weight, from 0 to 1, at the end. With 0.003 held-out errors of ts-tut2,
            dae-2025 and ts-ujib1 differ by less than 0.0002 dB.

    Returns:
        Dual coefficients a (n,); the slope s of the tangent (n,); the variance V (n,) [dB^2]; the values, with those in
        place of limits, (n,) [dB]; the Cholesky factor of S, (n, n).
    """
    weight, latent, noise = torch.ones_like(value), torch.zeros_like(value), noise_db.square()
    limit, prior_variance = value[weak], (covariance.diagonal() + feature.square().sum(dim=1))[weak]
    n_known, vague = len(value) - len(limit), 1e6  # variance of a limit without effect [dB^2]
    step, last_change = torch.ones_like(value), torch.zeros_like(value)

    def moments(mean: Tensor, variance: Tensor) -> Tensor:
        return variance.new_zeros(2, 0) if censored is None else _site(mean, variance, limit, noise[weak], censored)

    def replaced(site: Tensor) -> Tensor:
        return value.masked_scatter(weak, (site[1] / site[0].clamp_min(1e-9)).where(site[0] > 1 / vague, 0.0))

    site = moments(torch.zeros_like(limit), prior_variance)  # precision, and precision times value, in place of limits
    for _ in range(30):
        head, slope = (x[:, 0] for x in heads(latent[:, None]))
        variance = (noise / weight).masked_scatter(weak, 1 / site[0].clamp_min(1 / vague))
        total = covariance_of(covariance, (slope, feature), (slope, feature))
        total.diagonal().add_(variance)
        factor, target = torch.linalg.cholesky(total), replaced(site)
        dual = torch.cholesky_solve((target + slope * latent - head)[:, None], factor)[:, 0]
        change = covariance @ (slope * dual) - latent
        # a change of the other sign: this latent value oscillates, because its head bends
        step = (step / 2).where(change * last_change < 0, (1.5 * step).clamp_max(1))
        latent, last_change = latent + step * change, change
        following = huber_weight(variance * dual, noise_db, huber).masked_fill(weak, 1.0)
        settled = float((following - weight).abs().max()) < weight_tolerance
        weight = (weight * (following / weight) ** acceleration).clamp_max(1)
        if censored is not None:
            # the last rows of S^-1 follow from those of its factor alone
            diagonal = torch.cholesky_inverse(factor[n_known:, n_known:]).diagonal()
            others = target[weak] - dual[weak] / diagonal, (1 / diagonal - variance[weak]).clamp_min(1e-6)
            site = site + damping * (moments(*others) - site)
            settled &= float(((replaced(site) - target)[weak] * site[0].sqrt()).abs().mean()) < 0.02
        if settled and float(change.abs().mean()) < 0.1:
            break
    return dual, slope, variance, target, factor


def _site(mean: Tensor, variance: Tensor, limit: Tensor, noise: Tensor, censored: tuple[float, float]) -> Tensor:
    """Return precision and precision times value, (2, n), that match the likelihood of empty cells; 0 if not concave.

    The log-likelihood has the derivatives d and e < 0 by the mean m of a power of variance v. The precision is
    -e / (1 + e v). Precision times value is (d - m e) / (1 + e v).

    Args:
        mean: Mean of each power by all others (n,) [dB].
        variance: Its variance without noise (n,) [dB^2].
        limit: Upper limits (n,) [dB].
        noise: Variance of the noise (n,) [dB^2].
        censored: Width of the limits [dB] and fraction of random misses.
    """
    width, missed = censored
    std = (variance + noise + width**2).sqrt()
    z = (limit - mean) / std
    first = -empty_given(z, torch.tensor(missed, dtype=torch.float64, device=z.device))[0] / std
    second = z * first / std - first.square()
    remaining = 1 + second * variance
    concave = (second < 0) & (remaining > 1e-3)
    return (torch.stack([-second, first - mean * second]) / remaining).where(concave, 0.0)
