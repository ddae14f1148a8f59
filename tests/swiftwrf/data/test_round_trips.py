"""Written data are read back: samples of every format from the toolkit's own layout, and any measurements."""

import math
import zipfile
from dataclasses import fields, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pandas as pd
import pytest
import torch
from fuzz import kinds
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from swiftwrf import AngularGrid, InputError, Rssi, load_rssi, load_spectra, simulated_room
from swiftwrf.array.planar import PlanarArray
from swiftwrf.data.coordinates import Floors, GeodeticOrigin
from swiftwrf.data.rssi import SURVEY, Offsets
from swiftwrf.data.writing import write_rssi, write_spectra

ROOM = simulated_room(n=20, grid=AngularGrid.hemisphere(8, 32))
APPROXIMATE = {"rotation": 1e-6, "array": 1e-6, "label": 1e-12}  # by a quaternion, a carrier, and from positions


def assert_same(found, data):
    """Every field of the data comes back, those that are added to the class, too."""
    assert type(found) is type(data)
    for name in {field.name for field in fields(data)} - {"name", "source", "notes"}:
        value, back = getattr(data, name), getattr(found, name)
        if name == "store":
            value, back = value[:], back[:]
        elif name == "array" and value is not None:
            value, back = (torch.cat([each.element.ravel(), torch.tensor([each.wavelength])]) for each in (value, back))
        if isinstance(value, torch.Tensor):
            atol = APPROXIMATE.get(name, 0)
            torch.testing.assert_close(back, value, rtol=0, atol=atol, equal_nan=True, msg=name)
        elif isinstance(value, pd.Series):
            pd.testing.assert_series_equal(back, value)
        elif name == "named_splits":
            assert {split: [rows.tolist() for rows in parts] for split, parts in back.items()} == {
                split: [rows.tolist() for rows in parts] for split, parts in value.items()
            }
        else:
            assert back == value, name


def assert_comes_back(data, folder):
    """Return the data that were written into a folder and read."""
    write, load = (write_rssi, load_rssi) if isinstance(data, Rssi) else (write_spectra, load_spectra)
    write(data, folder)
    back = load(folder)
    assert_same(back, data)
    return back


@pytest.mark.parametrize("kind", kinds.DATA)
def test_samples_of_every_format_come_back_from_the_own_layout(kind, tmp_path):
    write, read = kinds.DATA[kind]
    for name in ("source", "own"):
        (tmp_path / name).mkdir()
    write(tmp_path / "source")
    assert_comes_back(read(tmp_path / "source"), tmp_path / "own")


@st.composite
def of_rows(draw, n, data):
    """A split, or none."""
    middle = draw(st.integers(1, n - 1))
    split = {"walk": (torch.arange(middle), torch.arange(middle, n))}
    return replace(data, named_splits=draw(st.sampled_from([{}, split])))


@st.composite
def rssi(draw):
    n, n_receivers = draw(st.integers(2, 6)), draw(st.integers(1, 3))
    metres = st.integers(-(10**9), 10**9).map(lambda x: x / 1024)
    names = draw(st.permutations(['a,"b"', "NA", "1", "12:34", "\u00e4 #"]))[:n_receivers]
    dbm = st.floats(-99, -20) | st.just(np.nan)
    values = draw(arrays.arrays(float, (n, n_receivers), elements=dbm))
    values[0] = -60.0  # a receiver without any row is none
    values += np.arange(values.size).reshape(values.shape) / 1000  # values that repeat may be signs of not detected
    data = Rssi(values, draw(arrays.arrays(float, (n, 3), elements=metres)), receiver_names=names)
    receiver = draw(arrays.arrays(float, (n_receivers, 3), elements=metres))
    receiver[1:][draw(arrays.arrays(bool, n_receivers - 1))] = np.nan
    time = draw(arrays.arrays(float, n, elements=st.integers(-(10**6), 10**6).map(lambda t: t / 3) | st.just(np.nan)))
    time[0] = 0.0  # they count from the first row
    phone = draw(st.lists(st.sampled_from(["new", "007", "NA", None]), min_size=n, max_size=n))
    phone[0], session = "new", torch.tensor(sorted(draw(st.lists(st.integers(0, 1), min_size=n, max_size=n))))
    known = {
        "receiver_position": torch.from_numpy(receiver),
        "origin": GeodeticOrigin(48.1234567, -11.5),
        "floors": Floors(("0", "1, 2"), (1.0, 5.25)),
        "receiver_moves": True,
        "session": session.unique(return_inverse=True)[1],
        "time": torch.from_numpy(time),
        "groups": pd.Series(phone, name="Phone ID"),
        "labels": ("Phone ID", "channel: 1"),
        "plan_scale": 20.7,
        "margin_db": math.inf,
    }
    known = {name: value for name, value in known.items() if draw(st.booleans())}
    if "groups" in known and draw(st.booleans()):
        known["offsets"] = Offsets("Phone ID", "new", {"new": 0.0, "007": -1 / 3, "NA": 2.5}, 0.125)
    return draw(of_rows(n, replace(data, **known)))


