"""Rooms against inequalities, sums of masses, and held-out rows."""

import json

import numpy as np
import pandas as pd
import pytest
import torch

import swiftwrf
from swiftwrf import InputError, rssi_room
from swiftwrf.data.coordinates import Floors, GeodeticOrigin, PlanFrame
from swiftwrf.data.rooms import Rooms, read_rooms
from swiftwrf.locate import Posterior

L_SHAPE = [[0, 0], [6, 0], [6, 2], [3, 2], [3, 5], [0, 5]]
YARD, TREE = [[6, 0], [12, 0], [12, 5], [6, 5]], [[8, 1], [9, 1], [9, 2], [8, 2]]


def polygon(name, *rings, floor=None):
    closed = [[*ring, ring[0]] for ring in rings]
    about = {"name": name} | ({} if floor is None else {"Level": floor})
    return {"type": "Feature", "properties": about, "geometry": {"type": "Polygon", "coordinates": closed}}


def document(folder, *features):
    file = folder / "rooms.geojson"
    file.write_text(json.dumps({"type": "FeatureCollection", "features": list(features)}))
    return file


def of_inequalities(x, y):
    lab = (x > 0) & (x < 6) & (y > 0) & (y < 5) & ((x < 3) | (y < 2))
    yard = (x > 6) & (x < 12) & (y > 0) & (y < 5) & ~((x > 8) & (x < 9) & (y > 1) & (y < 2))
    return np.where(lab, "lab", np.where(yard, "yard", "outside"))


def test_rooms_have_corners_and_holes(tmp_path):
    at = np.c_[np.random.default_rng(0).random((2000, 2)) * (14, 7) - 1, np.ones(2000)]
    rooms = read_rooms(document(tmp_path, polygon("lab", L_SHAPE), polygon("yard", YARD, TREE)))
    names = rooms.named(torch.from_numpy(at))
    assert set(names) == {"lab", "yard", "outside"}
    assert names == of_inequalities(at[:, 0], at[:, 1]).tolist()


def test_a_table_of_corners_is_the_same(tmp_path):
    corners = [("lab", *corner) for corner in L_SHAPE] + [("yard", *corner) for corner in YARD]
    table = pd.DataFrame(corners, columns=["room", "x", "y"])
    table.to_csv(tmp_path / "rooms.csv", index=False)
    scaled = table.assign(x=20 * table["x"], y=-20 * table["y"])
    scaled.to_csv(tmp_path / "pixels.csv", index=False)
    expected = read_rooms(document(tmp_path, polygon("lab", L_SHAPE), polygon("yard", YARD)))
    for file, frame in (("rooms.csv", PlanFrame()), ("pixels.csv", PlanFrame(20.0, y_down=True))):
        found = read_rooms(tmp_path / file, frame=frame)
        assert found.names == expected.names
        at = torch.rand(500, 3, dtype=torch.float64) * 13
        np.testing.assert_array_equal(found.contain(at), expected.contain(at))


def test_rooms_of_degrees_are_where_the_measurements_are(tmp_path):
    origin = GeodeticOrigin(48.0, 11.0)
    corners = np.array(L_SHAPE, dtype=float) * 10
    degrees = origin.to_degrees(corners)[:, ::-1].tolist()
    found = read_rooms(document(tmp_path, polygon("lab", degrees)), origin)
    np.testing.assert_allclose(found.rings[0][0][:-1], corners, atol=1e-6)


def test_a_room_is_on_its_floor(tmp_path):
    floors = Floors(("ground", "first"), (1.0, 5.0))
    features = [polygon("lab", L_SHAPE, floor="ground"), polygon("lab", L_SHAPE, floor="first")]
    rooms = read_rooms(document(tmp_path, *features), floors=floors)
    assert rooms.named(torch.tensor([[1.0, 1, 1.2], [1.0, 1, 4.8]])) == ["lab (ground)", "lab (first)"]
    with pytest.raises(InputError, match="needs the floor of each room, one of ground, first"):
        read_rooms(document(tmp_path, polygon("lab", L_SHAPE)), floors=floors)


