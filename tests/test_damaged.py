"""Files that are damaged, foreign, or ask for more than they hold; numbers that overflow; far coordinates."""

from __future__ import annotations

import io
import os
import resource
import subprocess
import sys
import zipfile
import zlib
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from augment import SYNTHESIZERS, Settings
from swiftwrf import (
    AngularGrid,
    CoarrayModel,
    FitConfig,
    InputError,
    ModelConfig,
    fit,
    fit_coarray,
    load,
    load_rssi,
    load_spectra,
    rssi_room,
)
from swiftwrf.arrays import PlanarArray
from swiftwrf.checkpoint import read, write
from swiftwrf.data.spectra import coarsening
from swiftwrf.gp import Kernel
from tasks.rssi.predictors import PREDICTORS
from tasks.rssi.predictors import Settings as PredictorSettings

TINY = FitConfig(model=ModelConfig(n_primitives=4, rank=2), steps=10, check_every=5)
N = 12


def paths(folder, **changes):
    """Paths of twelve receivers, some arrays replaced."""
    arrays = {
        "transmitter_position": np.tile([0.0, 0.0, 2.0], (N, 1)),
        "receiver_position": np.stack([np.arange(1.0, N + 1), np.zeros(N), np.ones(N)], axis=1),
        "path_count": np.ones(N, dtype=np.int32),
        "last_point": np.tile([0.0, 0.0, 2.0], (N, 1)),
        "gain": np.ones(N, dtype=np.complex64),
        "line_of_sight": np.ones(N, dtype=bool),
        "frequency_hz": np.float64(2.4e9),
    } | changes
    folder.mkdir(exist_ok=True)
    np.savez(folder / "paths.npz", **arrays)
    return folder


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"last_point": np.stack([np.arange(1.0, N + 1), np.zeros(N), np.ones(N)], axis=1)}, "no direction"),
        ({"frequency_hz": np.float64(1e-320)}, "carrier"),
        ({"receiver_position": np.tile([0.0, 0.0, 2.0], (N, 1))}, "at one place"),
        ({"gain": np.zeros(N, dtype=np.complex64)}, "gain other than 0"),
        ({"gain": np.full(N, 1e300)}, "amplitudes"),
        ({"transmitter_position": np.full((N, 3), 1e300)}, "beyond"),
        ({"path_count": np.float64(1)}, "path_count"),
        ({"path_count": np.full(N, np.nan)}, "path_count"),
        ({"path_count": np.int32(3)}, "path_count"),
        ({"path_count": np.full(N, 2**62)}, "calls for"),
        ({"gain": np.array(["a"] * N)}, "plain numbers"),
        ({"transmitter_position": np.ones((N, 3), dtype=complex)}, "complex"),
    ],
)
def test_paths_that_say_nothing_are_refused(tmp_path, changes, says):
    with pytest.raises(InputError, match=says):
        load_spectra(paths(tmp_path / "p", **changes))


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.uint32, np.uint64, ">i4"])
def test_paths_in_other_precisions(tmp_path, dtype):
    usual = load_spectra(paths(tmp_path / "a"))
    single = np.tile([0.0, 0.0, 2.0], (N, 1)).astype(np.float32)
    other = load_spectra(
        paths(tmp_path / "b", path_count=np.ones(N, dtype=dtype), transmitter_position=single, last_point=single)
    )
    torch.testing.assert_close(other.spectrum, usual.spectrum)
    torch.testing.assert_close(other.label, usual.label)


def _bomb(header):
    """A small npz whose first array claims or unpacks to much."""
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in ("receiver_position", "path_count", "last_point", "gain", "line_of_sight", "frequency_hz"):
            archive.writestr(f"{name}.npy", b"")
        archive.writestr("transmitter_position.npy", header)
    return content.getvalue()


def test_small_archives_that_claim_much_are_refused_before_memory_is_taken(tmp_path):
    (tmp_path / "paths.npz").write_bytes(_bomb(bytes(2**30 + 1)))
    assert (tmp_path / "paths.npz").stat().st_size < 2**21
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(InputError, match="unpacks to"):
        load_spectra(tmp_path)
    claim = io.BytesIO()
    np.lib.format.write_array_header_1_0(claim, {"descr": "<f8", "fortran_order": False, "shape": (10**12, 3)})
    (tmp_path / "paths.npz").write_bytes(_bomb(claim.getvalue()))
    with pytest.raises(InputError, match="claims"):
        load_spectra(tmp_path)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 2**20  # KiB