@st.composite
def spectra(draw):
    n = draw(st.integers(2, 6))
    room = simulated_room(n=n, moving=draw(st.sampled_from(["transmitter", "receiver"])), grid=ROOM.grid)
    generator = torch.Generator().manual_seed(draw(st.integers(0, 9)))
    label = 6 * torch.rand(n, 2, generator=generator, dtype=torch.float64).index_fill(0, torch.tensor([1]), torch.nan)
    known = {
        "label": label.clamp(max=1.5),
        "line_of_sight": torch.arange(n) % 3 > 0,
        "channel": torch.randn(n, 3, 16, dtype=torch.complex64, generator=generator),
        "array": None,
    }
    known = {name: value for name, value in known.items() if draw(st.booleans())}
    if "array" in known:
        known.pop("channel", None)
    if "channel" in known:
        known["frequency_hz"] = 915e6 + 1e6 * torch.arange(3).double()
    return draw(of_rows(n, replace(room, **known)))


# shrinking an example would write and read hundreds of folders
@settings(max_examples=25, deadline=None, phases=[Phase.generate])
@given(st.one_of(rssi(), spectra()))
def test_any_measurements_come_back_as_they_were(data):
    with TemporaryDirectory() as folder:
        assert_comes_back(data, Path(folder))


def test_what_the_layout_has_signs_for(tmp_path):
    """-100 dBm means not detected, and a label that follows from the positions is not written."""
    data = Rssi([[-100.0], [-60.0]], torch.eye(3)[:2], groups=pd.Series(["a", "b"], name="phone"))
    write_rssi(data, tmp_path)
    assert load_rssi(tmp_path).rssi_dbm[0, 0] == -99.99
    (tmp_path / "meta.csv").unlink()
    assert load_rssi(tmp_path).groups is None
    write_spectra(ROOM, tmp_path)
    assert "label.npy" not in zipfile.ZipFile(tmp_path / "spectrum.npz").namelist()


def test_a_walk_of_several_phones_keeps_them(tmp_path):
    table = pd.DataFrame(
        {"x": np.arange(60.0), "y": 0.0, "phone": ["old", "new", "other"] * 20, "hall": -50.0 - np.arange(60) / 2}
    )
    data = Rssi.from_frame(table, offset_by="phone")
    write_rssi(data, tmp_path)
    assert_same(load_rssi(tmp_path, offset_by="phone"), data)
    with pytest.raises(InputError, match="has groups of phone, not of floor; convert the table again by these"):
        load_rssi(tmp_path, offset_by="floor")
    assert Rssi.from_frame(table).labels == ("phone",)


# refusals


@pytest.mark.parametrize(
    "text",
    [
        "plan_scale: wide",
        "plan_scale: [1, 2]",
        "offsets: 3",
        "offsets: {column: a}",
        "labels: 3",
        "margin_db: -1",
        "offsets: {column: a, reference: b, explained: nan, offset_db: {b: 0}}",
    ],
)
def test_damaged_properties_of_a_survey_are_refused(tmp_path, text):
    write_rssi(Rssi([[-60.0], [-61.0]], torch.eye(3)[:2]), tmp_path)
    (tmp_path / SURVEY).write_text(text)
    with pytest.raises(InputError, match=r"survey\.yml is not a description as convert writes it"):
        load_rssi(tmp_path)


def test_an_array_that_the_files_contradict_is_refused(tmp_path):
    write_spectra(ROOM, tmp_path)
    with pytest.raises(InputError, match="another array"):
        load_spectra(tmp_path, array=PlanarArray.square(2, 915e6))
    assert load_spectra(tmp_path, array=PlanarArray.square(4, 915e6)).array == PlanarArray.square(4, 915e6)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda s: s.transpose(0, 2, 1), "transpose"),
        (lambda s: 20 * np.log10(s + 1e-9), "convert decibels"),
        (lambda s: s[:5], "for 20 positions"),
        (lambda s: s * np.nan, "in \\[0, 1\\]"),
        (lambda s: s > 0.5, "got bool"),
    ],
)
def test_arrays_of_something_else_are_refused(tmp_path, change, says):
    write_spectra(ROOM, tmp_path)
    np.savez(tmp_path / "spectrum.npz", spectrum=change(ROOM.spectrum.numpy()))
    with pytest.raises(ValueError, match=says):
        load_spectra(tmp_path)
