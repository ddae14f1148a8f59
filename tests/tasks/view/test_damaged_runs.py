"""Runs with other arrays and values in their files: the page opens them or refuses them in a sentence, without a traceback.

The fuzzer mutates the bytes and tables of the same runs.
"""

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from fuzz.runs import run_of_aoa, run_of_locate, run_of_rssi, show

from swiftwrf import InputError

OPENED = ("config.json", "environment.json", "geometry-*", "maps.npz", "floor-plan.npz", "*.safetensors")
OTHER_JSON = (None, "x", 1e400, [[]], {"a": None})


RUNS = {"aoa": run_of_aoa, "rssi": run_of_rssi, "locate": run_of_locate}


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


def damages(file: Path) -> dict[str, Callable[[], object]]:
    """Return functions that damage a file, by the kind of the damage."""
    found: dict[str, Callable[[], object]] = {"missing": file.unlink}
    if file.suffix == ".npz":
        found |= {kind: partial(np.savez, file, **arrays) for kind, arrays in damaged_arrays(file).items()}
    elif file.suffix == ".json":
        found["brackets"] = partial(file.write_text, "[" * 100_000)
        values = damaged_values(json.loads(file.read_text()))
        found |= {kind: partial(file.write_text, json.dumps(other)) for kind, other in values.items()}
    return found


@pytest.mark.parametrize("every", [4, pytest.param(1, marks=pytest.mark.fuzz)])
@pytest.mark.parametrize("name", RUNS)
def test_a_damaged_run_is_shown_or_refused(name, every, tmp_path):
    run = tmp_path / "run"
    run.mkdir()
    RUNS[name](run)
    show(run)
    wrong, n = [], 0
    for file in sorted({file for pattern in OPENED for file in run.glob(pattern)}):
        content = file.read_bytes()
        for kind, damage in [*damages(file).items()][::every]:
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
