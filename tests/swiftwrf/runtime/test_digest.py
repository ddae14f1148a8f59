"""Digests are equal for equal values in every process, and differ for whatever may change a result."""

import functools
import subprocess
import sys
import textwrap
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
import pytest
import torch

from swiftwrf import AngularGrid, InputError, Rssi, RssiModel, make_model, rssi_room, simulated_room
from swiftwrf.contrib.comparison.steps import Memo
from swiftwrf.data.store import Store
from swiftwrf.models.neighbours import IDWModel
from swiftwrf.runtime.digest import digest

ROOM = simulated_room(n=12, grid=AngularGrid.hemisphere(4, 8))
FLOOR = rssi_room(n=20)


def of_code(code):
    """Return the digest of what a notebook defines as `f`."""
    names = {"__name__": "__main__"}
    exec(textwrap.dedent(code), names)
    return digest(names["f"])


CHANGED_CODE = {
    "constant": ("f = lambda x: x + 1", "f = lambda x: x + 2"),
    "name": ("f = lambda x: x.mean()", "f = lambda x: x.sum()"),
    "default": ("def f(x, y=1): return x", "def f(x, y=2): return x"),
    "keyword": ("def f(x, *, y=1): return x", "def f(x, *, y=2): return x"),
    "helper": ("def h(x): return x\ndef f(x): return h(x)", "def h(x): return -x\ndef f(x): return h(x)"),
    "global": ("A = 1\ndef f(x): return x + A", "A = 2\ndef f(x): return x + A"),
    "inner function": ("def f(x): return sum(y + 1 for y in x)", "def f(x): return sum(y + 2 for y in x)"),
    "helper of an inner function": (
        "def h(x): return x\ndef f(x): return [h(y) for y in x]",
        "def h(x): return -x\ndef f(x): return [h(y) for y in x]",
    ),
    "closure": (
        "def g(a):\n    return lambda x: x + a\nf = g(1)",
        "def g(a):\n    return lambda x: x + a\nf = g(2)",
    ),
    "method": ("class f:\n    def g(self): return 1", "class f:\n    def g(self): return 2"),
    "attribute": ("class f:\n    a = 1", "class f:\n    a = 2"),
    "base": ("class b:\n    a = 1\nclass f(b): pass", "class b:\n    a = 2\nclass f(b): pass"),
    "property": (
        "class f:\n    @property\n    def a(self): return 1",
        "class f:\n    @property\n    def a(self): return 2",
    ),
    "static method": (
        "class f:\n    @staticmethod\n    def a(): return 1",
        "class f:\n    @staticmethod\n    def a(): return 2",
    ),
    "decorated": (
        "from swiftwrf.runtime.validation import checked\n@checked\ndef f(x): return 1",
        "from swiftwrf.runtime.validation import checked\n@checked\ndef f(x): return 2",
    ),
    "partial": (
        "import functools\nf = functools.partial(max, 1)",
        "import functools\nf = functools.partial(max, 2)",
    ),
}


@pytest.mark.parametrize(("before", "after"), CHANGED_CODE.values(), ids=CHANGED_CODE)
def test_code_counts_by_what_it_does(before, after):
    assert of_code(before) == of_code(before) != of_code(after)
    assert of_code(before) == of_code(f"# a comment\n\n{before}")


@dataclass(frozen=True)
class Option:
    width: float = 0.1

    @functools.cached_property
    def half(self):
        return self.width / 2


CHANGED = {
    "number": (1, 2),
    "kind of number": (1, 1.0),
    "truth": (0, False),
    "text": ("a", "b"),
    "order": ([1, 2], [2, 1]),
    "nesting": ([1, [2, 3]], [1, 2, 3]),
    "key": ({"a": 1}, {"b": 1}),
    "set": ({"a", "b"}, {"a", "c"}),
    "tensor": (torch.zeros(3), torch.tensor([0.0, 0, 1])),
    "shape": (torch.zeros(4), torch.zeros(2, 2)),
    "type": (torch.zeros(4), torch.zeros(4).double()),
    "strides": (torch.arange(4.0).reshape(2, 2), torch.arange(4.0).reshape(2, 2).T),
    "array of texts": (np.array(["a", "b"], dtype=object), np.array(["a", "c"], dtype=object)),
    "column": (pd.Series(["a", "b"]), pd.Series(["a", "c"])),
    "spectra": (ROOM, replace(ROOM, store=Store(1 - ROOM.spectrum))),
    "rows": (ROOM, ROOM[:11]),
    "fixed end": (ROOM, replace(ROOM, fixed_position=ROOM.fixed_position + 1)),
    "RSSI": (FLOOR, replace(FLOOR, rssi_dbm=FLOOR.rssi_dbm - 20)),
    "groups": [replace(FLOOR, groups=pd.Series([*"ab"] * 10, name=name)) for name in ("phone", "channel")],
    "option": (Option(), Option(0.2)),
    "model": (make_model("idw"), make_model("idw", seed=1)),
    "fitted model": [RssiModel(n_primitives=0).fit(FLOOR[:rows]) for rows in (15, 20)],
    "network": [torch.nn.Linear(2, 2), torch.nn.Linear(2, 2)],
}


