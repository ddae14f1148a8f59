"""Array snapshots: what is read from npz and HDF5, and everything that is refused."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from samples import FREQUENCY, WAVELENGTH, snapshot_arrays, snapshots, write_snapshots
from scipy.io import savemat

from augment import Mixed
from augment.estimators import make_estimator
from swiftwrf import AngularGrid, InputError, load_snapshots, load_spectra
from swiftwrf.array.angles import angular_distance, to_direction
from swiftwrf.array.planar import PlanarArray
from swiftwrf.data.archives import read_arrays
from swiftwrf.metrics import angle_errors

GRID = AngularGrid.hemisphere(24, 96)


@pytest.mark.parametrize("name", ["snapshots.npz", "snapshots.h5"])
def test_reads_what_was_measured(tmp_path, name):
    made = snapshots()
    data = load_snapshots(write_snapshots(tmp_path / "walk", name, time=np.arange(120.0)))
    assert (data.name, len(data), data.channel.shape) == ("walk", 120, (120, 3, 16))
    torch.testing.assert_close(data.position, made.position)
    torch.testing.assert_close(data.rotation, made.rotation)
    assert data.array.wavelength == pytest.approx(WAVELENGTH)
    ratio = data.channel / made.channel  # of one size everywhere
    torch.testing.assert_close(ratio, ratio[:, :1, :1].expand_as(ratio), rtol=1e-4, atol=1e-4)
    assert data.time[5] == 5
    assert set(data.source) == {name}


@pytest.mark.parametrize("beamformer", ["phase", "bartlett", "capon"])
def test_spectra_peak_at_the_line_of_sight(tmp_path, beamformer):
    folder = write_snapshots(tmp_path / "walk", data=snapshots(n=40, count=20))
    data = load_spectra(folder, beamformer=beamformer, grid=GRID)
    assert data.spectrum.shape == (40, 24, 96)
    assert 0 <= float(data.spectrum.min()) <= float(data.spectrum.max()) <= 1
    peak = data.grid.direction.flatten(0, 1)[data.spectrum.flatten(1).argmax(1)]
    assert angular_distance(peak, to_direction(*data.label.unbind(-1))).rad2deg().median() < 3
    assert (data.moving, data.array, data.fixed_position.tolist()) == ("transmitter", data.array, [0.2, 2.4, 1.2])


@pytest.mark.parametrize("suffix", [".npz", ".mat"])
def test_arrays_with_other_names(tmp_path, suffix):
    names = {"csi": "H", "position": "pos", "frequency_hz": "f"}
    arrays = snapshot_arrays(snapshots()) | {"frequency_hz": FREQUENCY + np.array([-1e6, 0, 1e6])}
    file = tmp_path / f"run7{suffix}"
    renamed = {names.get(name, name): values for name, values in arrays.items()}
    np.savez(file, **renamed) if suffix == ".npz" else savemat(file, renamed)
    data = load_snapshots(file, arrays=names)
    assert (data.name, data.channel.shape) == ("run7", (120, 3, 16))
    assert data.frequency_hz.tolist() == (FREQUENCY + np.array([-1e6, 0, 1e6])).tolist()
    for wrong, message in (({"csi": "G"}, "lacks G"), ({"noise": "N"}, "arrays takes csi"), ({}, "none of the known")):
        with pytest.raises(InputError, match=message):
            load_snapshots(file, arrays=names | wrong if wrong else None)
    with pytest.raises(InputError, match="a file that is named"):
        load_snapshots(tmp_path, arrays=names)


def test_rows_columns_and_spacing_describe_an_array(tmp_path):
    made = snapshots()
    usual = load_spectra(write_snapshots(tmp_path / "a"), grid=GRID)
    shape = {"rows": 4, "columns": 4, "spacing_m": WAVELENGTH / 2, "element_position": None}
    other = load_spectra(write_snapshots(tmp_path / "b", **shape), grid=GRID)
    torch.testing.assert_close(other.spectrum, usual.spectrum, rtol=1e-3, atol=1e-4)
    x, y = made.array.element[1 * 4 + 2].tolist()  # row 1, column 2: columns along x, rows along y
    assert (x, y) == pytest.approx((0.5 * WAVELENGTH / 2, -0.5 * WAVELENGTH / 2))


def test_an_array_is_turned_by_its_normal_and_its_upper_side(tmp_path):
    data = snapshots()
    side, up, normal = data.rotation.T.numpy()
    given = {"array_orientation": None, "array_normal": 3 * normal, "array_up": up + normal}
    found = load_snapshots(write_snapshots(tmp_path / "a", **given))
    torch.testing.assert_close(found.rotation, data.rotation)
    for wrong in (given | {"array_up": normal}, given | {"array_normal": 0 * side}):
        with pytest.raises(InputError, match="along up"):
            load_snapshots(write_snapshots(tmp_path / "b", **wrong))


def test_what_does_not_apply_is_refused(tmp_path):
    folder = write_snapshots(tmp_path / "a")
    with pytest.raises(InputError, match="holds one array; leave station out"):
        load_spectra(folder, station=1)
    with pytest.raises(InputError, match="unknown beamformer"):
        load_spectra(folder, beamformer="music")
    with pytest.raises(InputError, match="grid must be"):
        load_spectra(folder, grid=(0, 48))
    with pytest.raises(InputError, match="coarser grid"):
        load_spectra(folder, grid=AngularGrid.hemisphere(1100, 4400))


def test_two_formats_in_a_folder_are_refused(tmp_path):
    folder = write_snapshots(tmp_path / "a")
    (folder / "gateway_info.yml").write_text("g:\n  position: [0, 0, 0]\n  orientation: [0, 0, 0, 1]\n")
    with pytest.raises(InputError, match="several formats"):
        load_spectra(folder)


def _compound(values, names=("real", "imag")):
    """Return complex numbers as pairs of fields, as HDF5 stores them."""
    if values.dtype.kind != "c":
        return values
    return np.ascontiguousarray(values).view([(name, values.real.dtype) for name in names])


def write_matlab(file):
    """Matrices only."""
    savemat(file, {key: np.atleast_2d(value) for key, value in snapshot_arrays(snapshots()).items()})


def write_hdf5(file, stored, **options):
    import h5py

    with h5py.File(file, "w", **options) as content:
        for key, value in snapshot_arrays(snapshots()).items():
            for name, values in stored(key, np.asarray(value)).items():
                content[name] = values


def write_matlab_hdf5(file):
    """MATLAB 7.3: HDF5 with axes in reverse order and complex numbers as compounds."""
    write_hdf5(file, lambda key, value: {key: _compound(np.atleast_2d(value).T)}, userblock_size=512)
    with open(file, "r+b") as stream:
        stream.write(b"MATLAB 7.3 MAT-file")


def write_octave(file):
    """Octave's HDF5: a group a variable, axes in reverse order, scalars as such."""
    write_hdf5(file, lambda key, value: {f"{key}/type": np.bytes_("matrix"), f"{key}/value": _compound(value.T)})


