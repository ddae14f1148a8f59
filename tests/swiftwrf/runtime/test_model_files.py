"""Damaged model files and checkpoints of fits, files that claim more than they contain, and predictions at far positions."""

import os
import resource
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import torch
from samples import install

from swiftwrf import CoarrayModel, InputError, SwiftWRF, fit, load
from swiftwrf.models.swiftwrf_paper import SwiftWRFPaper
from swiftwrf.runtime.checkpoint import Saved, read, write

ROOT = Path(__file__).parents[3]
TINY = {"n_primitives": 4, "steps": 10, "check_every": 5}


@pytest.fixture(scope="module")
def models(room, tmp_path_factory):
    """A file of each kind of model."""
    folder = tmp_path_factory.mktemp("models")
    fit(room, n_primitives=4).save(folder / "swiftwrf")
    SwiftWRFPaper(**TINY).fit(room).save(folder / "swiftwrf_paper")
    CoarrayModel().fit(room).save(folder / "coarray")
    return folder


def _changed(file, change):
    """The file with its header and tensors changed."""
    with_kind = {model.name: model.kind for model in (SwiftWRF, SwiftWRFPaper, CoarrayModel)}[file.name]
    kind, tensors, header = read(file, with_kind)
    change(tensors, header)
    write(file.with_name("changed"), kind, tensors, header)
    return file.with_name("changed")


def _set(*keys, to):
    def change(tensors, header):
        place = header
        for key in keys[:-1]:
            place = place[key]
        place[keys[-1]] = to

    return change


def _tensor(name, to):
    return lambda tensors, header: tensors.__setitem__(name, to(tensors[name]))


DAMAGE = {
    "swiftwrf": [
        _set("options", "n_primitives", to=-1),
        _set("options", "unknown", to=2),
        _set("options", to=None),
        _set("calibration", to=-1.0),
        _set("calibration", to=float("nan")),
        _set("calibration", to="x"),
        _set("kernel", "long", to=float("nan")),
        _set("kernel", "long", to="x"),
        _set("grid", "n_azimuth", to=10**12),
        _set("grid", "n_azimuth", to=0),
        _set("grid", "elevation_step", to=float("inf")),
        _tensor("mean", lambda t: t[:-1]),
        _tensor("mean", lambda t: t * torch.nan),
        _tensor("cholesky", lambda t: t[:, :2]),
        _tensor("weight", lambda t: t[:-1]),
        _tensor("coefficient", lambda t: t[:, :1]),
        _tensor("position", lambda t: t[:1]),
        lambda tensors, header: tensors.pop("mean"),
        lambda tensors, header: tensors.pop("position"),
        lambda tensors, header: header.clear(),
    ],
    "swiftwrf_paper": [
        _set("options", "steps", to=0),
        _tensor("primitives.mean", lambda t: t[:-1]),
        _tensor("primitives.mean", lambda t: t * torch.nan),
        _tensor("scale", torch.zeros_like),
        _tensor("layers.2.weight", lambda t: t[:1, :1]),
        _tensor("output.bias", lambda t: t[:0]),
        lambda tensors, header: tensors.pop("primitives.mean"),
        lambda tensors, header: tensors.pop("output.weight"),
        lambda tensors, header: tensors.__setitem__("more", torch.zeros(1)),
        lambda tensors, header: header.clear(),
    ],
    "coarray": [
        _set("link", "array", "wavelength", to=0),
        _set("link", "array", "wavelength", to="x"),
        _set("link", "array", "element", to=[]),
        _set("link", "array", "element", to=[[0.0, 0.0]] * 100_000),
        _set("link", "array", to={}),
        _set("link", to=None),
        _set("grid", to=3),
        _set("kernel", "share", to=7),
        _tensor("position", lambda t: t[:, :2]),
        _tensor("coefficient", lambda t: t * torch.inf),
        _tensor("form", lambda t: t[:-1]),
        _tensor("offset", lambda t: t.repeat(2)),
        lambda tensors, header: header.pop("link"),
    ],
}


@pytest.mark.parametrize(("kind", "number"), [(kind, i) for kind, all_ in DAMAGE.items() for i in range(len(all_))])
def test_damaged_models_are_refused(models, kind, number):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(InputError) as refused:
        load(_changed(models / kind, DAMAGE[kind][number]))
    assert len(str(refused.value)) <= 300
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 2**20  # KiB


def test_models_whose_parameters_overflow_are_refused(models, room):
    model = load(_changed(models / "coarray", _tensor("form", lambda t: 3e38 * t.sign())))
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


def test_estimators_are_opened_with_swiftwrf_alone(tmp_path):
    """The entry points of pyproject.toml suffice, as in an installation."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    points = project["entry-points"]["swiftwrf.estimators"]
    install(tmp_path, "swiftwrf.estimators", **points)
    import augment.estimators  # noqa: F401 (defines the kinds)

    kinds = {kind for kind, made in Saved.kinds.items() if made.__module__.startswith("augment.estimators")}
    assert kinds
    script = "import swiftwrf; from swiftwrf.runtime import checkpoint; checkpoint._import_kinds()"
    script += "; print(*checkpoint.Saved.kinds, sep='|')"
    path = os.pathsep.join([str(tmp_path), str(ROOT)])
    opened = subprocess.run(
        [sys.executable, "-c", script],
        capture_output=True,
        text=True,
        check=True,
        env=os.environ | {"PYTHONPATH": path},
    )
    assert kinds <= set(opened.stdout.strip().split("|"))
