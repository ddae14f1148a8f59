"""Placement of a next array: poses on the walls, expected errors, and the truth in the simulated office."""

from functools import partial

import numpy as np
import pandas as pd
import pytest
import quick
import torch
from rooms import OFFICE_WALLS
from small import known_planes

from augment.placement import StationSuggestion, _most_weighted, _placed, _positions, suggest_station, wall_poses
from swiftwrf import AngularGrid, ArrayPose, InputError, MatchedField, Spectra, Stations, simulated_stations
from swiftwrf.array.beamforming import unit_phasor
from swiftwrf.array.planar import PlanarArray
from swiftwrf.contrib.comparison.stations import compare_stations
from swiftwrf.data.simulated import OFFICE, simulated_channel
from swiftwrf.data.spectra import array_spectra
from swiftwrf.locate.matched_field import MatchedFieldConfig
from swiftwrf.models.geometry import GeometryModel
from tasks.locate.placement import poses_section, write_poses

GRID = AngularGrid.hemisphere(15, 60)
TINY = MatchedFieldConfig(spacing=0.5, max_cells=2000, n_best=30, n_background=10, n_rounds=1)


def fitted(train: Stations) -> MatchedField:
    rooms = {name: GeometryModel.of_planes(train.of(name)[1], OFFICE_WALLS) for name in train.names}
    small = MatchedField(spacing=0.5, max_cells=4000, n_best=60, n_background=20, n_rounds=2, n_calibration=40)
    return small.fit(train, room=rooms)


@pytest.fixture(scope="module")
def office() -> Stations:
    return simulated_stations(n=100, stations=2, seed=3, grid=GRID)


@pytest.fixture(scope="module")
def locator(office) -> MatchedField:
    return fitted(office[:40])


def test_poses_are_on_the_walls_and_face_the_room(locator):
    poses = wall_poses(locator)
    assert len(poses) == 8
    for pose in poses:
        x, y, z = pose.position
        assert min(x, y, 8 - x, 6 - y) == pytest.approx(0.1, abs=0.03)
        assert z == pytest.approx(1.85)
        centre = torch.tensor([4.0 - x, 3.0 - y, 0.0], dtype=torch.float64)
        assert float(pose.rotation[:, 2] @ centre) > 1
        assert pose.rotation[:, 1].tolist() == pytest.approx([0, 0, 1], abs=0.03)
    assert len(wall_poses(locator, 12)) == 12


def test_a_further_array_lowers_the_expected_error_and_one_far_away_least(locator):
    near, far = ArrayPose.facing((4.0, 0.1, 1.9), (0, 1, 0)), ArrayPose.facing((4.0, -80.0, 1.9), (0, 1, 0))
    found = suggest_station(locator, 2, [far, near], n_positions=24, config=TINY)
    assert found.pose == (near, far)
    assert float(found.gain_m[0]) > 0
    assert found.before_m == pytest.approx(float(found.error_m[1] + found.gain_m[1]))
    assert bool((found.gain_std_m > 0).all())
    again = suggest_station(locator, 1, [far, near], n_positions=24, config=TINY)
    assert again.error_m.equal(found.error_m[:1])


def test_the_gain_is_a_difference_of_medians_with_a_bootstrap_of_positions(locator):
    pose = ArrayPose.facing((4.0, 0.1, 1.9), (0, 1, 0))
    found = suggest_station(locator, 1, [pose], n_positions=24, config=TINY)
    position = _positions(locator, 24, 0)
    own = {name: (name, room) for name, room in locator.rooms.items()}
    like = _most_weighted(locator)

    def errors(more):
        posterior = locator.elsewhere(own | more, TINY).located_samples(position, 0)
        return (posterior.median - position).norm(dim=1).numpy()

    before, after = errors({}), errors({"": (like, _placed(locator.rooms[like], pose))})
    middle = partial(np.quantile, q=0.5, method="lower")  # as torch counts an even number
    assert float(found.error_m[0]) == pytest.approx(middle(after))
    assert float(found.gain_m[0]) == pytest.approx(middle(before) - middle(after))
    rows = np.random.default_rng(0).integers(24, size=(4000, 24))
    drawn = middle(before[rows], axis=1) - middle(after[rows], axis=1)
    assert float(found.gain_std_m[0]) == pytest.approx(drawn.std(), rel=0.2)


