"""Damaged model files and checkpoints of fits, files that claim more than they contain, and predictions at far positions."""

from pathlib import Path

import pytest

from swiftwrf import InputError, load
from swiftwrf.models.coarray import CoarrayModel
from swiftwrf.models.swiftwrf_paper import SwiftWRFPaper
from swiftwrf.runtime.checkpoint import read, write

ROOT = Path(__file__).parents[3]
TINY = {"n_primitives": 4, "steps": 10, "check_every": 5}


def test_models_whose_parameters_overflow_are_refused(room):
    tensors, header = CoarrayModel().fit(room).state()
    model = CoarrayModel.from_state(tensors | {"form": 3e38 * tensors["form"].sign()}, header)
    with pytest.raises(InputError, match="not finite"):
        model.synthesize(room.position[:1])


def test_a_header_that_is_no_header(tmp_path):
    from safetensors.torch import save_file

    for header in ("", "[]", "{", "[" * 100_000, "3"):
        save_file({}, tmp_path / "m", {"kind": "swiftwrf model", "format": "1", "header": header})
        with pytest.raises(InputError):
            load(tmp_path / "m")


def test_a_damaged_state_of_a_fit_is_refused(room, tmp_path):
    state = tmp_path / "state"
    SwiftWRFPaper(**TINY).fit(room, checkpoint=state)
    kind, tensors, header = read(state, "fit state")
    for change in ({"seconds": None}, {"records": 3}, {"step": "x"}, {"fingerprint": 1}):
        write(state, kind, tensors, header | change)
        with pytest.raises(InputError):
            SwiftWRFPaper(**TINY).fit(room, checkpoint=state)
    write(state, kind, {name: t for name, t in tensors.items() if "mean" not in name}, header)
    with pytest.raises(InputError):
        SwiftWRFPaper(**TINY).fit(room, checkpoint=state)
