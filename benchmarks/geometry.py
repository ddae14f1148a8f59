"""Walls found from spectra, how far they are off, and the spectra that follow from them at unseen positions.

python benchmarks/geometry.py DATA   DATA holds newrf-bedroom and newrf-office
"""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import Any, get_args

import torch
from record import check_committed, write_result

from swiftwrf import Spectra, load_spectra, simulated_room
from swiftwrf.choices import Moving
from swiftwrf.metrics import psnr, summary
from swiftwrf.models.geometry import GeometryModel, HybridModel

SIDES = ("x-", "x+", "y-", "y+", "z-", "z+")  # of a room
WALLS = {  # where they are on each side [m]
    "newrf-bedroom": (-2.28, 2.28, -2.28, 2.28, 0.0, 3.0),
    "newrf-office": (0.010, 5.010, 0.016, 8.016, 0.0, 3.2),
    "simulated-room": (0.0, 6.0, 0.0, 5.0, 0.0, 3.0),
}
PARALLEL = 0.9  # cosine between a wall's normal and a plane's, above which it may be that wall
CASES: list[tuple[str, Moving, float, int]] = [  # scene, end that moves, measured share, draw
    ("newrf-bedroom", "receiver", 1.0, 0),
    *(("newrf-bedroom", "receiver", 0.1, draw) for draw in range(3)),
    ("simulated-room", "transmitter", 0.3, 0),
    ("simulated-room", "receiver", 0.3, 0),
    ("newrf-office", "receiver", 1.0, 0),
    *(("simulated-room", moving, 0.3, draw) for draw in (1, 2) for moving in get_args(Moving)),
]


def nearest(planes: list[dict[str, Any]], side: str, offset: float) -> dict[str, Any] | None:
    """The plane found on this side of the room closest to the true wall at `offset` [m], None where there is none."""
    axis, outward = "xyz".index(side[0]), 1 if side[1] == "+" else -1
    own = [plane for plane in planes if outward * plane["normal"][axis] > PARALLEL]
    if not own:
        return None
    plane = min(own, key=lambda plane: abs(outward * plane["offset_m"] - offset))
    found = outward * plane["offset_m"]
    told = {"std_mm": plane["std_mm"], "certain": plane["certain"]}
    return {"found_m": found, "error_mm": 1000 * abs(found - offset), **told}


def measure(data: Spectra, share: float, draw: int) -> dict[str, Any]:
    """Fits geometry and hybrid on a share of the training spectra."""
    train, test = data.split("random")
    order = torch.randperm(len(train), generator=torch.Generator().manual_seed(draw))
    train = train.subset(order[: round(share * len(train))].sort().values)
    began, cpu = time.perf_counter(), time.process_time()
    model = GeometryModel().fit(train)
    seconds, cpu_seconds = time.perf_counter() - began, time.process_time() - cpu
    hybrid = HybridModel().fit(train, like=model)
    planes = model.to_json()["planes"]
    walls = {f"{side[0]} = {o}": nearest(planes, side, o) for side, o in zip(SIDES, WALLS[data.name], strict=True)}
    return {
        "positions": len(train),
        "seconds": seconds,
        "cpu_seconds": cpu_seconds,
        "walls": walls,
        "planes": len(model.planes),
        "order": model.order,
        "score_held_out": model.estimate.score_held_out,
        "conclusion": model.conclusion,
        "psnr_db": {
            "geometry": summary(psnr(model.synthesize(test.position), test.spectrum)),
            "hybrid": summary(psnr(hybrid.synthesize(test.position), test.spectrum)),
        },
    }


def main() -> None:
    torch.set_num_threads(1)
    folder, results = Path(sys.argv[1]), {}
    for name, moving, share, draw in CASES:
        data = simulated_room(moving=moving) if name == "simulated-room" else load_spectra(folder / name)
        key = f"{name}, moving {moving}, {round(100 * share)} %, draw {draw}"
        results[key] = measure(data, share, draw)
        off = [None if w is None else round(w["error_mm"], 1) for w in results[key]["walls"].values()]
        decibels = {k: round(v["median"], 2) for k, v in results[key]["psnr_db"].items()}
        print(key, off, decibels, round(results[key]["cpu_seconds"], 1), "s", flush=True)
        write_result("geometry", {"cases": results})  # after each, for the last ones take long


if __name__ == "__main__":
    check_committed()
    main()