def test_samples_vary_as_held_out_phases(locator):
    """Simulated channels are as coherent with those of the room as measured ones are."""
    likelihoods = locator.likelihoods[0]
    position = locator.cells.position[:200]
    draw = torch.Generator().manual_seed(0)
    phases = likelihoods.sample(position, draw).phases[:, 0]
    room = likelihoods.room.channel(position)
    room = room / room.abs()
    match = (phases.conj() * room).mean(dim=1).abs().square()
    assert 0.3 < float(match.mean()) < 0.95


def test_refusals(locator):
    pose = ArrayPose((4.0, 0.1, 1.9))
    for call, says in (
        (lambda: suggest_station(locator, 25), "at most 24 poses"),
        (lambda: suggest_station(locator, 2, [pose]), "2 poses cannot be chosen among 1 candidates"),
    ):
        with pytest.raises(InputError, match=says):
            call()


@pytest.mark.long
def test_the_suggested_pose_is_no_worse_than_the_median_one(office, locator):
    """On spectra that are simulated with reflections, cupboards and noise at each candidate pose."""
    candidates = wall_poses(locator)[::2]
    found = suggest_station(locator, 1, candidates, n_positions=40, config=TINY)

    def error(pose: ArrayPose) -> float:
        array = PlanarArray.square(4, OFFICE.frequency_hz)
        channel, _ = simulated_channel(OFFICE, office.position, pose, array)
        noise = torch.randn(channel.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
        store = array_spectra(array, channel * unit_phasor(0.1 * noise), GRID)
        new = Spectra(store=store, position=office.position, array=array, pose=pose, grid=GRID)
        data = Stations({**office.spectra, "new": new})
        posterior = fitted(data[:40]).locate(data[40:])
        return float((posterior.median - data.position[40:]).norm(dim=1).median())

    errors = [error(pose) for pose in candidates]
    assert errors[candidates.index(found.pose[0])] <= np.median(errors)


def test_files_and_section_of_poses(tmp_path):
    poses = ArrayPose.facing((4.0, 0.1, 1.9), (0, 1, 0)), ArrayPose.facing((0.1, 3.0, 1.9), (1, 0, 0))
    error, gain, std = torch.tensor([0.2, 0.3]), torch.tensor([0.15, 0.05]), torch.tensor([0.02, 0.03])
    found = StationSuggestion(poses, error, gain, std, torch.tensor([[7.9, 3.0, 1.9]]))
    write_poses(tmp_path / "suggested", torch.rand(9, 3), found)
    table = pd.read_csv(tmp_path / "suggested.csv")
    assert table[["x_m", "y_m", "z_m"]].to_numpy() == pytest.approx(np.array([[4.0, 0.1, 1.9], [0.1, 3.0, 1.9]]))
    assert table[["facing_x", "facing_y", "facing_z"]].to_numpy() == pytest.approx(np.eye(3)[[1, 0]], abs=1e-6)
    assert table.filter(like="orientation").to_numpy() == pytest.approx(np.array([pose.orientation for pose in poses]))
    with np.load(tmp_path / "suggested.npz") as arrays:
        section = poses_section(arrays, "suggested", "run")
    assert "by 0.150 m (standard error 0.020 m) from 0.350 m" in section.paragraphs[0]
    assert [row[0] for row in section.tables[0].rows] == ["1", "2"]
    assert poses_section({}, "suggested", "run") is None


def test_poses_of_a_run(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(quick, "known_planes", lambda: known_planes(*OFFICE_WALLS))
    few = partial(simulated_stations, n=40, grid=GRID)
    short = partial(suggest_station, n_positions=8, config=TINY)
    for name, function in {
        "simulated_stations": few,
        "compare_stations": partial(compare_stations, config=TINY),
        "suggest_station": short,
    }.items():
        monkeypatch.setattr(f"tasks.locate.experiment.{name}", function)
    assert quick.run("locate", "--stations", 2, "--suggest", 2, "--out", tmp_path / "run") == 0
    assert "a next array at (" in capsys.readouterr().err
    table = pd.read_csv(tmp_path / "run" / "suggested.csv")
    assert len(table) == 2
    assert table["expected_error_m"].is_monotonic_increasing
    assert "Where the next array belongs" in (tmp_path / "run" / "report.html").read_text()
