"""Measure time and memory of the RSSI model against rows and receivers, on the simulated floor.

Each point runs in a separate process, for its own peak of memory. Seconds are processor time.
"""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context

import torch
from record import kept, options, write_result
from scaling import measuring

from swiftwrf import Rssi, fit_rssi, rssi_room
from swiftwrf.rssi import RssiConfig

POINTS = ((1_000, 12), (10_000, 12), (100_000, 12), (1_000, 48), (1_000, 500))
PREDICTED = 100_000


@dataclass(frozen=True)
class Config:
    points: tuple[tuple[int, int], ...] = POINTS
    """rows and receivers; other points that were measured before are kept"""


def widen(data: Rssi, n: int) -> Rssi:
    """Return the floor with its receivers repeated under new names until there are n."""
    columns = [i % len(data.receiver_names) for i in range(n)]
    return replace(data.columns(columns), receiver_names=tuple(f"r{i}" for i in range(n)))


def measure(n: int, receivers: int) -> dict[str, float]:
    """Fit and predict at one size, in this process."""
    data = widen(rssi_room(n=n), receivers)
    found: dict[str, float] = {"rows": n, "receivers": receivers}
    with measuring(found, "fit "):
        model = fit_rssi(data, RssiConfig(), progress=False)
    places = data.transmitter_position.repeat(-(-PREDICTED // n), 1)[:PREDICTED]
    with measuring(found, "predict "):
        model.predict(places)
    return found


def main(config: Config) -> None:
    """Measure each point and write `results/scaling_rssi.json`."""
    rows = kept("scaling_rssi", "rows")
    for n, receivers in config.points:
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as fresh:
            found = fresh.submit(measure, n, receivers).result()
        print(found, flush=True)
        rows = [row for row in rows if (row["rows"], row["receivers"]) != (n, receivers)] + [found]
        rows.sort(key=lambda row: (row["receivers"], row["rows"]))
        write_result(
            "scaling_rssi", {"threads": torch.get_num_threads(), "predicted": PREDICTED, "rows": rows}, rows=[found]
        )


if __name__ == "__main__":
    main(options(Config))
