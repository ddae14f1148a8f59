"""Measure maps of RSSI below the limit of detection, where the truth of simulated surveys is known.

A survey has 300 positions on 30 x 20 m and eight receivers. The power is a path loss, a Gaussian process as shadowing and
the noise of a packet. Packets below -88 dBm are lost.

With --insensitive-dbm every second receiver has that limit, and 10 % of all packets are lost in addition. The errors of the
estimated limits are printed for prior standard deviations of a receiver's limit, and nothing is written.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from record import options, write_result

from swiftwrf import Rssi, RssiModel
from swiftwrf.choices import NotDetected
from swiftwrf.gp import Kernel
from swiftwrf.rssi.detection import Detection
from swiftwrf.rssi.path_loss import log_distance

LIMIT_DBM, PACKET_DB, SHADOWING_DB, RECEIVERS = -88.0, 2.5, 4.5, 8
MARGIN_DB = 3.0  # below the limit, from which a cell counts as weak
SHADOWING = Kernel(6.0, 4.0, matern12_weight=0.5, noise=1e-6)


@dataclass(frozen=True)
class Config:
    seeds: int = 10
    """surveys"""
    insensitive_dbm: float | None = None
    """limit of every second receiver"""


PRIORS_DB = 2.0, 6.0, 10.0, 14.0, 20.0, 30.0


def survey(
    seed: int, n: int = 300, insensitive_dbm: float = LIMIT_DBM, missed: float = 0.0
) -> tuple[Rssi, torch.Tensor, torch.Tensor]:
    """Return a survey, the cells of a map (m, 3) [m], and the true mean power in them (m, R) [dBm]."""
    generator = torch.Generator().manual_seed(seed)
    size = torch.tensor([30.0, 20.0, 0.0], dtype=torch.float64)
    x, y = np.meshgrid(np.arange(0.5, 30), np.arange(0.5, 20))
    cell = torch.tensor(np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1))
    measured, receiver = (size * torch.rand(k, 3, generator=generator).double() for k in (n, RECEIVERS))
    receiver[:, 2] = 2.5
    every = torch.cat([measured, cell])
    root = torch.linalg.cholesky(SHADOWING.covariance(every))
    level = -38 + 2 * torch.randn(RECEIVERS, generator=generator).double()
    slope = -38 + 2 * torch.randn(RECEIVERS, generator=generator).double()
    shadowing = SHADOWING_DB * root @ torch.randn(len(every), RECEIVERS, generator=generator).double()
    truth = level + slope * log_distance(every, receiver) + shadowing
    packet = truth[:n] + PACKET_DB * torch.randn(n, RECEIVERS, generator=generator)
    limit = torch.tensor([LIMIT_DBM, insensitive_dbm] * (RECEIVERS // 2))
    lost = (packet < limit) | (torch.rand(n, RECEIVERS, generator=generator) < missed)
    rssi = packet.round().where(~lost, torch.nan)
    names = [f"r{number}" for number in range(RECEIVERS)]
    return Rssi(rssi, measured, receiver_position=receiver, receiver_names=names, name="survey"), cell, truth[n:]


def measure(seed: int, not_detected: NotDetected) -> dict[str, Any]:
    """Return errors of a map against the truth of a survey [dB]."""
    data, cell, truth = survey(seed)
    mean = RssiModel(not_detected=not_detected).fit(data).predict(cell).mean.double()
    weak, strong = truth < LIMIT_DBM - MARGIN_DB, truth >= LIMIT_DBM
    return {
        "seed": seed,
        "not_detected": not_detected,
        "weak_bias_db": float((mean - truth)[weak].mean()),
        "weak_above_limit": float((mean > LIMIT_DBM)[weak].double().mean()),
        "strong_error_db": float((mean - truth)[strong].abs().mean()),
        "empty": float((~data.detected).double().mean()),
    }


def limits(seeds: int, insensitive_dbm: float) -> None:
    """Print the mean absolute errors of the limits of sensitive and insensitive receivers."""
    for n in (80, 300):
        surveys = [survey(seed, n, insensitive_dbm, missed=0.1)[0] for seed in range(seeds)]
        for std_db in PRIORS_DB:
            curves = [
                Detection.estimate(data.transmitter_position, data.rssi_dbm, limit_std_db=std_db) for data in surveys
            ]
            error = torch.stack([curve.limit for curve in curves]) - torch.tensor([LIMIT_DBM, insensitive_dbm]).repeat(
                4
            )
            each = [float(error[:, first::2].abs().mean()) for first in (0, 1)]
            print(f"{n} rows, prior {std_db:g} dB: limits within {each[0]:.2f} and {each[1]:.2f} dB", flush=True)


def main(config: Config) -> None:
    """Write `results/not_detected.json`."""
    if config.insensitive_dbm is not None:
        limits(config.seeds, config.insensitive_dbm)
        return
    kinds: tuple[NotDetected, ...] = ("auto", "unknown")
    rows = [measure(seed, kind) for seed in range(config.seeds) for kind in kinds]
    for row in rows:
        print(row, flush=True)
    write_result("not_detected", {"limit_dbm": LIMIT_DBM, "rows": rows}, rows=rows)


if __name__ == "__main__":
    main(options(Config))