def _png(rows, columns, kind=b"IHDR"):
    """A PNG of zeros, written without its pixels ever being in memory."""

    def chunk(name, data):
        return len(data).to_bytes(4, "big") + name + data + zlib.crc32(name + data).to_bytes(4, "big")

    size = columns.to_bytes(4, "big") + rows.to_bytes(4, "big") + bytes([8, 0, 0, 0, 0])
    return b"\x89PNG\r\n\x1a\n" + chunk(kind, size) + chunk(b"IDAT", zlib.compress(b"")) + chunk(b"IEND", b"")


@pytest.fixture
def scene(tmp_path):
    """Twelve spectra in the NeRF2 layout."""
    folder = tmp_path / "scene"
    (folder / "spectrum").mkdir(parents=True)
    (folder / "gateway_info.yml").write_text("g:\n  position: [0, 0, 0]\n  orientation: [0, 0, 0, 1]\n")
    (folder / "tx_pos.csv").write_text("x,y,z\n" + "".join(f"{i},1,1\n" for i in range(N)))
    for i in range(N):
        Image.fromarray(np.full((8, 32), i, np.uint8)).save(folder / "spectrum" / f"{i + 1:05d}.png")
    return folder


def test_every_file_counts_as_input(scene):
    before = load_spectra(scene).source
    Image.fromarray(np.full((8, 32), 99, np.uint8)).save(scene / "spectrum" / "00007.png")
    after = load_spectra(scene).source
    assert {name for name in before if before[name] != after[name]} == {"spectrum/*.png"}


def test_large_images_are_refused_before_they_are_decoded(scene):
    for i in range(N):
        (scene / "spectrum" / f"{i + 1:05d}.png").write_bytes(_png(5000, 20000))
    with pytest.raises(InputError, match="average them down"):
        load_spectra(scene)


@pytest.mark.parametrize("kind", ["EPS", "BMP", "TIFF", "GIF"])
def test_other_formats_called_png_are_not_opened(scene, kind):
    Image.fromarray(np.zeros((8, 32), np.uint8)).save(scene / "spectrum" / "00001.png", format=kind)
    with pytest.raises(InputError, match="not a complete PNG"):
        load_spectra(scene)


def _rssi(folder, names="a,b", position="a: [0, 0, 1]\nb: [5, 0, 1]\n"):
    folder.mkdir(exist_ok=True)
    (folder / "gateway_position.yml").write_text(position)
    (folder / "tx_pos.csv").write_text("x,y,z\n" + "".join(f"{i},1,1\n" for i in range(N)))
    (folder / "gateway_rssi.csv").write_text(names + "\n" + "-50,-60\n" * N)
    return folder


@pytest.mark.parametrize(
    ("file", "content", "says"),
    [
        ("tx_pos.csv", "x,y,z\n\xe4,1,1\n".encode("latin-1"), "UTF-8"),
        ("tx_pos.csv", "x,y,z\n1,1,1\n".encode("utf-16"), "UTF-8"),
        ("gateway_position.yml", "\xe4: [1, 2, 3]".encode("latin-1"), "UTF-8"),
        ("train_index.txt", "1\n".encode("utf-16"), "UTF-8"),
        ("train_index.txt", b"1_0\n", "whole number"),
        ("train_index.txt", b"9" * 5000, "whole number"),
        ("tx_pos.csv", b"x,y,z\n1_0,1,1\n", "text"),
        ("tx_pos.csv", b"x,y,z\n1e10,1,1\n", "at most"),
        ("tx_pos.csv", b'x,y,z\n"' + b"1" * 200_000 + b'",1,1\n', "comma-separated"),
        ("gateway_rssi.csv", b"a,\n" + b"-50,-60\n" * N, "no name for column 2"),
        ("gateway_position.yml", b"a: '123'\nb: [5, 0, 1]\n", "'a' needs a position"),
        ("gateway_position.yml", b"a: 2001-99-99\nb: [5, 0, 1]\n", "'a' needs a position"),
        ("gateway_position.yml", b"a: [0, 0, " + b"9" * 5000 + b"]\nb: [5, 0, 1]\n", "'a' needs a position"),
        ("gateway_position.yml", b"a: " + b"[" * 5000 + b"]" * 5000, "not valid YAML"),
        ("gateway_position.yml", b"a: &a [*a]\nb: [1, 2, 3]", "not valid YAML"),
        ("gateway_position.yml", b"? [1, 2]\n: 3", "must be text"),
    ],
)
def test_text_files_are_refused_in_a_sentence(tmp_path, file, content, says):
    folder = _rssi(tmp_path / "data")
    (folder / "test_index.txt").write_text("1\n")
    (folder / "train_index.txt").write_text("0\n")
    (folder / file).write_bytes(content)
    with pytest.raises(InputError, match=says) as refused:
        load_rssi(folder)
    assert len(str(refused.value)) <= 300