def test_probabilities_are_sums_of_masses():
    rooms = Rooms(("left", "right"), tuple((np.array(ring, dtype=float),) for ring in (L_SHAPE, YARD)))
    generator = torch.Generator().manual_seed(0)
    at = torch.rand(1, 400, 3, generator=generator, dtype=torch.float64) * torch.tensor([14.0, 6.0, 1.0])
    mass = torch.rand(5, 400, generator=generator, dtype=torch.float64)
    mass /= mass.sum(dim=1, keepdim=True)
    posterior = Posterior(at, mass.log())
    found = rooms.probability(posterior.position, posterior.weight)
    names = np.array(rooms.named(at[0]))
    expected = [[mass[row].numpy()[names == name].sum() for name in ("left", "right", "outside")] for row in range(5)]
    np.testing.assert_allclose(found, expected)
    columns = rooms.columns(found)
    assert columns["room"].tolist() == [("left", "right", "outside")[np.argmax(row)] for row in expected]
    np.testing.assert_allclose(columns["room_probability"], np.max(expected, axis=1))


def test_probabilities_of_rooms_are_calibrated():
    """Four rooms of 10 x 8 m: the share of rows whose most probable room is right against the mean probability of it."""
    train, test = rssi_room(n=400, seed=5).split()
    xs, ys = (0.0, 10.0, 20.0), (0.0, 8.0, 16.0)
    boxes = [
        np.array([[xs[i], ys[j]], [xs[i + 1], ys[j]], [xs[i + 1], ys[j + 1]], [xs[i], ys[j + 1]]])
        for i in (0, 1)
        for j in (0, 1)
    ]
    rooms = Rooms(("sw", "nw", "se", "ne"), tuple((box,) for box in boxes))
    table = swiftwrf.predict(swiftwrf.RssiLocator(n_cells=1000).fit(train), test, rooms=rooms)
    at = table[["truth_x_m", "truth_y_m"]].to_numpy()
    truth = np.where(at[:, 1] < 8, "s", "n").astype(object) + np.where(at[:, 0] < 10, "w", "e").astype(object)
    right = (table["room"] == truth).mean()
    assert right > 0.8
    assert table["room_probability"].mean() == pytest.approx(right, abs=0.08)
    every = table[[f"probability_{name}" for name in (*rooms.names, "outside")]]
    np.testing.assert_allclose(every.sum(axis=1), 1.0)
    np.testing.assert_allclose(every.max(axis=1), table["room_probability"])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("room,x,y\nlab,0,0\nlab,1,0\n", "room 'lab' has fewer than three corners"),
        ("x,y\n0,0\n1,0\n1,1\n", "needs a column room"),
        ("room,x,y\nlab,0,0\nlab,1,\nlab,1,1\n", "has a corner without position"),
        ("room,x,y\noutside,0,0\noutside,1,0\noutside,1,1\n", "none of them 'outside'"),
        ("room,x\nlab,0\nlab,1\n", "no columns of positions"),
    ],
)
def test_wrong_tables_are_refused(tmp_path, content, message):
    (tmp_path / "rooms.csv").write_text(content)
    with pytest.raises(InputError, match=message):
        read_rooms(tmp_path / "rooms.csv")


@pytest.mark.parametrize("text", ["{}", "[1]", "no json", '{"features": [{"geometry": {"type": "Polygon"}}]}'])
def test_wrong_documents_are_refused(tmp_path, text):
    (tmp_path / "rooms.geojson").write_text(text)
    with pytest.raises(InputError):
        read_rooms(tmp_path / "rooms.geojson")


def test_rooms_are_of_locators():
    rooms = Rooms(("lab",), ((np.array(L_SHAPE, dtype=float),),))
    with pytest.raises(InputError, match="locates nothing"):
        swiftwrf.predict(swiftwrf.RssiModel().fit(rssi_room(n=30)), [[0.0, 0.0, 1.0]], rooms=rooms)
