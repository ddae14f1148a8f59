"""Planes of a room in the report: numbers and line styles by their definitions."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

from swiftwrf.models.geometry import Plane
from swiftwrf.models.geometry.planes import RoomEstimate
from tasks.aoa.room import room_section

PLANES = [
    Plane((-1.0, 0.0, 0.0), -0.012, -0.63, 1.94, 0.998),
    Plane((0.0, 1.0, 0.0), 5.002, -0.5, 4.0, 0.9, 5.106),
    Plane((0.0, -1.0, 0.0), 0.206, -0.12, 7.25, 0.893, -0.107, dielectric=True),
]


@pytest.fixture
def section(tmp_path):
    estimate = RoomEstimate(PLANES, 2, 0.017, 0.035, "", np.eye(3))
    (tmp_path / "geometry-mix0.3.json").write_text(json.dumps(estimate.to_json()))
    points = {"image": np.zeros((1, 3)), "order": np.ones(1), "measured": np.ones((4, 3)), "fixed": np.zeros(3)}
    run = SimpleNamespace(folder=tmp_path)
    return room_section(SimpleNamespace(run=run, key="0.3", file_name="mix0.3", arrays=lambda _: points))


def test_each_plane_has_its_deviation_probability_and_strongest_alternative(section):
    (table,) = section.tables
    assert [list(row) for row in table.rows] == [
        ["x = 0.012 m", "-0.63", "1.9", "99.8%", "none", "yes"],
        ["y = 5.002 m", "-0.50", "4.0", "90.0%", "y = 5.106 m", "yes"],
        ["y = -0.206 m", "-0.12 (dielectric)", "7.2", "89.3%", "y = 0.107 m", "no"],
    ]


def test_planes_that_are_not_identifiable_are_dashed(section):
    lines = [line for line in section.plots[0].panels[0].axes[0].lines if len(line.get_xdata()) == 2]
    assert [line.get_linestyle() for line in lines] == ["-", "-", "--"]
    np.testing.assert_allclose([np.unique(lines[0].get_xdata()), np.unique(lines[2].get_ydata())], [[0.012], [-0.206]])