WRITERS = {
    "snapshots.mat": write_matlab,
    "monday.mat": write_matlab_hdf5,
    "snapshots.h5": write_octave,
    "octave.mat": write_octave,
    **{
        f"{names[0]}.h5": lambda file, names=names: write_hdf5(file, lambda k, v: {k: _compound(v, names)})
        for names in (("real", "imag"), ("r", "i"))
    },
}


@pytest.mark.parametrize("name", WRITERS)
def test_reads_what_matlab_octave_and_h5py_write(tmp_path, name):
    usual = load_snapshots(write_snapshots(tmp_path / "a"))
    WRITERS[name](tmp_path / name)
    data = load_snapshots(tmp_path / name if "snapshots" not in name else tmp_path)
    torch.testing.assert_close(data.channel, usual.channel)
    torch.testing.assert_close(data.position, usual.position)
    assert data.array == usual.array
    assert any("reverse order" in note for note in data.notes) == (name in ("monday.mat", "snapshots.h5", "octave.mat"))


def _elsewhere(file):
    import h5py

    write_snapshots(file.with_name("secret"), "snapshots.h5")
    with h5py.File(file, "w") as content:
        content["csi"] = h5py.ExternalLink(str(file.with_name("secret") / "snapshots.h5"), "csi")


def _data_set(**options):
    def write(file):
        import h5py

        with h5py.File(file, "w") as content:
            content.create_dataset("csi", **options)

    return write


@pytest.mark.parametrize(
    ("write", "says"),
    [
        (_elsewhere, "no array of numbers in this file"),
        (_data_set(data=np.zeros(3, dtype=[("real", "f8"), ("weight", "f8")])), "no array of numbers"),
        (_data_set(shape=(2**20, 2**10), dtype="c16", chunks=(1, 1)), "unpacks to"),  # before memory is taken
    ],
    ids=["a link to another file", "other compounds", "a large claim"],
)
def test_hdf5_without_the_numbers_is_refused(tmp_path, write, says):
    write(tmp_path / "a.h5")
    with pytest.raises(InputError, match=says):
        read_arrays(tmp_path / "a.h5", ["csi"])