@pytest.mark.parametrize(("value", "other"), CHANGED.values(), ids=CHANGED)
def test_values_count_by_their_content(value, other):
    assert digest(value) == digest(value) != digest(other)
    assert digest(value, value) != digest(value)


def test_the_content_counts_and_neither_its_place_nor_what_was_computed_from_it():
    data = Rssi(FLOOR.rssi_dbm.clone(), FLOOR.transmitter_position.clone(), name="a")
    assert digest([data, data]) == digest([data, replace(data)])
    used = Option()
    assert used.half == 0.05
    assert digest(used) == digest(Option())


def test_a_method_that_is_replaced_counts(monkeypatch):
    class Mine(IDWModel):
        def synthesize(self, position):
            return super().synthesize(position) * 0

    before = digest(Mine())
    monkeypatch.setattr(Mine, "synthesize", IDWModel.synthesize)
    assert digest(Mine()) == digest(Mine()) != before


def test_code_that_calls_itself_ends():
    assert of_code("def f(x): return f(x - 1)") != of_code("def f(x): return f(x - 2)")
    assert of_code("def g(x): return f(x)\ndef f(x): return g(x)") != of_code(
        "def g(x): return -f(x)\ndef f(x): return g(x)"
    )


def test_what_has_no_content_is_refused(tmp_path):
    with (tmp_path / "a").open("w") as file, pytest.raises(InputError, match=r"cannot be kept .*; leave keep out"):
        digest(file)
    ring = []
    ring.append(ring)
    with pytest.raises(InputError, match="cannot be kept"):
        digest(ring)


def test_digests_are_equal_in_every_process():
    """Names in sets and addresses differ from process to process."""
    code = """
        import torch, swiftwrf, functools
        from swiftwrf.runtime.digest import digest
        from swiftwrf.models.neighbours import IDWModel
        class Mine(IDWModel):
            kinds_of = frozenset({"a", "b", "c"})
            def synthesize(self, position):
                return self.scale(position, lambda x: x in {"a", "b", "c"})
            @functools.cached_property
            def scale(self): return torch.ones(3)
        print(digest(Mine(), {"x", "y", "z"}, swiftwrf.rssi_room(n=20), swiftwrf.simulated_room(n=12), max, torch.float32))
    """
    run = [sys.executable, "-c", textwrap.dedent(code)]
    found = {subprocess.run(run, capture_output=True, text=True, check=True, env=None).stdout for _ in range(2)}
    assert len(found) == 1


def test_a_folder_without_results_takes_any_call(tmp_path):
    Memo(tmp_path).of({"seed": 0})
    memo = Memo(tmp_path)
    memo.of({"seed": 1, "progress": True})
    memo.keep("a", {"value": 1}, 0.0)
    Memo(tmp_path).of({"seed": 1, "progress": False})
    with pytest.raises(InputError, match=r"the input or a version has changed since .* began \(seed\)"):
        Memo(tmp_path).of({"seed": 2})


def test_results_of_unknown_origin_are_refused(tmp_path):
    Memo(tmp_path).keep("a", {"value": 1}, 0.0)
    with pytest.raises(InputError, match=r"has changed since .* \(.*seed.*\)"):
        Memo(tmp_path).of({"seed": 0})


def test_results_of_another_version_are_refused(tmp_path, monkeypatch):
    memo = Memo(tmp_path)
    memo.of({})
    memo.keep("a", {"value": 1}, 0.0)
    monkeypatch.setattr("swiftwrf.contrib.comparison.steps.packages", lambda: {"torch": "0.1"})
    with pytest.raises(InputError, match=r"\(.*torch"):
        Memo(tmp_path).of({})