def test_references_to_references_take_no_memory(tmp_path):
    lines = ["a0: &a0 [1, 2, 3]"] + [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 40)]
    folder = _rssi(tmp_path / "data", position="\n".join([*lines, "a: [0, 0, 1]", "b: *a0", ""]))
    assert load_rssi(folder).receiver_position[1].tolist() == [1, 2, 3]


def test_a_byte_order_mark_is_no_part_of_the_header(tmp_path):
    folder = _rssi(tmp_path / "data")
    for file in folder.iterdir():
        file.write_bytes(b"\xef\xbb\xbf" + file.read_bytes())
    assert len(load_rssi(folder)) == N


@pytest.mark.parametrize("name", ["NA", "1", "12:34:56", "2001-01-01", "null", "true", "1e5", "~"])
def test_receivers_have_the_names_they_have(tmp_path, name):
    folder = _rssi(tmp_path / "data", f"{name},b", f"{name}: [0, 0, 1]\nb: [5, 0, 1]\n")
    assert load_rssi(folder).receiver_names == (name, "b")


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


@pytest.mark.parametrize("name", [name for name in SYNTHESIZERS if name != "swiftwrf"])
def test_synthesizers_do_not_depend_on_the_origin(room, name):
    """Map coordinates lie thousands of kilometres from theirs."""
    train, test = room.split("random")
    drawn = []
    for shift in (0.0, 1e7):
        synthesizer = SYNTHESIZERS[name].make(Settings(progress=False))
        synthesizer.fit(replace(train, position=train.position + shift))
        drawn.append(synthesizer.synthesize(test.position + shift))
    torch.testing.assert_close(*drawn, atol=2e-3, rtol=0)  # positions at 1e7 m are rounded to 2e-9 m


def test_swiftwrf_does_not_depend_on_the_origin(room):
    drawn = [
        fit(replace(room, position=room.position + shift), TINY, progress=False).synthesize(room.position[:5] + shift)
        for shift in (0.0, 1e7)
    ]
    torch.testing.assert_close(*drawn, atol=2e-3, rtol=0)


@pytest.mark.parametrize("name", [name for name in PREDICTORS if name != "swiftwrf"])
def test_predictors_do_not_depend_on_the_origin(name):
    data, predicted = rssi_room(n=40).receivers(["1", "2"]), []
    for shift in (0.0, 1e7):
        moved = replace(
            data,
            transmitter_position=data.transmitter_position + shift,
            receiver_position=data.receiver_position + shift,
        )
        predictor = PREDICTORS[name].make(PredictorSettings())
        predictor.fit(moved)
        predicted.append(predictor.predict(moved.transmitter_position[:10]))
    torch.testing.assert_close(*predicted, atol=0.05, rtol=0)  # dB


@pytest.mark.parametrize("far", [1e12, 1e20, 1e200, 1e308])
@pytest.mark.parametrize("name", list(SYNTHESIZERS))
def test_far_positions_draw_finite_spectra(room, models, name, far):
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


def test_grids_arrays_and_kernels_refuse_what_they_cannot_be():
    nan = float("nan")
    with pytest.raises(InputError, match="ascend"):
        AngularGrid.degrees([nan, nan], range(360))
    with pytest.raises(InputError, match="ascend"):
        AngularGrid.degrees(range(90), [nan, nan])
    for frequency, spacing in ((nan, 0.1), (1e9, nan), (float("inf"), 0.1)):
        with pytest.raises(InputError):
            PlanarArray.square(4, frequency, spacing)
    for settings in ({"long": nan}, {"short": 0.0}, {"share": 2.0}, {"noise": -1.0}):
        with pytest.raises(InputError):
            Kernel(**settings)


def test_prime_numbers_of_rows_leave_the_network_something():
    from tasks.aoa.aann import LEAST_ROWS

    assert coarsening((89, 356), 120, LEAST_ROWS) == 1
    assert coarsening((90, 360), 120, LEAST_ROWS) == 3


def test_small_spectra_are_refused_before_the_training():
    from swiftwrf import simulated_room
    from tasks.aoa.config import AoaConfig, with_array

    with pytest.raises(InputError, match="7 x 7"):
        with_array(simulated_room(n=20, grid=AngularGrid.hemisphere(4, 16)), AoaConfig((0.5,)))


def test_an_installation_without_a_place_for_caches(tmp_path):
    """Numba keeps what it compiled beside the source or in the home; where it can do neither, it must do without."""
    code = (
        "import numba.core.caching as c\n"
        "c._Cache._impl_class = None\n"
        "for l in c.CacheImpl._locator_classes: l.from_function = classmethod(lambda *a: None)\n"
        "import swiftwrf.rasterize.cpu\nprint('imported')"
    )
    child = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        env=os.environ | {"PYTHONPATH": os.getcwd()},
        check=False,
    )
    assert "imported" in child.stdout, child.stderr[-500:]
