"""The simulated room against closed forms."""

import math

import pytest
import torch

from swiftwrf import AngularGrid, simulated_room
from swiftwrf.array.angles import angular_distance, to_direction
from swiftwrf.array.planar import LIGHT_SPEED, PlanarArray
from swiftwrf.data.simulated import ShoeboxRoom

FINE = AngularGrid.hemisphere(90, 360)


def point(*x):
    return torch.tensor([x], dtype=torch.float64)


def test_two_paths_make_the_known_fringe():
    """Two equal waves from the zenith and from azimuth 0, elevation e: the phase along x is half that of the second wave,
    so the spectrum peaks halfway between them in direction cosine; the amplitude follows |1 + exp(j phase)|."""
    array = PlanarArray.square(2, 1e9)
    elevation = math.radians(60)
    direction = torch.tensor([[0.0, 0.0, 1.0], [math.cos(elevation), 0.0, math.sin(elevation)]], dtype=torch.float64)
    channel = array.channel(direction, torch.ones(2), torch.zeros(2, dtype=torch.int64), 1)[0]
    phase = math.pi * math.cos(elevation)  # between elements half a wavelength apart
    first, last = channel[0], channel[-1]
    assert abs(first) == pytest.approx(2)
    assert abs(last) == pytest.approx(abs(2 * math.cos(phase / 2)))
    assert float((last / first).angle()) == pytest.approx(phase / 2)
    spectrum = array.spectrum(channel[None], FINE)[0]
    halfway = math.degrees(math.acos(math.cos(elevation) / 2))
    assert spectrum[:, 0].argmax().item() + 1 == round(halfway)


def test_direct_path_is_free_space():
    room = ShoeboxRoom(boxes=())
    paths = room.paths(point(1, 1, 1), point(4, 1, 1))
    wavelength = LIGHT_SPEED / room.frequency_hz
    assert paths.length[0].item() == pytest.approx(3)
    assert paths.direction[0].tolist() == pytest.approx([-1, 0, 0])
    assert abs(paths.gain[0]).item() == pytest.approx(wavelength / (4 * math.pi * 3))
    assert paths.count.tolist() == [25]


def test_floor_reflection_has_the_mirror_length():
    room = ShoeboxRoom(boxes=())
    paths = room.paths(point(1, 1, 1), point(4, 1, 1))
    mirror = math.hypot(3, 2)
    found = (paths.length - mirror).abs() < 1e-9
    assert found.sum() == 2  # floor, and the wall y = 0, both 1 m away
    wavelength = LIGHT_SPEED / room.frequency_hz
    assert abs(paths.gain[found][0]).item() == pytest.approx(abs(room.reflection) * wavelength / (4 * math.pi * mirror))


def test_box_blocks_direct_path_but_not_the_way_round():
    box = ((2.0, 0.5, 0.5), (2.5, 1.5, 1.5))
    paths = ShoeboxRoom(boxes=(box,)).paths(point(1, 1, 1), point(4, 1, 1))
    free = ShoeboxRoom(boxes=()).paths(point(1, 1, 1), point(4, 1, 1))
    assert not paths.line_of_sight[0]
    assert abs(paths.gain[0] / free.gain[0]).item() == pytest.approx(0.1)
    ceiling = (free.length - math.hypot(3, 4)).abs() + (free.direction[:, 1]).abs() < 1e-9
    upwards = ceiling & (free.direction[:, 2] > 0)
    assert upwards.sum() == 1
    assert torch.equal(paths.gain[upwards], free.gain[upwards])


def test_box_on_a_reflected_leg_blocks_it():
    """The floor bounce from (1, 1, 1) to (4, 1, 1) touches the floor at x = 2.5; a low box there stands in its way only."""
    paths, free = (
        ShoeboxRoom(boxes=boxes).paths(point(1, 1, 1), point(4, 1, 1))
        for boxes in ((((2.3, 0.8, 0.0), (2.7, 1.2, 0.2)),), ())
    )
    assert paths.line_of_sight[0]
    blocked = (paths.gain / free.gain).abs() < 0.5
    assert (blocked & ((paths.length - math.hypot(3, 2)).abs() < 1e-9)).sum() == 1


@pytest.mark.parametrize("moving", ["transmitter", "receiver"])
def test_room_is_seeded_and_in_range(moving):
    a, b = (simulated_room(n=12, moving=moving, seed=seed, grid=AngularGrid.hemisphere(15, 60)) for seed in (1, 1))
    assert torch.equal(a.spectrum, b.spectrum)
    assert a.spectrum.min() >= 0
    assert a.spectrum.max() <= 1
    other = simulated_room(n=12, moving=moving, seed=2, grid=AngularGrid.hemisphere(15, 60))
    assert not torch.equal(a.position, other.position)


def test_peak_is_near_the_line_of_sight_without_walls():
    empty = ShoeboxRoom(reflection=0.0, boxes=())
    data = simulated_room(n=20, room=empty, phase_noise=0.0, grid=FINE)
    peak = data.spectrum.flatten(1).argmax(dim=1)
    direction = FINE.direction.flatten(0, 1)[peak]
    assert angular_distance(direction, to_direction(*data.label.unbind(-1))).rad2deg().max() < 1.5
