"""Wrong frames, units and conventions that test_diagnosis lacks: refused by the reader or named by the inspection."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from samples import FACING_X, snapshots
from scipy.spatial.transform import Rotation

from swiftwrf import AngularGrid, rssi_room
from swiftwrf.contrib.diagnostics.inspection import inspect
from swiftwrf.contrib.diagnostics.path_loss import check_path_loss
from swiftwrf.data import Rssi
from swiftwrf.data.coordinates import Floors
from swiftwrf.data.store import Store

GRID = AngularGrid.hemisphere(24, 96)
DATA = snapshots(n=150)
SPECTRA = DATA.spectra(GRID)
ROOM = rssi_room(n=300)
QUATERNION = FACING_X.as_quat()


def warnings(data):
    return " ".join(inspect(data, grid=GRID).warnings)


def oriented(rotation):
    return replace(SPECTRA, rotation=torch.from_numpy(rotation.as_matrix()))


def moved(change):
    return replace(DATA, position=change(DATA.position))


def drawn(change):
    return replace(SPECTRA, store=Store(change(SPECTRA.spectrum)))


def whole_sphere():
    """Spectra with elevations of -90 to 90 degrees."""
    both = torch.cat([SPECTRA.spectrum.flip(1), SPECTRA.spectrum], dim=1)
    return replace(SPECTRA, store=Store(both), grid=AngularGrid.hemisphere(48, 96))


def placed(change, receivers=False):
    places = change(ROOM.receiver_position) if receivers else ROOM.receiver_position
    return replace(ROOM, transmitter_position=change(ROOM.transmitter_position), receiver_position=places)


def column(values):
    """The floor with other values at its first receiver."""
    rssi = ROOM.rssi_dbm.clone()
    rssi[:, 0] = values.double()
    return replace(ROOM, rssi_dbm=rssi)


def shrunk(p):
    return p * 1000


ALL_SHRUNK = replace(DATA, position=shrunk(DATA.position), fixed_position=shrunk(DATA.fixed_position))
FLIP_Y = torch.tensor([1.0, -1.0, 1.0], dtype=torch.float64)
TURNED = oriented(FACING_X * Rotation.from_euler("x", 20, degrees=True))

NAMED = {
    "y and z swapped": (moved(lambda p: p[:, [0, 2, 1]]), "y and z of the positions are swapped"),
    "y mirrored": (moved(lambda p: p * FLIP_Y), "y of the positions has the wrong sign"),
    "everything in millimetres": (ALL_SHRUNK, "are they metres?"),
    "quaternion w, x, y, z": (oriented(Rotation.from_quat(np.roll(QUATERNION, 1))), "in the order w, x, y, z"),
    "quaternion inverted": (oriented(FACING_X.inv()), "the quaternion turns world into array coordinates"),
    "array turned by 20 degrees": (TURNED, "constant rotation of 20 degrees"),
    "azimuth clockwise": (drawn(lambda s: s.flip(2).roll(1, 2)), "azimuths of the spectra turn clockwise"),
    "azimuth from y": (drawn(lambda s: s.roll(-24, 2)), "azimuths of the spectra count from y"),
    "zenith for elevation": (drawn(lambda s: s.flip(1)), "run from the zenith down"),
    "elevations of -90 to 90": (whole_sphere(), "give spectrum[:, 24:]"),
    "phases reversed": (replace(DATA, channel=DATA.channel.conj()), "phases have the wrong sign"),
    "RSSI, x and y swapped": (placed(lambda p: p[:, [1, 0, 2]]), "x and y of the positions are swapped"),
    "RSSI, y counts down an image": (
        placed(lambda p: p * FLIP_Y + torch.tensor([0.0, 17.0, 0.0], dtype=torch.float64)),
        "y of the positions counts from the other side (y = 17.",
    ),
    "RSSI, positions in pixels": (placed(lambda p: p * torch.tensor([37.8, 37.8, 1.0])), "units in a metre (--scale 3"),
    "RSSI, positions in millimetres": (placed(shrunk), "the positions are in millimetres"),
    "RSSI, everything in millimetres": (placed(shrunk, receivers=True), "are positions in millimetres"),
    "RSSI, one value everywhere": (column(torch.full((300,), -70.0)), "one value everywhere: receiver01"),
    "RSSI, values above 0 dBm": (column(torch.linspace(-80, 20, 300)), "0 dBm and more"),
    "RSSI, a receiver twice": (column(ROOM.rssi_dbm[:, 1]), "the same values: receiver02 = receiver01"),
    "RSSI, hardly heard": (column(torch.where(torch.arange(300) < 5, -70.0, torch.nan)), "fewer than 10 rows"),
}


@pytest.mark.parametrize("name", NAMED)
def test_inspection_names_it(name):
    data, says = NAMED[name]
    assert says in warnings(data)


@pytest.mark.parametrize("data", [DATA, SPECTRA, ROOM], ids=["snapshots", "spectra", "RSSI"])
def test_inspection_names_nothing_where_all_is_right(data):
    found = warnings(data)
    assert not any(word in found for word in ("frame", "rotation", "metres", "calibrat", "would fit", "would explain"))


def test_inspection_names_a_sign_of_not_heard_that_is_not_known():
    rssi = ROOM.rssi_dbm.clone()
    rssi[torch.rand(rssi.shape, generator=torch.Generator().manual_seed(0)) < 0.3] = torch.nan
    assert "does it mean not detected" in warnings(replace(ROOM, rssi_dbm=rssi.nan_to_num(-127.0)))


def test_a_rotation_is_told_from_the_axes_of_the_array():
    turned = oriented(FACING_X * Rotation.from_rotvec([0, 0, math.radians(-20)]))
    findings = inspect(turned, grid=GRID)
    assert findings.numbers["turn_deg"] == pytest.approx([0, 0, 20], abs=1.5)
    assert findings.numbers["frame"] == "turned"


TURNED_PLAN = torch.from_numpy(Rotation.from_euler("z", 30, degrees=True).as_matrix())
UNKNOWN = {
    "pixels": lambda p: 37.8 * p,
    "pixels from the top": lambda p: 37.8 * p * FLIP_Y + torch.tensor([0.0, 600.0, 0.0], dtype=torch.float64),
    "another origin": lambda p: p + torch.tensor([9.0, -7.0, 0.0], dtype=torch.float64),
    "turned by 30 degrees": lambda p: p @ TURNED_PLAN.T,
    "half a turn about a corner": lambda p: 20 - p,
}


@pytest.mark.parametrize("name", UNKNOWN)
def test_another_frame_of_rssi_is_not_given_a_wrong_cause(name):
    report = check_path_loss(placed(UNKNOWN[name]))
    assert not report.explanation
    assert report.attainable > report.explained + 0.1


def test_positions_of_receivers_that_do_not_fit_are_reported_without_a_cause():
    assert "are origin, axes and units those of the positions" in warnings(placed(UNKNOWN["pixels"]))
    assert not check_path_loss(ROOM).misplaced


def test_rssi_of_no_field_fits_no_other_receivers():
    noise = torch.randn(ROOM.rssi_dbm.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    report = check_path_loss(replace(ROOM, rssi_dbm=noise - 60).subset(torch.arange(100)))
    assert not report.misplaced
    assert not report.explanation


def test_a_filler_of_each_receiver_is_asked_about():
    level = ROOM.rssi_dbm.nan_to_num(-100).round()
    floor = level.quantile(0.4, dim=0).round()
    assert "does it mean not detected" in warnings(replace(ROOM, rssi_dbm=level.maximum(floor)))


def test_axes_along_which_all_positions_are_equal_are_not_swapped():
    flat = replace(ROOM, transmitter_position=ROOM.transmitter_position * torch.tensor([1.0, 1.0, 0.0]))
    mirrored = replace(flat, transmitter_position=11.0 - flat.transmitter_position)
    report = check_path_loss(mirrored)
    assert "z" not in report.explanation


@pytest.mark.parametrize(("late", "words"), [(0, ""), (8, "4 s (8 rows) late"), (-5, "2.5 s (5 rows) early")])
def test_a_delay_between_positions_and_rssi_of_a_walk_is_named(late, words):
    time = torch.arange(300, dtype=torch.float64)
    place = torch.stack([5 + 4 * torch.sin(0.11 * time), 6 + 5 * torch.cos(0.07 * time), 1.2 + 0 * time], dim=1)
    receivers = torch.tensor([[1, 1, 2], [9, 2, 2], [8, 11, 2], [1, 10, 2]], dtype=torch.float64)
    noise = 3 * torch.randn(300, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    rssi = -40 - 25 * torch.cdist(place, receivers).log10() + noise
    walk = Rssi(rssi, place.roll(-late, 0), receiver_position=receivers, time=0.5 * time)
    explanation = check_path_loss(walk).explanation
    assert explanation.endswith(words)
    assert bool(explanation) == bool(words)


def test_the_attenuation_between_floors_is_no_error_of_the_frame():
    """It was a scale of 260 units in a metre, which leaves the heights alone to explain RSSI. A swap is still named."""
    upper = torch.arange(len(ROOM)) % 3 == 0
    position, rssi = ROOM.transmitter_position.clone(), ROOM.rssi_dbm[:, [0, 3, 6, 9]].clone()
    position[upper, 2] += 4
    rssi[upper] -= 15
    rssi[upper, 3] = torch.nan  # not received upstairs
    on = ROOM.columns([0, 3, 6, 9])
    building = replace(on, transmitter_position=position, rssi_dbm=rssi, floors=Floors(("0", "1"), (1.2, 5.2)))
    report = check_path_loss(building)
    assert (report.explanation, report.misplaced) == ("", False)
    swapped = check_path_loss(replace(building, transmitter_position=position[:, [1, 0, 2]]))
    assert "x and y of the positions are swapped" in swapped.explanation
