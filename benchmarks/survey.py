"""Measure where receivers are found, where a further access point is placed, and where a survey goes on.

python benchmarks/survey.py receivers --data DATA
python benchmarks/survey.py plan --data DATA

`receivers`: positions of receivers are hidden and estimated. The weight of the likelihood is that of the receivers of all
other campaigns (tetam, kolak, lora, wifi-rooms, the built-in floor), so no set chooses its own.

`plan`: on ten simulated floors with random boxes and four receivers, the true coverage of a fifth one at 20 places is
computed. The regret of a place is the best true coverage less its own, with a fifth one of mean power. Gains of coverage are
those of an access point whose power varies like that of the surveyed ones. On measured sets each receiver is left out, and
its RSSI is predicted by the path loss of all others at its known position.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal
from unittest.mock import patch

import numpy as np
import torch
import tyro
from record import kept, options, write_result
from scipy.ndimage import center_of_mass, label
from torch import Tensor
from torch.nn import functional

from swiftwrf import Rssi, RssiModel, load_rssi, rssi_room
from swiftwrf.contrib.survey import receivers as receivers_module
from swiftwrf.contrib.survey.plan import interval, plan_coverage
from swiftwrf.contrib.survey.receivers import SharedPathLoss, locate_receivers
from swiftwrf.data import simulated
from swiftwrf.locate.posterior import pooled_weights
from swiftwrf.metrics import HALF_WIDTH
from swiftwrf.rssi.path_loss import log_distance

CAMPAIGNS = {
    "tetam-tracks": "tetam",
    "tetam-fingerprints": "tetam",
    "kolak": "kolak",
    "lora-campus": "lora",
    "wifi-rooms/office": "wifi-rooms",
    "wifi-rooms/lecture-theatre": "wifi-rooms",
    "wifi-rooms/corridor": "wifi-rooms",
    "built-in floor": "built-in",
}
LEFT_OUT = tuple(name for name in CAMPAIGNS if name != "lora-campus")  # sets with four receivers or more
RECEIVERS_RESULT, PLAN_RESULT = "survey_receivers", "survey_plan"
FLOORS = 10
# of the simulated floors, as of `rssi_room`
POWER_DBM, PACKET_STD_DB, MISSED, GAIN_STD_DB = -8.0, 2.0, 0.1, 2.0
Row = dict[str, Any]


@dataclass(frozen=True)
class Config:
    data: Path
    """folder of the data sets"""
    study: tyro.conf.Positional[Literal["receivers", "plan"]] = "receivers"
    """what is measured"""
    sets: tuple[str, ...] = ()
    """data sets to measure. Defaults to all; the results of others are kept"""


def main(config: Config) -> None:
    """Measure and write `results/survey_receivers.json` or `results/survey_plan.json`."""
    if config.study == "receivers":
        measure_receivers(config)
    else:
        measure_plan(config)


def read(config: Config, name: str) -> Rssi:
    """Return a data set."""
    return rssi_room() if name == "built-in floor" else load_rssi(config.data / name)


def hidden(data: Rssi) -> Rssi:
    """Return the data without positions of receivers."""
    return data.derived(receiver_position=torch.full_like(data.receiver_position, torch.nan))


def measure_receivers(config: Config) -> None:
    """Estimate hidden positions of every set, each with the weight that all other campaigns choose."""
    sets = {name: read(config, name) for name in CAMPAIGNS}
    likelihoods = {name: at_candidates(data) for name, data in sets.items()}
    found = dict(kept(RECEIVERS_RESULT, "sets"))
    for name, data in sets.items():
        if config.sets and name not in config.sets:
            continue
        others = [likelihoods[other] for other in sets if CAMPAIGNS[other] != CAMPAIGNS[name]]
        weight = chosen_weight(others)
        estimate, truth = locate_receivers(hidden(data), weight=weight), data.receiver_position
        error = (estimate.position - truth)[:, :2].norm(dim=1)
        rows = {"estimate": error}
        rows |= {kind: (getattr(estimate, kind) - truth)[:, :2].norm(dim=1) for kind in ("strongest", "centroid")}
        found[name] = {
            "n": len(truth),
            "weight": weight,
            "hold": int((error <= estimate.radius_m).sum()),
            "radius_m": float(estimate.radius_m.quantile(0.5)),
            **{
                f"{kind}_m": {"median": float(e.quantile(0.5)), "p90": float(e.quantile(0.9))}
                for kind, e in rows.items()
            },
        }
        print(name, found[name], flush=True)
    found = {name: found[name] for name in CAMPAIGNS if name in found}
    everything = chosen_weight(list(likelihoods.values()))
    print("weight of all sets", everything)
    write_result(RECEIVERS_RESULT, {"sets": found, "weight_of_all_sets": everything}, rows=list(found.values()))


def at_candidates(data: Rssi) -> tuple[Tensor, Tensor, Tensor]:
    """Return log-likelihoods at the true positions (R,), at the candidates (R, m), and log-volumes of these, (R, m)."""
    unknown = hidden(data)
    columns = list(range(len(data.receiver_names)))
    search = receivers_module._Search(unknown, None, 1200, 0.35)
    model = search.shared(receivers_module._usable(unknown))
    cells, value = search.candidates(columns, model, receivers_module.DEFAULT_WEIGHT)
    evidence = [receivers_module._Evidence.of(unknown, column) for column in columns]
    return search.values(evidence, data.receiver_position[:, None], model)[:, 0], value, cells.log_volume


def chosen_weight(sets: list[tuple[Tensor, Tensor, Tensor]]) -> float:
    """Return the weight with the greatest density at the true positions of the receivers of several sets."""
    most = max(value.shape[1] for _, value, _ in sets)
    pad = [(0, most - value.shape[1]) for _, value, _ in sets]
    truth = torch.cat([truth for truth, _, _ in sets])
    value = torch.cat([functional.pad(value, by, value=-1e3) for (_, value, _), by in zip(sets, pad, strict=True)])
    volume = torch.cat([functional.pad(one, by, value=-math.inf) for (_, _, one), by in zip(sets, pad, strict=True)])
    return float(pooled_weights(truth[None], value[None], volume)[0])


def measure_plan(config: Config) -> None:
    """Measure the regret on simulated floors, and predictions of receivers that are left out of measured sets."""
    floors = [measure_floor(seed) for seed in range(FLOORS)]
    left_out = {}
    for name in config.sets or LEFT_OUT:
        left_out[name] = predict_left_out(read(config, name))
        print(name, left_out[name], flush=True)
    write_result(PLAN_RESULT, {"floors": floors, "left_out": left_out}, rows=floors)


def measure_floor(seed: int, n_rows: int = 300, n_receivers: int = 4) -> Row:
    """Return the true coverage [%] of the chosen place and its rivals on one floor with random boxes."""
    draw = np.random.default_rng(1000 + seed)
    corner = np.column_stack([draw.uniform(1, 15, 6), draw.uniform(1, 11, 6)])
    size = draw.uniform(0.4, 4.0, (6, 2))
    boxes = tuple(((x, y, 0.0), (x + w, y + h, 2.7)) for (x, y), (w, h) in zip(corner, size, strict=True))
    generator = torch.Generator().manual_seed(seed)
    low, high = torch.tensor([[0.5, 0.5, 1.0], [19.5, 15.5, 1.4]], dtype=torch.float64)
    rows, cells = (
        low + (high - low) * torch.rand(n, 3, dtype=torch.float64, generator=generator) for n in (n_rows, 500)
    )
    receiver = low + (high - low) * torch.rand(50, 3, dtype=torch.float64, generator=generator)
    receiver[:, 2] = 2.3
    receiver = outside_of(boxes, receiver)[:n_receivers]
    x, y = np.meshgrid(np.linspace(2, 18, 5), np.linspace(2, 14, 4))
    places = torch.tensor(np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 2.3)]))
    places = outside_of(boxes, places)
    with patch.object(simulated, "FLOOR", replace(simulated.FLOOR, boxes=boxes)):
        surveyed, existing, further = (
            torch.stack([simulated._power(at, one) for one in of], dim=1)
            for at, of in ((rows, receiver), (cells, receiver), (cells, places))
        )
    gain = GAIN_STD_DB * torch.randn(n_receivers, dtype=torch.float64, generator=generator)
    channel = torch.randint(3, (n_rows, n_receivers, 1), generator=generator)
    noise = PACKET_STD_DB * torch.randn(n_rows, n_receivers, dtype=torch.float64, generator=generator)
    rssi = (POWER_DBM + gain + surveyed.gather(2, channel)[..., 0] + noise).round()
    missed = (torch.rand(n_rows, n_receivers, generator=generator) < MISSED) | (rssi < -85.0)
    survey = Rssi(rssi.where(~missed, torch.nan), rows, receiver_position=receiver, name=f"floor-{seed}")
    strongest = survey.rssi_dbm.nan_to_num(-200.0).amax(dim=1)
    threshold = float(strongest.quantile(0.4).floor()) + 0.5

    def above(power: Tensor) -> Tensor:  # of packets on a random channel, (n, r)
        z = (POWER_DBM + power - threshold) / PACKET_STD_DB
        detected: Tensor = (1 - MISSED) * torch.special.ndtr(z).mean(dim=2)
        return detected

    missing = (1 - above(existing + gain[:, None])).prod(dim=1)
    before = 1 - float(missing.mean())

    def coverage(gain_db: Tensor | float) -> Tensor:  # of each place, (m,)
        return 1 - (missing[:, None] * (1 - above(further + gain_db))).mean(dim=0)

    true = coverage(0.0)
    own = GAIN_STD_DB * torch.randn(len(places), 1, dtype=torch.float64, generator=generator)
    true_gain = coverage(own) - before
    found = plan_coverage(RssiModel().fit(survey), survey, 1, above_dbm=threshold, candidates=places)
    mean, start, end = interval(found.gain)
    chosen, hole = found.chosen[0], hole_centre(found.cells, found.probability[0], places)
    row = {
        "threshold_dbm": threshold,
        "before": before,
        "predicted_before": float(found.before.mean()),
        "best": float(true.max()),
        "chosen": float(true[chosen]),
        "random": float(true.mean()),
        "hole": float(true[hole]),
        "predicted_gain": float(mean[chosen]),
        "true_gain": float(true[chosen]) - before,
        "true_gain_like_surveyed": float(coverage(gain.mean())[chosen]) - before,
        "surveyed_gain_db": float(gain.mean()),
        "predicted_gain_of_all": float(mean.mean()),
        "true_gain_of_all": float(true.mean()) - before,
        "intervals_hold": float(((true_gain >= start) & (true_gain <= end)).double().mean()),
    }
    print(seed, {name: round(value, 3) for name, value in row.items()}, flush=True)
    return row


def outside_of(boxes: tuple[Any, ...], position: Tensor) -> Tensor:
    """Return the positions (n, 3) [m] that are in no box: nobody hangs an access point into a cabinet."""
    corners = torch.tensor(boxes, dtype=torch.float64)
    within = ((position[:, None] >= corners[:, 0]) & (position[:, None] <= corners[:, 1])).all(dim=2).any(dim=1)
    return position[~within]


def hole_centre(cells: Tensor, probability: Tensor, places: Tensor) -> int:
    """Return the candidate nearest to the centre of the largest connected region with a probability below 0.5."""
    x, column = cells[:, 0].unique(return_inverse=True)
    y, line = cells[:, 1].unique(return_inverse=True)
    hole = np.zeros((len(y), len(x)), dtype=bool)
    hole[line, column] = (probability < 0.5).numpy()
    regions, count = label(hole)
    if not count:
        return int((cells[probability.argmin()] - places)[:, :2].norm(dim=1).argmin())
    largest = 1 + int(np.argmax([(regions == number).sum() for number in range(1, count + 1)]))
    row, middle = center_of_mass(regions == largest)
    centre = torch.stack([x[round(middle)], y[round(row)]])
    return int((places[:, :2] - centre).norm(dim=1).argmin())


def predict_left_out(data: Rssi) -> Row:
    """Return errors and coverage of 80 % intervals where each receiver is predicted from the path loss of all others."""
    errors, held, shares = [], [], []
    threshold = float(data.rssi_dbm[data.detected].quantile(0.5)) if int(data.detected.sum()) < 10**7 else -70.0
    for out in range(len(data.receiver_names)):
        others = [column for column in range(len(data.receiver_names)) if column != out]
        shared = SharedPathLoss.fit(data.columns(others), data.receiver_position[others])
        seen = data.detected[:, out]
        distance = log_distance(data.transmitter_position[seen], data.receiver_position[out][None])[:, 0]
        mean, std = shared.predict(distance)
        rssi = data.rssi_dbm[seen, out]
        errors.append((rssi - mean).abs())
        held.append(errors[-1] <= HALF_WIDTH * std)
        predicted = torch.special.ndtr((mean - threshold) / std).mean()
        shares.append(float(predicted - (rssi > threshold).double().mean()))
    error = torch.cat(errors)
    return {
        "n": len(error),
        "receivers": len(errors),
        "median_db": float(error.quantile(0.5)),
        "intervals_hold": float(torch.cat(held).double().mean()),
        "share_error": float(np.median(np.abs(shares))),
    }


if __name__ == "__main__":
    main(options(Config))