def test_null_subcarriers_are_named_and_left_out_on_request(tmp_path):
    made = snapshots(count=9)
    spoilt = made.channel.clone()
    spoilt[:, 0], spoilt[:, [4, 5]] = 0, 30 - 4j
    folder = write_snapshots(tmp_path / "a", data=replace(made, channel=spoilt))
    (note,) = load_snapshots(folder).notes
    assert "(3 of 9, counted from 0): 0, 4 to 5" in note
    data = load_snapshots(folder, drop_null=True)
    some = replace(made, channel=made.channel[:, [1, 2, 3, 6, 7, 8]])
    kept = load_snapshots(write_snapshots(tmp_path / "b", data=some))
    torch.testing.assert_close(data.channel, kept.channel)
    assert kept.notes == ()
    assert "left out" in data.notes[0]


@pytest.mark.parametrize("filler", [0, np.nan])
@pytest.mark.parametrize("beamformer", ["phase", "bartlett"])
def test_missing_packets_and_elements_are_counted_and_not_used(tmp_path, filler, beamformer):
    """Values that are 0 or NaN have no phase."""
    made = snapshots(count=6)
    csi = made.channel.numpy().copy()
    packets = 3 + np.arange(120) % 2
    csi[:, :, [5, 9]] = filler
    csi[np.arange(6) >= packets[:, None]] = filler
    data = load_snapshots(write_snapshots(tmp_path / "b", csi=csi))
    assert data.notes == (
        "elements 5, 9 are silent (0 or NaN everywhere) and left out (counted from 0)",
        "300 of 720 snapshots are 0 or NaN at all elements and left out",
    )
    assert data.channel.shape == (120, 4, 14)
    kept = [number for number in range(16) if number not in (5, 9)]
    array = made.array.subset(torch.tensor(kept))
    row = replace(made.subset(torch.tensor([0])), array=array, channel=made.channel[:1, :3, kept])
    torch.testing.assert_close(data.spectra(GRID, beamformer).spectrum[:1], row.spectra(GRID, beamformer).spectrum)


def test_elements_are_left_out_on_request(tmp_path):
    folder = write_snapshots(tmp_path / "a")
    data = load_snapshots(folder, drop_elements=(2, 7))
    assert torch.equal(data.array.element, snapshots().array.element[[0, 1, 3, 4, 5, 6, *range(8, 16)]])
    assert "elements 2, 7 are to be ignored and left out" in data.notes[0]
    with pytest.raises(InputError, match="elements 0 to 15, so element 16"):
        load_snapshots(folder, drop_elements=(16,))


@pytest.mark.parametrize("order", [[*range(16), *range(16)], [n // 2 for n in range(32)]])
def test_two_polarisations_at_each_place_are_snapshots(tmp_path, order):
    made = snapshots(count=2)
    other = snapshots(count=4).channel[:, 2:]
    first = [order.index(number) for number in range(16)]
    port = torch.tensor([0 if place in first else 1 for place in range(32)])
    both = torch.stack([made.channel, other])[port, :, :, torch.tensor(order)].permute(1, 2, 0)
    element = snapshot_arrays(made)["element_position"][order]
    data = load_snapshots(write_snapshots(tmp_path / "a", csi=both.numpy(), element_position=element))
    assert "2 polarisations" in data.notes[0]
    torch.testing.assert_close(data.array.element, made.array.element)
    expected = replace(made, channel=torch.cat([made.channel, other], dim=1)).spectra(GRID)
    torch.testing.assert_close(data.spectra(GRID).spectrum, expected.spectrum)


def test_phases_of_the_way_there_and_back(tmp_path):
    made = snapshots(n=60, count=1)
    folder = write_snapshots(tmp_path / "a", data=replace(made, channel=made.channel**2))
    data = load_spectra(folder, grid=(24, 96), round_trip=True)
    assert data.array.wavelength == pytest.approx(WAVELENGTH / 2)
    assert "way there and back" in data.notes[0]
    here = data.grid.direction.flatten(0, 1) @ to_direction(*data.label.T).T  # pixels x positions
    along = data.spectrum.flatten(1).gather(1, here.argmax(dim=0)[:, None])
    assert float(along.median()) > 0.9


def test_a_linear_array_receives_the_angle_to_its_axis(tmp_path):
    made = snapshots(n=50)
    row = PlanarArray(made.array.element[:4], WAVELENGTH)
    folder = write_snapshots(tmp_path / "a", data=replace(made, channel=made.channel[..., :4], array=row))
    data = load_spectra(folder, grid=(45, 180))
    to_axis = (made.direction @ row.axis).arccos()
    label, peak = (to_direction(*a.T) for a in (data.label, data.peak_direction(torch.arange(50))))
    torch.testing.assert_close((label @ row.axis).arccos(), to_axis)
    assert float(angular_distance(label, peak).rad2deg().median()) < 2.5
    assert "angle to its axis" in data.notes[-1]
    estimator = make_estimator("peak").fit(Mixed.measured(data))
    error = angle_errors(estimator.predict(data.spectrum), data.label)["great_circle"]
    torch.testing.assert_close(error, angular_distance(label, peak), atol=1e-6, rtol=0)
