"""Measure the cost of other work on the same machine, for several busy-waiting times of threads (GOMP_SPINCOUNT).

Steps of the network and a fit of RSSI are timed on an idle machine and beside a loop on one core.

python benchmarks/busy.py
"""

from __future__ import annotations

import json
import os
import statistics
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from subprocess import PIPE, Popen, run

from record import write_result

from augment import Mixed
from swiftwrf import fit_rssi, rssi_room, simulated_room
from tasks.aoa.estimators.aann import AANN

SPINS = ("300000", "30000", "3000")  # the first is libgomp's own
ROUNDS, STEPS = 2, 20


def measure() -> dict[str, float]:
    """Return the seconds of a step of 64 spectra and of a fit of twelve receivers, in this process."""
    room, floor = simulated_room(128), rssi_room()
    network = AANN(steps=STEPS, batch=64).fit(Mixed.measured(room))
    first, last = network.history[0], network.history[-1]
    began = time.perf_counter()
    fit_rssi(floor, progress=False)
    return {
        "step_s": (last["seconds"] - first["seconds"]) / (last["step"] - first["step"]),
        "rssi_s": time.perf_counter() - began,
    }


@contextmanager
def neighbour(there: bool) -> Iterator[None]:
    """Run a process that occupies one core during the context, if asked to."""
    loop = Popen([sys.executable, "-c", "while True: pass"]) if there else None
    try:
        yield
    finally:
        if loop:
            loop.kill()
            loop.wait()


def main() -> None:
    taken: dict[tuple[bool, str], list[dict[str, float]]] = {}
    for _ in range(ROUNDS):
        for busy in (False, True):
            for spins in SPINS:
                with neighbour(busy):
                    environment = os.environ | {"GOMP_SPINCOUNT": spins}
                    done = run(
                        [sys.executable, __file__, "measure"], env=environment, stdout=PIPE, text=True, check=True
                    )
                taken.setdefault((busy, spins), []).append(json.loads(done.stdout.splitlines()[-1]))
                print("busy" if busy else "idle", spins, taken[busy, spins][-1], flush=True)
    rows = [
        {"neighbour": busy, "spins": int(spins), **{key: statistics.median(m[key] for m in each) for key in each[0]}}
        for (busy, spins), each in taken.items()
    ]
    write_result("busy", {"rounds": ROUNDS, "rows": rows})


if __name__ == "__main__":
    if sys.argv[1:] == ["measure"]:
        print(json.dumps(measure()))
    else:
        main()
