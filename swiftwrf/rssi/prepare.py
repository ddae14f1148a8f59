"""What is known before any receiver is fitted: sites, folds, laws and the kernel that all receivers share."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from swiftwrf.data.rssi import Rssi
from swiftwrf.data.splits import MIN_TRAINING, folds
from swiftwrf.errors import InputError
from swiftwrf.gp import Kernel
from swiftwrf.rssi.choose import choose_kernel
from swiftwrf.rssi.config import RssiConfig
from swiftwrf.rssi.law import Law, fit_law, log_distance
from swiftwrf.rssi.sites import Sites, gather
from swiftwrf.rssi.solve import Group
from swiftwrf.runtime.threads import single_thread

LOWEST = -100.0  # [dBm] of the plain head where nothing is received


@dataclass(frozen=True)
class Setting:
    """What is known before any receiver is fitted.

    Args:
        sites: the training rows by place.
        centre: of the sites (3,) [m].
        whole: all receivers as one group.
        kernel: of the motion.
        n_primitives: a receiver; 0 where a field does not help.
        simple: level and slope of the simpler predictors: the law of each receiver, the law of all, the mean of each.
        held_out: what these say of sites held out, (3, n, R) [dBm].
    """

    sites: Sites
    centre: Tensor
    whole: Group
    kernel: Kernel
    n_primitives: int
    simple: tuple[Law, ...]
    held_out: Tensor

    def columns(self, some: slice) -> Group:
        """The receivers of these columns."""
        g = self.whole
        law = Law(g.law.level[some], g.law.slope[some])
        return Group(
            g.receiver[some], g.position, g.local, g.rssi[:, some], g.count[:, some], g.fold, law,
            g.field_db[some], g.noise_db[some],
        )  # fmt: skip


def check(train: Rssi, pool: Rssi) -> None:
    """Enough to learn from, all finite, and a pool of the same rows.

    Raises:
        InputError: otherwise.
    """
    heard = int((~train.rssi_dbm.isnan()).sum())
    if heard < MIN_TRAINING:
        names = ", ".join(train.receiver_names)
        raise InputError(f"{names}: heard in {heard} training rows in all; at least {MIN_TRAINING} are needed")
    if not train.transmitter_position.isfinite().all() or not (train.located or train.receiver_position.isnan().all()):
        raise InputError("positions of transmitters and receivers must be finite numbers [m], or nan for all receivers")
    if train.rssi_dbm.isinf().any():
        raise InputError("RSSI must be finite numbers [dBm], or nan where not heard")
    if not torch.equal(pool.transmitter_position, train.transmitter_position):
        raise InputError("the pool must hold the same rows as the training part, at more receivers")


@single_thread()
def prepare(train: Rssi, pool: Rssi, config: RssiConfig) -> Setting:
    """Sites, folds, laws and the kernel; arguments as of `fit_rssi`."""
    sites, among = gather(train), gather(pool)
    fold = folds(sites.position, config.validation, config.seed)
    centre = sites.position.mean(dim=0)
    local = sites.position - centre
    distance = log_distance(sites.position, train.receiver_position)
    from_all = log_distance(sites.position, pool.receiver_position)

    def simple(rows: Tensor) -> tuple[Law, Law, Law]:
        """The law of each receiver, of all, and the mean of each, from some of the sites."""
        heard = ~sites.rssi[rows].isnan()
        of_all = fit_law(from_all[rows], among.rssi[rows], pooled=True)
        of_all = Law(*(x.expand(len(train.receiver_names)) for x in of_all))
        own = fit_law(distance[rows], sites.rssi[rows]).where(heard.sum(dim=0) >= MIN_TRAINING, of_all)
        mean = Law(sites.rssi[rows].nanmean(dim=0), torch.zeros_like(own.slope))
        return own, of_all, mean.where(heard.any(dim=0), of_all)

    laws = simple(torch.ones_like(fold, dtype=torch.bool))
    held_out = torch.empty(len(laws), *distance.shape, dtype=torch.float64)
    for number in fold.unique():
        out = fold == number
        held_out[:, out] = torch.stack([law(distance[out]) for law in simple(~out)])
    if config.plain:
        left = among.rssi - among.rssi.nanmean(dim=0)
        law = Law(torch.full_like(laws[0].level, LOWEST), torch.zeros_like(laws[0].slope))
        own = sites.rssi - laws[2].level
    else:
        left = among.rssi - fit_law(from_all, among.rssi)(from_all)
        law, own = laws[0], sites.rssi - laws[0](distance)
    kernel, helps = choose_kernel(local, left, fold)
    n_primitives = config.n_primitives if helps or config.plain else 0
    variance = own.square().nanmean(dim=0).nan_to_num(float(own.square().nanmean())).clamp_min(1e-6)
    noise = kernel.noise / (1 + kernel.noise) if n_primitives else 1.0
    group = Group(
        train.receiver_position, sites.position, local, sites.rssi, sites.count, fold, law,
        ((1 - noise) * variance).sqrt(), (noise * variance).sqrt(),
    )  # fmt: skip
    return Setting(sites, centre, group, kernel, n_primitives, laws, held_out)
