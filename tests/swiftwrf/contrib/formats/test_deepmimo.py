"""DeepMIMO v4 folders: conventions of angles and phases, and what is refused."""

import numpy as np
import pytest
import torch
from samples import FREQUENCY, WAVELENGTH, write_deepmimo

from swiftwrf import AngularGrid, InputError, load_spectra
from swiftwrf.array.planar import LIGHT_SPEED, PlanarArray
from swiftwrf.data.simulated import ShoeboxRoom

GRID = AngularGrid.hemisphere(24, 96)


def load(folder, **changes):
    return load_spectra(write_deepmimo(folder, **changes), grid=GRID)


def passband(arrays):
    """Phases without the propagation, as a ray tracer of passband coefficients gives them."""
    return arrays["phase"] + 360 * FREQUENCY * arrays["delay"]


def test_spectra_are_those_of_the_traced_paths(tmp_path):
    data = load(tmp_path / "town")
    paths = ShoeboxRoom(frequency_hz=FREQUENCY).paths(data.fixed_position, data.position)
    array = PlanarArray.square(4, FREQUENCY)
    expected = array.spectrum(paths.channel(array), GRID)
    assert torch.equal(data.line_of_sight, paths.line_of_sight)
    torch.testing.assert_close(data.spectrum, expected, atol=2e-3, rtol=0)
    assert (data.moving, data.name, data.notes) == ("receiver", "town", ())
    assert data.fixed_position.tolist() == pytest.approx([3, 2.5, 2.7], abs=1e-6)


def test_interactions_tell_line_of_sight(tmp_path):
    """Diffracted paths that are 0.5 % longer than the distance are no line of sight."""

    def longer(arrays):
        distance = np.linalg.norm(arrays["tx_pos"] - arrays["rx_pos"], axis=1)[:, None] / LIGHT_SPEED
        return np.where(np.arange(25) == 0, 1.005 * distance, arrays["delay"])

    diffracted = {"delay": longer, "inter": lambda a: np.where(np.arange(25) == 0, 2, a["inter"])}
    assert not load(tmp_path / "a", **diffracted).line_of_sight.any()
    guessed = load(tmp_path / "b", delay=longer, inter=None)
    assert guessed.line_of_sight.all()
    assert any("no interactions (inter)" in note for note in guessed.notes)


@pytest.mark.parametrize(
    ("change", "noted"),
    [
        ({"phase": passband}, "passband"),
        ({"phase": lambda a: -a["phase"]}, "reversed"),
        ({"aoa_el": lambda a: 90 - a["aoa_el"]}, "90 - aoa_el is taken"),
    ],
    ids=["passband phases", "reversed phases", "elevations from the horizon"],
)
def test_other_conventions_give_the_same_spectra_and_are_noted(tmp_path, change, noted):
    usual, other = load(tmp_path / "a"), load(tmp_path / "b", **change)
    torch.testing.assert_close(other.spectrum, usual.spectrum, atol=2e-3, rtol=0)
    assert noted in other.notes[0]


@pytest.mark.parametrize(("tracer", "noted"), [("Sionna Ray Tracing", True), ("Remcom Wireless Insite", False)])
def test_without_direct_paths_the_ray_tracer_tells(tmp_path, tracer, noted):
    blocked = {key: lambda a, k=key: np.where(np.arange(25) == 0, np.nan, a[k]) for key in
               ("power", "phase", "delay", "aoa_az", "aoa_el", "inter")}  # fmt: skip
    data = load(tmp_path / "a", tracer=tracer, **blocked)
    assert any("passband" in note for note in data.notes) == noted
    assert not data.line_of_sight.any()


def test_negative_elevations_count_from_the_horizon_where_direct_paths_are_missing(tmp_path):
    blocked = {"inter": lambda a: np.ones_like(a["inter"]), "delay": lambda a: a["delay"] * 1.2}
    usual = load(tmp_path / "a", **blocked)
    other = load(tmp_path / "b", **blocked, aoa_el=lambda a: 90 - a["aoa_el"])
    torch.testing.assert_close(other.spectrum, usual.spectrum, atol=2e-3, rtol=0)


def test_receivers_without_paths_are_left_out_and_counted(tmp_path):
    def gap(key):
        return lambda a: np.where(np.arange(30)[:, None] == 4, np.nan, a[key])

    data = load(tmp_path / "a", **{key: gap(key) for key in ("power", "phase", "delay", "aoa_az", "aoa_el")})
    assert data.index.tolist() == [i for i in range(30) if i != 4]
    assert data.notes == ("receivers without a path are left out: 1",)


def test_another_array_and_every_second_receiver(tmp_path):
    folder = write_deepmimo(tmp_path / "a")
    data = load_spectra(folder, array=PlanarArray.grid(2, 8, WAVELENGTH / 2, FREQUENCY), grid=GRID, every=2)
    assert (len(data), len(data.array.element), data.index[1].item()) == (15, 16, 2)
    with pytest.raises(InputError, match="carrier"):
        load_spectra(folder, array=PlanarArray.square(4, 5e9))


def test_one_of_several_pairs(tmp_path):
    folder = write_deepmimo(tmp_path / "a")
    for file in list(folder.glob("*_t000_tx000_r001.npz")):
        (folder / file.name.replace("tx000", "tx001")).write_bytes(file.read_bytes())
    with pytest.raises(InputError, match=r"2 pairs.*station"):
        load_spectra(folder)
    assert len(load_spectra(folder, station=2, grid=GRID)) == 30
