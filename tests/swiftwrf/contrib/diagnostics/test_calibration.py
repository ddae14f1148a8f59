"""Element phases and orientation: recovered if the data determine them, refused otherwise."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from samples import POSITION, snapshots
from scipy.spatial.transform import Rotation

from swiftwrf import InputError, calibrate
from swiftwrf.array.angles import AngularGrid, wrap
from swiftwrf.array.planar import PlanarArray
from swiftwrf.contrib.diagnostics.inspection import inspect
from swiftwrf.data import Snapshots
from swiftwrf.data.simulated import OFFICE, STATIONS, simulated_channel, simulated_stations


def spoilt(data, degrees=20.0, seed=0):
    """The snapshots with phases of 0 to 2 pi and an orientation that is wrong by so much; the phases and the turn back."""
    generator = torch.Generator().manual_seed(seed)
    phase = 2 * math.pi * torch.rand(len(data.array.element), generator=generator, dtype=torch.float64)
    axis = torch.randn(3, generator=generator, dtype=torch.float64)
    turn = math.radians(degrees) * axis / axis.norm()
    wrong = torch.from_numpy(Rotation.from_rotvec((-turn).numpy()).as_matrix())
    channel = (data.channel * torch.polar(torch.ones_like(phase), phase)).to(torch.complex64)
    return replace(data, channel=channel, rotation=data.rotation @ wrong), phase, turn


def errors(found, phase, turn):
    """Return the errors of the rotation and of the worst phase [deg], up to a common phase."""
    left = Rotation.from_rotvec(found.turn.numpy()).inv() * Rotation.from_rotvec(turn.numpy())
    beside = torch.polar(torch.ones_like(phase), found.phase - phase)
    return math.degrees(left.magnitude()), float((beside * beside.sum().conj()).angle().abs().max().rad2deg())


@pytest.mark.parametrize(("seed", "echo"), [(0, 0.0), (1, 0.1), (2, 0.1), (3, 0.0)])
def test_phases_and_a_turn_of_20_degrees_are_recovered(seed, echo):
    data, phase, turn = spoilt(snapshots(n=300, noise=0.2, echo=echo), seed=seed)
    found = calibrate(data)
    by_turn, by_phase = errors(found, phase, turn)
    assert by_turn < 1
    assert by_phase < 5
    assert found.before < 0.3
    assert found.after > 0.9
    assert found.clear == 300


def test_deviations_are_those_of_the_estimates():
    """Over draws of the noise, errors in units of their deviation have a deviation of one."""
    score = []
    for seed in range(4):
        data, phase, turn = spoilt(snapshots(n=120, count=1, noise=0.3, seed=seed))
        found = calibrate(data)
        turn_error = Rotation.from_rotvec(found.turn.numpy()).inv() * Rotation.from_rotvec(turn.numpy())
        phase_error = wrap(found.phase - (phase - phase[0]))[1:]
        score += (turn_error.as_rotvec() / found.turn_std.numpy()).tolist()
        score += (phase_error / found.phase_std[1:]).tolist()
    assert 0.5 < float(torch.tensor(score).square().mean().sqrt()) < 1.5


def test_positions_without_line_of_sight_do_not_count():
    data, phase, turn = spoilt(snapshots(n=200))
    generator = torch.Generator().manual_seed(0)
    hidden = torch.rand(200, generator=generator) < 0.4
    noise = torch.randn(data.channel.shape, dtype=torch.complex64, generator=generator)
    channel = torch.where(hidden[:, None, None], noise, data.channel)
    unknown = calibrate(replace(data, channel=channel))
    known = calibrate(replace(data, channel=channel, line_of_sight=~hidden))
    for found in (unknown, known):
        assert errors(found, phase, turn)[0] < 1
    assert unknown.clear < 140
    assert known.clear == int((~hidden).sum())


QUARTER_TURN = Rotation.from_euler("z", 90, degrees=True)


def narrow(data):
    """Only positions straight in front of the array."""
    return data.subset((data.direction[:, 2] > 0.97).nonzero()[:, 0])


def changed(**changes):
    """Return a function that makes snapshots, some parts of which are computed from the usual ones."""
    return lambda: replace(data := snapshots(), **{name: change(data) for name, change in changes.items()})


REFUSED = {
    "few": (lambda: snapshots(n=12), "needs at least 20"),
    "no line of sight": (changed(line_of_sight=lambda data: torch.zeros(120).bool()), "has 0 training positions"),
    "noise": (lambda: snapshots(n=200, noise=30.0), "positions where a direct path stands out"),
    "a cone": (lambda: narrow(snapshots(n=900, noise=0.5)), "measure positions in more directions"),
    "a line": (
        changed(channel=lambda data: data.channel[..., :4], array=lambda data: data.array.subset(torch.arange(4))),
        "the elements of made lie on a line",
    ),
    "constant phases": (
        changed(channel=lambda data: data.channel[..., :1].expand_as(data.channel)),
        "hardly depend on the position",
    ),
    "a quarter turn": (
        lambda: replace((data := snapshots()), rotation=data.rotation @ torch.from_numpy(QUARTER_TURN.as_matrix())),
        "an error of frames, not of mounting|a direct path stands out|does not determine",
    ),
    "positions of others": (
        changed(position=lambda data: data.position.flip(0)),
        "a direct path stands out|does not determine|does harm",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_refuses_what_cannot_be_told(name):
    make, says = REFUSED[name]
    with pytest.raises(InputError, match=says):
        calibrate(make())


@pytest.mark.parametrize("noise", [[5], [1, 6, 12]])
def test_elements_that_hold_noise_are_named(noise):
    data = snapshots(n=120, count=2)
    channel = data.channel.clone()
    draw = torch.Generator().manual_seed(0)
    channel[..., noise] = torch.randn(120, 2, len(noise), dtype=channel.dtype, generator=draw)
    found = inspect(replace(data, channel=channel), grid=(24, 96))
    assert found.numbers["noisy_elements"] == noise
    assert "--drop-elements " + " ".join(map(str, noise)) in " ".join(found.warnings)


def test_no_element_of_a_sound_array_holds_noise():
    assert "noisy_elements" not in inspect(snapshots(n=120, count=2), grid=(24, 96)).numbers


def near_field(seed=0):
    """Spherical waves at a large array from places 0.3 to 1.2 m away."""
    array = PlanarArray.square(6, 5.24e9, 0.04)
    away = torch.tensor([-0.8, -0.8, 0.3]) + torch.tensor([1.6, 1.6, 0.7]) * torch.rand(
        100, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(seed)
    )
    channel = torch.polar(torch.ones(100, 36, dtype=torch.float64), array.phase_at(away))
    return Snapshots(channel, away, array=array, fixed_position=torch.zeros(3), rotation=torch.eye(3))


def test_a_calibration_in_the_near_field_uses_distances():
    findings = inspect(near_field(), grid=(24, 96))
    assert findings.numbers["near_field_share"] == 1
    assert "needs no calibration" in str(findings)
    data, phase, turn = spoilt(near_field(), degrees=10)
    by_turn, by_phase = errors(calibrate(data), phase, turn)
    assert by_turn < 1
    assert by_phase < 5


def test_plain_values_are_strict_json():
    calibration = calibrate(snapshots(n=100))
    found = json.loads(json.dumps(calibration.to_json(), allow_nan=False))
    for name in ("phase", "phase_std", "turn", "turn_std"):
        assert np.deg2rad(found[f"{name}_deg"]) == pytest.approx(getattr(calibration, name).numpy())
    shares = [found[f"line_of_sight_share_{name}"] for name in ("before", "after")]
    assert shares == [calibration.before, calibration.after]
    assert len(found["phase_deg"]) == 16
    assert 0 < found["turn_std_deg"][0] < 1


SHIFT = torch.tensor([0.2, -0.25, 0.15], dtype=torch.float64)  # from the declared to the true position [m]
PARTS = {
    part: part.split(" and ")
    for part in (
        "phases",
        "orientation",
        "position",
        "phases and position",
        "orientation and position",
        "phases and orientation and position",
    )
}


def spoilt_in(parts, data, seed=0):
    """The snapshots with some parts of the calibration wrong; the correct phases, turn and shift."""
    wrong, phase, turn = spoilt(data, degrees=12, seed=seed)
    data = replace(data, channel=wrong.channel) if "phases" in parts else data
    data = replace(data, rotation=wrong.rotation) if "orientation" in parts else data
    data = replace(data, fixed_position=data.fixed_position - SHIFT) if "position" in parts else data
    values = {"phases": phase, "orientation": turn, "position": SHIFT}
    return data, *(value if part in parts else torch.zeros_like(value) for part, value in values.items())


@pytest.mark.parametrize("parts", PARTS.values(), ids=PARTS)
def test_parts_are_recovered_exactly_without_noise(parts):
    data, phase, turn, shift = spoilt_in(parts, snapshots(n=60, count=1, noise=0.0))
    found = calibrate(data, parts)
    by_turn, by_phase = errors(found, phase, turn)
    assert (by_turn, by_phase) == pytest.approx((0, 0), abs=1e-3)
    assert found.shift.allclose(shift, atol=1e-5)
    corrected = found.apply(data)
    assert corrected.fixed_position.allclose(snapshots().fixed_position, atol=1e-5)
    assert corrected.rotation.allclose(snapshots().rotation, atol=1e-5)
    for part, name in (("phases", "phase"), ("orientation", "turn"), ("position", "shift")):
        assert part in parts or not getattr(found, name).any()
        assert part in parts or not getattr(found, f"{name}_std").any()


def office(station, n=200, seed=0):
    """Snapshots of an array in the simulated office, with 25 paths of each transmission and noise 20 dB below them."""
    position = simulated_stations(n=n, stations=1, seed=seed, grid=AngularGrid.hemisphere(4, 8)).position
    array = PlanarArray.square(4, OFFICE.frequency_hz)
    channel, line_of_sight = simulated_channel(OFFICE, position, STATIONS[station], array)
    channel = channel / channel.abs().square().mean().sqrt()
    noise = torch.randn(channel.shape, dtype=channel.dtype, generator=torch.Generator().manual_seed(seed))
    return Snapshots(
        channel + 0.1 * noise, position, array=array, pose=STATIONS[station], line_of_sight=line_of_sight, name=station
    )


@pytest.mark.parametrize("parts", [["phases"], ["orientation"], ["position"]], ids=lambda parts: parts[0])
def test_errors_in_a_room_with_reflections_are_within_three_standard_errors(parts):
    """All values at four stations are, but for a phase whose bias from reflections is half a standard error more."""
    score = []
    for station in STATIONS:
        data, phase, turn, shift = spoilt_in(parts, office(station))
        found = calibrate(data, parts)
        left = Rotation.from_rotvec(found.turn.numpy()).inv() * Rotation.from_rotvec(turn.numpy())
        error = {
            "phases": (wrap(found.phase - phase + phase[0]), found.phase_std),
            "orientation": (torch.from_numpy(left.as_rotvec()), found.turn_std),
            "position": (found.shift - shift, found.shift_std),
        }
        away, std = error[parts[0]]
        score.append((away / std)[std > 0].abs())
    assert float((torch.cat(score) <= 3).double().mean()) > 0.98
    assert float(torch.cat(score).max()) < 4


def linear(n=120):
    """Snapshots of four elements on a line."""
    data = snapshots(n=n, count=1)
    return replace(data, channel=data.channel[..., :4], array=data.array.subset(torch.arange(4)))


def test_phases_of_a_linear_array_and_of_a_narrow_cone():
    for data in (linear(), narrow(snapshots(n=900, noise=0.5))):
        data, phase, turn, _ = spoilt_in(["phases"], data)
        found = calibrate(data, ["phases"])
        assert errors(found, phase, turn)[1] < 5
        assert found.after > 0.8


def far(n=200):
    """Snapshots from 60 to 80 m away."""
    data = snapshots(n=n, count=1)
    away = data.direction * torch.linspace(60, 80, n, dtype=torch.float64)[:, None]
    return replace(data, position=data.fixed_position + away @ data.rotation.T)


@pytest.mark.parametrize(
    ("make", "parts", "says"),
    [
        (far, ["orientation", "position"], "does not determine .*the position of the array along"),
        (
            lambda: replace(snapshots(), fixed_position=POSITION + 3 * SHIFT),
            ["position"],
            "beyond 0.5 m that is an error",
        ),
        (linear, ["orientation"], "estimate the phases alone"),
        (snapshots, [], "one part or more of phases, orientation, position"),
        (snapshots, ["gains"], "'phases' or 'orientation' or 'position'"),
    ],
)
def test_refuses_parts_that_cannot_be_told(make, parts, says):
    with pytest.raises(InputError, match=says):
        calibrate(make(), parts)


def test_the_default_keeps_its_values():
    """Values of the estimate that had no choice of parts."""
    data, *_ = spoilt(snapshots(n=120, noise=0.3, echo=0.1))
    found = calibrate(data)
    assert found.turn.tolist() == pytest.approx([-0.1838764164, 0.1121828373, -0.2751287853], abs=1e-9)
    assert found.turn_std.tolist() == pytest.approx([0.0053121296, 0.0062071523, 0.0032439975], abs=1e-9)
    assert float(found.phase.sum()) == pytest.approx(5.799042877, abs=1e-8)
    assert not found.shift.any()
