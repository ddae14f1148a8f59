"""Model files and states of fits that are damaged or ask for more than they hold; what models draw at their limits."""

from __future__ import annotations

import resource

import pytest
import torch

from augment import SYNTHESIZERS, Settings
from swiftwrf import (
    CoarrayModel,
    FitConfig,
    InputError,
    ModelConfig,
    fit,
    fit_coarray,
    load,
)
from swiftwrf.runtime.checkpoint import read, write

TINY = FitConfig(model=ModelConfig(n_primitives=4, rank=2), steps=10, check_every=5)


@pytest.fixture(scope="module")
def models(room, tmp_path_factory):
    """A file of each kind of model."""
    folder = tmp_path_factory.mktemp("models")
    fit(room, TINY, progress=False).save(folder / "swiftwrf")
    fit_coarray(room, progress=False).save(folder / "coarray")
    return folder


def _changed(file, change):
    """The file with its header and tensors changed."""
    with_kind = {"swiftwrf": "swiftwrf model", "coarray": CoarrayModel.kind}[file.name]
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
        _set("config", "n_primitives", to=200_000_000),
        _set("config", "n_primitives", to="auto"),
        _set("config", "n_primitives", to=4.0),
        _set("config", "n_primitives", to=-1),
        _set("config", "rank", to=10**9),
        _set("config", "deformation", to="none"),
        _set("config", "deformation", to="per_primitive_mlp"),
        _set("config", "deformation", to="other"),
        _set("config", "components", to=["mean", "mean"]),
        _set("config", "components", to=3),
        _set("config", "cutoff", to=2),
        _set("config", "unknown", to=2),
        _set("config", to=None),
        _set("kernel", "long", to=float("nan")),
        _set("kernel", "long", to="x"),
        _set("grid", "n_azimuth", to=10**12),
        _set("grid", "n_azimuth", to=0),
        _set("grid", "elevation_step", to=float("inf")),
        _tensor("primitives.mean", lambda t: t[:-1]),
        _tensor("primitives.mean", lambda t: t * torch.nan),
        _tensor("scale", torch.zeros_like),
        _tensor("deformation.field.whiten", lambda t: t[:1, :1]),
        _tensor("deformation.basis", lambda t: t[:, :, :0]),
        lambda tensors, header: tensors.pop("primitives.mean"),
        lambda tensors, header: tensors.pop("deformation.field.anchor"),
        lambda tensors, header: tensors.__setitem__("more", torch.zeros(1)),
        lambda tensors, header: header.clear(),
    ],
    "coarray": [
        _set("wavelength", to=0),
        _set("wavelength", to="x"),
        _set("grid", to=3),
        _set("kernel", "share", to=7),
        _tensor("anchor", lambda t: t[:, :2]),
        _tensor("readout", lambda t: t * torch.inf),
        _tensor("form", lambda t: t[:-1]),
        _tensor("offset", lambda t: t.repeat(2)),
        _tensor("element", lambda t: t[:0]),
        _tensor("element", lambda t: t.new_zeros(100_000, 2)),
        lambda tensors, header: tensors.pop("element"),
    ],
}


@pytest.mark.parametrize(("kind", "number"), [(kind, i) for kind, all_ in DAMAGE.items() for i in range(len(all_))])
def test_damaged_models_are_refused(models, kind, number):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(InputError) as refused:
        load(_changed(models / kind, DAMAGE[kind][number]))
    assert len(str(refused.value)) <= 300
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 2**20  # KiB


def test_models_whose_numbers_overflow_draw_nothing(models, room):
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
    fit(room, TINY, progress=False, checkpoint=state)
    kind, tensors, header = read(state, "fit state")
    for change in ({"losses": None}, {"records": 3}, {"step": "x"}, {"fingerprint": 1}):
        write(state, kind, tensors, header | change)
        with pytest.raises(InputError):
            fit(room, TINY, progress=False, checkpoint=state)
    write(state, kind, {name: t for name, t in tensors.items() if "mean" not in name}, header)
    with pytest.raises(InputError):
        fit(room, TINY, progress=False, checkpoint=state)


def test_an_interrupted_fit_has_its_whole_history(room, tmp_path):
    class Cut(Exception):
        pass

    whole, first, second = [], [], []
    fit(room, TINY, progress=False, on_record=whole.append)

    def cut(record):
        first.append(record)
        raise Cut

    with pytest.raises(Cut):
        fit(room, TINY, progress=False, checkpoint=tmp_path / "state", on_record=cut)
    fit(room, TINY, progress=False, checkpoint=tmp_path / "state", on_record=second.append)
    assert [(r["step"], r["loss"]) for r in second] == [(r["step"], r["loss"]) for r in whole]
    assert second[0] == first[0]
    elapsed = [record["elapsed"] for record in second]
    assert elapsed == sorted(elapsed)
    assert elapsed[1] > elapsed[0] >= first[0]["seconds"]


@pytest.mark.parametrize("far", [1e12, 1e20, 1e200, 1e308])
@pytest.mark.parametrize("name", list(SYNTHESIZERS))
def test_far_positions_draw_finite_spectra(room, models, small_published, glances, name, far):
    if name in ("swiftwrf", "coarray"):
        synthesize = load(models / name).synthesize
    else:
        synthesizer = SYNTHESIZERS[name].make(Settings(progress=False))
        synthesizer.fit(room)
        synthesize = synthesizer.synthesize
    assert synthesize(torch.full((1, 3), far, dtype=torch.float64)).isfinite().all()


@pytest.mark.parametrize("batch", [0, -1])
def test_a_batch_has_positions(models, room, batch):
    for name in ("swiftwrf", "coarray"):
        with pytest.raises(InputError, match="batch"):
            load(models / name).synthesize(room.position[:3], batch=batch)
