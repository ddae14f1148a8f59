"""Runs whose files were damaged: the page opens them or refuses them in a sentence, and never shows a traceback."""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from fuzz.runs import followed_run, run_of_aoa, run_of_locate, run_of_rssi, show

from swiftwrf import InputError

OPENED = (
    "config.json",
    "environment.json",
    "geometry-*",
    "maps.npz",
    "floor-plan.npz",
    "*.safetensors",
    "update.json",
    "measurements.csv",
)
OTHER_JSON = (None, "x", 1e400, [[]], {"a": None})


RUNS = {"aoa": run_of_aoa, "rssi": run_of_rssi, "locate": run_of_locate, "followed": followed_run}


def damaged_bytes(content: bytes) -> dict[str, bytes]:
    """Return contents of a file that was cut, overwritten or replaced."""
    random = np.random.default_rng(0)
    found = {"empty": b"", "cut": content[: len(content) // 2], "zeros": bytes(len(content)), "text": b"hello\n"}
    for number in range(3):
        flipped = np.frombuffer(content, np.uint8).copy()
        flipped[random.integers(0, len(flipped), 1 + len(flipped) // 50)] ^= random.integers(1, 256, dtype=np.uint8)
        found[f"flipped {number}"] = flipped.tobytes()
    return found


def damaged_arrays(file: Path) -> dict[str, dict[str, np.ndarray]]:
    """Return archives in which one array has another shape, type or range, or is missing."""
    with np.load(file) as stored:
        arrays = dict(stored)
    found = {"none": {}}
    for name, array in arrays.items():
        others = {
            "flat": array.ravel()[:3],
            "deeper": array[None],
            "scalar": np.float64(1),
            "no rows": array[:0],
            "shorter": array[:-1],
            "complex": np.ones(array.shape, complex),
            "text": np.full(array.shape, "a"),
            "objects": np.full(array.shape, None),
            "nan": np.full(array.shape, np.nan),
            "huge": np.full(array.shape, 1e308),
            "infinite": np.full(array.shape, np.inf),
        }
        found |= {f"{name} {kind}": arrays | {name: other} for kind, other in others.items()}
        found[f"{name} missing"] = {key: value for key, value in arrays.items() if key != name}
    return found


def damaged_values(content: object, others: tuple[object, ...] = OTHER_JSON) -> dict[str, object]:
    """Return JSON in which the whole or one value is of another kind, of fewer kinds at greater depth."""
    found = {repr(other): other for other in others}
    if isinstance(content, dict):
        for number, (key, value) in enumerate(content.items()):
            few = damaged_values(value, others[:-2])
            for kind in list(few)[number % 2 :: 2]:  # half of the values are enough
                found[f"{key} {kind}"] = content | {key: few[kind]}
            found[f"{key} missing"] = {name: value for name, value in content.items() if name != key}
    if isinstance(content, list) and content:
        found |= {
            f"[0] {kind}": [other, *content[1:]] for kind, other in damaged_values(content[0], others[:-2]).items()
        }
    return found


def damaged_tables(text: str) -> dict[str, str]:
    """Return tables whose header, rows or cells are others."""
    header, *rows = text.splitlines()
    found = {"no header": "\n".join(rows), "no rows": header, "long row": f"{text}1,{rows[0]}\n", "quote": text + '"'}
    for column, name in enumerate(header.split(",")):
        cells = [row.split(",") for row in rows]
        for other in ("x", "1" * 5000):
            changed = [",".join([*row[:column], other, *row[column + 1 :]]) for row in cells]
            found[f"{name} {other[:9]}"] = "\n".join([header, *changed, ""])
    return found


def damages(file: Path) -> dict[str, Callable[[], object]]:
    """Return functions that damage a file, by the kind of the damage."""
    content = file.read_bytes()
    found = {kind: partial(file.write_bytes, other) for kind, other in damaged_bytes(content).items()}
    found["missing"] = file.unlink
    match file.suffix:
        case ".npz":
            found |= {kind: partial(np.savez, file, **arrays) for kind, arrays in damaged_arrays(file).items()}
        case ".json":
            found["brackets"] = partial(file.write_text, "[" * 100_000)
            values = damaged_values(json.loads(content))
            found |= {kind: partial(file.write_text, json.dumps(other)) for kind, other in values.items()}
        case ".csv":
            found |= {kind: partial(file.write_text, text) for kind, text in damaged_tables(content.decode()).items()}
    return found


@pytest.mark.parametrize("name", RUNS)
def test_a_damaged_run_is_shown_or_refused(name, tmp_path):
    run = tmp_path / "run"
    run.mkdir()
    RUNS[name](run)
    show(run)
    wrong, n = [], 0
    for file in sorted({file for pattern in OPENED for file in run.glob(pattern)}):
        content = file.read_bytes()
        for kind, damage in damages(file).items():
            damage()
            n += 1
            try:
                show(run)
            except InputError:
                pass
            except Exception as error:
                wrong.append(f"{file.name}, {kind}: {type(error).__name__}: {error}")
            finally:
                file.write_bytes(content)
    assert not wrong, f"{len(wrong)} of {n} tracebacks:\n" + "\n".join(wrong)
