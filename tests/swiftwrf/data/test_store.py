"""Spectra as they were measured: float32 by the batch, many of them in a file of the cache."""

import os
import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image
from samples import write_nerf2

from swiftwrf import AngularGrid, InputError, load, load_spectra, positions, simulated_room
from swiftwrf.data import store
from swiftwrf.data.formats import nerf2
from swiftwrf.data.spectra import check_training, fingerprint
from swiftwrf.data.store import Store, stored
from swiftwrf.gp import Kernel, principal_components, process
from swiftwrf.metrics import psnr
from swiftwrf.models import make_model, neighbours
from swiftwrf.models.geometry import HybridModel, hybrid
from swiftwrf.positions import distance, nearest
from swiftwrf.runtime.durable import cache_folder

N = 30
BYTES = torch.arange(N * 4 * 8, dtype=torch.int64).remainder(256).to(torch.uint8).reshape(N, 4, 8)


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """An own cache, where thirty spectra are many and come ten at a time."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(store, "MIN_FILE_SPECTRA", N)
    monkeypatch.setattr(store, "BATCH_PIXELS", 10 * 4 * 8)
    return tmp_path / "cache" / "swiftwrf"


@pytest.fixture
def folder(tmp_path):
    """Thirty images in the NeRF2 layout."""
    return write_nerf2(tmp_path / "scene", [image(i) for i in range(N)])


def image(seed):
    return np.random.default_rng(seed).integers(0, 256, (4, 16), dtype=np.uint8)


def write_image(scene, i, seed):
    Image.fromarray(image(seed)).save(scene / "spectrum" / f"{i + 1:05d}.png")


def test_bytes_become_what_they_always_became(monkeypatch):
    monkeypatch.setattr(store, "BATCH_PIXELS", 7 * 4 * 8)
    kept = Store(BYTES)
    expected = BYTES.float() / 255
    assert torch.equal(kept[:], expected)
    assert torch.equal(torch.cat(list(kept.batches())), expected)
    assert [len(part) for part in kept.batches()] == [7, 7, 7, 7, 2]
    torch.testing.assert_close(kept.mean(), expected.mean(dim=0))


@pytest.mark.parametrize("dtype", [torch.uint8, torch.float16, torch.float32])
def test_rows_and_averages_are_taken_where_they_are_looked_at(dtype):
    values = BYTES if dtype == torch.uint8 else (BYTES / 255).to(dtype)
    kept, rows = Store(values), torch.tensor([20, 3, 3, 7])
    some = kept.subset(rows).coarsen(2)
    whole = torch.nn.functional.avg_pool2d(kept[:][rows][:, None], 2)[:, 0]
    assert some.values.data_ptr() == values.data_ptr()
    assert some.shape == (4, 2, 4)
    assert torch.equal(some[:], whole)
    assert torch.equal(some.subset(torch.tensor([False, True, False, True]))[:], whole[[1, 3]])
    assert some.exact()[0] == torch.float32
    assert kept.exact()[0] == dtype


def test_digest_is_of_content_and_order():
    rows = torch.tensor([2, 5, 9])
    assert Store(BYTES, rows).digest() == Store(BYTES[rows]).digest()
    assert len({Store(BYTES, r).digest() for r in (rows, rows.flip(0), rows[:2], None)}) == 4
    assert Store(BYTES).digest() != Store(BYTES, factor=2).digest() != Store(BYTES.half()).digest()


def test_many_images_lie_in_a_file_that_is_reused(cache, folder, monkeypatch):
    data = load_spectra(folder)
    (file,) = cache.glob("*")
    assert np.load(file, mmap_mode="r").dtype == np.uint8
    monkeypatch.setattr(store, "MIN_FILE_SPECTRA", N + 1)
    assert torch.equal(data.spectrum, load_spectra(folder).spectrum)
    assert fingerprint(data) == fingerprint(load_spectra(folder))

    monkeypatch.setattr(store, "MIN_FILE_SPECTRA", N)
    decode, decoded = nerf2._decode, []
    monkeypatch.setattr(nerf2, "_decode", lambda file, *size: decoded.append(file.name) or decode(file, *size))
    assert torch.equal(load_spectra(folder).spectrum, data.spectrum)
    assert decoded == ["00001.png"]  # for the shape


def test_other_images_make_another_file(cache, folder):
    before = load_spectra(folder).spectrum
    write_image(folder, 4, 99)
    after = load_spectra(folder).spectrum
    assert (before != after).flatten(1).any(1).nonzero().flatten().tolist() == [4]
    assert len(list(cache.glob("spectra-*"))) == 2


@pytest.mark.parametrize("damage", [b"", b"nonsense", None])
def test_a_damaged_file_is_made_anew(cache, folder, damage):
    spectrum = load_spectra(folder).spectrum.clone()
    (file,) = cache.glob("*")
    file.write_bytes(file.read_bytes()[:-1] if damage is None else damage)
    assert torch.equal(load_spectra(folder).spectrum, spectrum)


def test_nothing_is_left_of_a_file_that_could_not_be_made(cache):
    def batches():
        yield BYTES[:10]
        raise InputError("no more")

    with pytest.raises(InputError, match="no more"):
        stored(tuple(BYTES.shape), torch.uint8, lambda: "key", batches)
    assert list(cache.glob("*")) == []


def test_a_cache_without_room_is_refused(cache, folder, monkeypatch):
    monkeypatch.setattr(store.shutil, "disk_usage", lambda _: SimpleNamespace(free=1))
    with pytest.raises(InputError, match="XDG_CACHE_HOME"):
        load_spectra(folder)


def test_a_cache_that_cannot_be_written_is_refused(cache, folder):
    cache.parent.write_text("in the way")
    with pytest.raises(InputError, match="cannot be written"):
        load_spectra(folder)


def test_what_nobody_used_for_a_month_goes(cache, folder):
    load_spectra(folder)
    (unused,) = cache.glob("*")
    left, other = cache / ".spectra-1.npy.123", cache / "rasterize-1"
    left.write_text("of a process that was killed")
    other.write_text("not ours")
    write_image(folder, 0, 99)
    load_spectra(folder)
    assert unused.exists()
    old = time.time() - 86_400 * 31
    for file in (unused, left, other):
        os.utime(file, (old, old))
    write_image(folder, 0, 98)
    load_spectra(folder)
    assert not unused.exists()
    assert not left.exists()
    assert other.exists()


@pytest.mark.parametrize("dtype", [np.uint8, np.float16, np.float32, np.float64, ">f4"])
@pytest.mark.parametrize("suffix", ["npy", "npz"])
@pytest.mark.parametrize("order", ["C", "F"])
def test_arrays_are_kept_as_they_came(cache, folder, dtype, suffix, order):
    values = BYTES.numpy() if dtype == np.uint8 else (BYTES / 255).numpy().astype(dtype)
    for file in (folder / "spectrum").glob("*"):
        file.unlink()
    (folder / "spectrum").rmdir()
    values = np.asarray(values, order=order)
    file = folder / f"spectrum.{suffix}"
    np.save(file, values) if suffix == "npy" else np.savez(file, spectrum=values)
    data = load_spectra(folder)
    expected = {np.uint8: torch.uint8, np.float16: torch.float16}.get(dtype, torch.float32)
    assert data.store.values.dtype == expected
    torch.testing.assert_close(data.spectrum, BYTES / 255, atol=5e-4 if dtype == np.float16 else 1e-7, rtol=0)
    assert len(list(cache.glob("spectra-*"))) == 1


def test_many_simulated_spectra_are_those_of_memory(cache, monkeypatch):
    many = simulated_room(n=N, grid=AngularGrid.hemisphere(4, 8))
    assert len(list(cache.glob("spectra-*"))) == 1
    monkeypatch.setattr(store, "MIN_FILE_SPECTRA", N + 1)
    torch.testing.assert_close(many.spectrum, simulated_room(n=N, grid=AngularGrid.hemisphere(4, 8)).spectrum)


def test_all_at_once_is_refused_where_it_does_not_fit(monkeypatch):
    data = simulated_room(n=N, grid=AngularGrid.hemisphere(4, 8))
    monkeypatch.setattr("swiftwrf.data.spectra.MAX_MEMORY_PIXELS", N * 4 * 8 - 1)
    with pytest.raises(InputError, match="by the batch"):
        _ = data.spectrum
    assert data.subset(torch.arange(5)).spectrum.shape == (5, 4, 8)


def test_what_is_not_finite_is_found_in_any_batch(cache):
    values = (BYTES / 255).clone()
    values[25, 1, 1] = torch.nan
    data = replace(simulated_room(n=N, grid=AngularGrid.hemisphere(4, 8)), store=Store(values))
    with pytest.raises(InputError, match="spectrum of training spectrum 25"):
        check_training(data)


def test_components_of_some_spectra_represent_all(generator):
    position, fold = torch.rand(200, 3, generator=generator, dtype=torch.float64), torch.arange(200) % 5
    low = torch.randn(200, 12, generator=generator) * torch.logspace(1, -1, 12)
    spectrum = (low @ torch.randn(12, 150, generator=generator) + 0.3).reshape(200, 10, 15)
    component = principal_components(position, spectrum, fold, Kernel(), omitted=1e-9, rows=60).flatten(1)
    assert len(component) == 13
    change, basis = spectrum.flatten(1) - component[0], torch.linalg.qr(component[1:].T).Q
    torch.testing.assert_close(change @ basis @ basis.T, change, atol=1e-3, rtol=1e-3)


def test_the_tree_finds_the_nearest(generator):
    known = torch.rand(positions.MIN_TREE_POSITIONS + 1, 3, generator=generator, dtype=torch.float64)
    asked = torch.rand(20, 3, generator=generator, dtype=torch.float64)
    apart, number = nearest(asked, known, 5)
    expected = distance(asked, known).topk(5, largest=False)
    torch.testing.assert_close(apart, expected.values)
    assert torch.equal(number, expected.indices)


@pytest.fixture
def exact(monkeypatch):
    """Sets from how many spectra on methods are no longer exact."""

    def to(n):
        for module, name in (
            (process, "MAX_EXACT"),
            (neighbours, "MAX_CHOICE_SPECTRA"),
            (positions, "MIN_TREE_POSITIONS"),
        ):
            monkeypatch.setattr(module, name, n)

    return to


def fitted(name, train):
    options = {"n_primitives": 24} if name == "swiftwrf" else {}  # the search for a size has its own tests
    return make_model(name, **options).fit(train)


@pytest.mark.parametrize("name", ["gp", "coarray", "swiftwrf", "idw", "nearest"])
def test_what_is_not_exact_predicts_nearly_as_well_and_comes_back_from_its_file(name, exact, short_fits, tmp_path):
    train, test = simulated_room(n=400, grid=AngularGrid.hemisphere(8, 32)).split()
    score = []
    for n in (400, 240):
        exact(n)
        model = fitted(name, train)
        score.append(float(psnr(model.synthesize(test.position), test.spectrum).median()))
    assert score[1] == pytest.approx(score[0], abs=0.5)
    model.save(tmp_path / "model.safetensors")
    again, prediction = load(tmp_path / "model.safetensors").predict(test.position), model.predict(test.position)
    for back, value in ((again.mean, prediction.mean), (again.std, prediction.std)):
        assert (back is None) == (value is None)
        assert back is None or float((back - value).abs().max()) <= (0 if name in ("coarray", "swiftwrf") else 1e-6)


def test_inner_products_of_too_many_spectra_are_refused(room, monkeypatch):
    monkeypatch.setattr(hybrid, "MAX_SPECTRA", 39)
    with pytest.raises(InputError, match="at most 39"):
        HybridModel().fit(room)


def test_a_user_without_home_directory_is_told_of_the_variable(monkeypatch):
    def home():
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr("pathlib.Path.home", home)
    with pytest.raises(InputError, match=r"no home directory .* set XDG_CACHE_HOME"):
        cache_folder()
