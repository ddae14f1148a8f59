"""How the time and memory of the RSSI model grow with rows and receivers, on the simulated floor."""

from __future__ import annotations

import resource
import time
from dataclasses import replace

import torch
from record import write_result

from swiftwrf import Rssi, RssiConfig, fit_rssi, rssi_room

ROWS = (1_000, 10_000, 100_000)
RECEIVERS = (12, 48)


def widen(data: Rssi, n: int) -> Rssi:
    """The same floor with every receiver repeated under new names until there are n."""
    columns = [i % len(data.receiver_names) for i in range(n)]
    return replace(data.columns(columns), receiver_names=tuple(f"r{i}" for i in range(n)))


def main() -> None:
    """Fits and predicts at each size."""
    rows = []
    for n, receivers in [(n, RECEIVERS[0]) for n in ROWS] + [(ROWS[0], r) for r in RECEIVERS[1:]]:
        data = widen(rssi_room(n=n), receivers)
        began = time.perf_counter()
        model = fit_rssi(data, RssiConfig())
        fitted = time.perf_counter()
        places = data.transmitter_position.repeat(-(-100_000 // n), 1)[:100_000]
        predicting = time.perf_counter()
        model.predict(places)
        row = {
            "rows": n,
            "receivers": receivers,
            "fit_s": fitted - began,
            "predict_100000_s": time.perf_counter() - predicting,
            "peak_memory_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        }
        rows.append(row)
        print(row, flush=True)
    write_result("scaling_rssi", {"threads": torch.get_num_threads(), "rows": rows})


if __name__ == "__main__":
    main()
