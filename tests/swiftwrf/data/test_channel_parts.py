"""Channels as other programs store them: parts, pairs, carriers of rows, several arrays, and structures of MATLAB."""

import numpy as np
import pytest
from samples import snapshot_arrays, snapshots, write_snapshots
from scipy.io import savemat

import swiftwrf
from swiftwrf import InputError


@pytest.fixture(scope="module")
def known():
    return snapshot_arrays(snapshots())


def channel(folder):
    return swiftwrf.load_snapshots(folder).channel


@pytest.mark.parametrize(
    "parts",
    [
        lambda csi: {"csi_abs": abs(csi), "csi_angle": np.angle(csi)},
        lambda csi: {"amplitude": abs(csi), "phase_deg": np.rad2deg(np.angle(csi))},
        lambda csi: {"magnitude": abs(csi), "phase_rad": np.angle(csi) + 40 * np.pi},
        lambda csi: {"csi_real": csi.real, "csi_imag": csi.imag},
        lambda csi: {"h_real": csi.real, "h_imag": csi.imag},
        lambda csi: {"I": csi.real, "Q": csi.imag},
        lambda csi: {"csi": np.stack([csi.real, csi.imag], axis=-1)},
        lambda csi: {"csi": np.stack([csi.real, csi.imag], axis=-1).reshape(*csi.shape[:-1], -1)},
    ],
    ids=["abs, angle", "degrees", "unwrapped", "real, imag", "h", "I, Q", "pairs", "pairs in turn"],
)
def test_two_parts_are_one_channel(tmp_path, known, parts):
    plain = channel(write_snapshots(tmp_path / "plain"))
    found = channel(write_snapshots(tmp_path / "parts", **{"csi": None, **parts(known["csi"])}))
    np.testing.assert_allclose(found.numpy(), plain.numpy(), atol=1e-4)


def test_a_phase_of_unknown_unit_is_refused(tmp_path, known):
    csi = known["csi"]
    parts = {"csi": None, "amplitude": abs(csi), "phase": np.rad2deg(np.angle(csi))}
    with pytest.raises(InputError, match="name it phase_deg, or phase_rad if it is unwrapped"):
        channel(write_snapshots(tmp_path / "data", **parts))


def test_what_a_file_holds_is_said(tmp_path):
    with pytest.raises(InputError, match=r"lacks csi; it must hold csi.* and holds array_orientation.*, matrix"):
        channel(write_snapshots(tmp_path / "data", csi=None, matrix=np.ones((3, 3))))


def test_a_carrier_for_each_row(tmp_path, known):
    carrier = np.linspace(2.40e9, 2.48e9, len(known["position"]))
    found = swiftwrf.load_snapshots(write_snapshots(tmp_path / "data", csi=known["csi"][:, 0], frequency_hz=carrier))
    assert found.array.frequency_hz == pytest.approx(2.44e9)
    assert "each row has its carrier, 2.4 to 2.48 GHz" in " ".join(found.notes)
    assert "up to 1.6% off" in " ".join(found.notes)


def test_several_arrays_in_one_file_are_stations(tmp_path, known):
    csi = np.stack([known["csi"], 1j * known["csi"]], axis=1)
    pose = {name: np.stack([known[name], known[name]]) for name in ("array_position", "array_orientation")}
    pose["array_position"][1] += 0.5
    folder = write_snapshots(tmp_path / "data", csi=csi, **pose)
    found = swiftwrf.load_stations(folder)
    assert found.names == ["array1", "array2"]
    apart = found.of("array2")[1].fixed_position - found.of("array1")[1].fixed_position
    assert apart.tolist() == pytest.approx([0.5, 0.5, 0.5])
    with pytest.raises(InputError, match="describes 2 arrays; choose one by its number"):
        swiftwrf.load_snapshots(folder)
    assert len(swiftwrf.load_snapshots(folder, station=2)) == len(known["position"])


def test_elements_in_wavelengths_are_named(tmp_path):
    element = np.stack(np.meshgrid(np.arange(4) / 2, np.arange(4) / 2), axis=-1).reshape(16, 2)
    given = snapshot_arrays(snapshots()) | {"csi": np.ones((12, 1, 16), dtype=np.complex64)}
    given |= {"position": given["position"][:12], "element_position": element, "frequency_hz": np.float64(5.2e9)}
    for name in ("rows", "columns", "spacing_m"):
        given[name] = None
    found = swiftwrf.load_snapshots(write_snapshots(tmp_path / "data", **given))
    assert "if element_position is in wavelengths, multiply it by 0.05765 m" in " ".join(found.notes)


@pytest.mark.parametrize("compressed", [False, True])
def test_one_structure_holds_the_arrays(tmp_path, known, compressed):
    plain = channel(write_snapshots(tmp_path / "plain"))
    (tmp_path / "data").mkdir()
    savemat(tmp_path / "data" / "snapshots.mat", {"dataset": known}, do_compression=compressed)
    np.testing.assert_allclose(channel(tmp_path / "data").numpy(), plain.numpy(), atol=1e-6)


def test_an_archive_of_another_name_is_read_and_an_unknown_one_is_described(tmp_path, known):
    plain = channel(write_snapshots(tmp_path / "plain"))
    folder = write_snapshots(tmp_path / "other")
    (folder / "snapshots.npz").rename(folder / "monday.npz")
    assert channel(folder).equal(plain)
    unknown = tmp_path / "unknown"
    unknown.mkdir()
    np.savez(unknown / "monday.npz", **{"H" if name == "csi" else name: values for name, values in known.items()})
    for source in (unknown, unknown / "monday.npz"):
        with pytest.raises(InputError, match=r"H, array_orientation, .* give --arrays csi=NAME"):
            swiftwrf.load_snapshots(source)


@pytest.mark.parametrize("form", ["(n, S, 4, 4)", "(n, 4, 4, S)", "(n, 4, 4)"])
def test_elements_on_two_axes_are_refused_with_what_makes_them_one(tmp_path, known, form):
    csi = known["csi"] if form != "(n, 4, 4)" else known["csi"][:, 0]
    apart = csi.reshape(*csi.shape[:-1], 4, 4)
    apart = apart.transpose(0, 2, 3, 1) if form == "(n, 4, 4, S)" else apart
    with pytest.raises(InputError, match=r"axes . and . hold 4 x 4 of them: give csi.reshape") as refusal:
        channel(write_snapshots(tmp_path / "apart", csi=apart))
    mended = eval(str(refusal.value).split("give ")[1], {"csi": apart})
    np.testing.assert_array_equal(mended, csi)
