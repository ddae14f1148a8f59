"""The coverage that a run states: the same in its report, JSON, terminal and page, by an independent computation."""

import json
import re
from hashlib import sha256
from html import unescape

import numpy as np
import pandas as pd
import pytest
import quick
import torch
from scipy.integrate import quad
from scipy.spatial import ConvexHull
from scipy.spatial.distance import cdist
from scipy.stats import norm

from swiftwrf import load, load_rssi, rssi_room
from swiftwrf.rssi.coverage import reach
from tasks.records import Records
from tasks.rssi.page import page
from tasks.view.rssi import MapSelection
from tasks.view.sources import open_source

NAMES = ("Ground floor", "1")


@pytest.fixture(scope="module")
def building(tmp_path_factory):
    """A run around the middle of two floors, weak signals above, every packet detected: folder and terminal."""
    folder = tmp_path_factory.mktemp("building")
    data = rssi_room(n=200).columns([0, 5, 11])
    at = data.transmitter_position
    data = data.subset(((at - at.mean(dim=0)).norm(dim=1) > 8.0).nonzero()[:, 0])
    position, rssi = data.transmitter_position.clone(), data.rssi_dbm.nan_to_num(-66.0) - 5.7
    upper = torch.arange(len(data)) % 3 == 0
    position[upper, 2] += 4.0
    rssi[upper] -= 16.0
    table = pd.DataFrame(torch.cat([position, rssi], dim=1).numpy(), columns=["x", "y", "z", "a", "b", "c"])
    table.insert(3, "floor", np.where(upper, NAMES[1], NAMES[0]))
    table.to_csv(folder / "walk.csv", index=False)
    corners = [(*at, floor) for floor in NAMES for at in ((3, 2), (12, 2), (12, 9), (3, 9))]
    rooms = pd.DataFrame(corners, columns=["x", "y", "floor"]).assign(room=["hall"] * 4 + ["office"] * 4)
    rooms.to_csv(folder / "rooms.csv", index=False)
    with quick.recorded(folder), quick.sketched(), pytest.MonkeyPatch.context() as patch:
        patch.setattr("swiftwrf.rssi.maps.CELLS", 16)
        assert quick.command("rssi", "--rx", "all", "--data", folder / "walk.csv", "--out", folder / "run") == 0
    return folder / "run", (folder / "out.txt").read_text()


def probability(mean, std):
    """Probability that one of the receivers (R,), whose errors have the correlation 0.2, is above -75 dBm."""
    score = norm.ppf(norm.sf(-75, mean, std))

    def none(factor):
        return norm.pdf(factor) * norm.sf((score + np.sqrt(0.2) * factor) / np.sqrt(0.8)).prod()

    return 1 - quad(none, -8, 8)[0]


def inside_by_halfspaces(cells, at):
    equations = ConvexHull(at).equations
    return (cells @ equations[:, :2].T + equations[:, 2] <= 0).all(axis=1)


@pytest.mark.parametrize("floor", [0, 1])
def test_one_number_everywhere(building, floor):
    folder, terminal = building
    model, metrics = load(folder / "model.safetensors"), json.loads((folder / "metrics.json").read_text())
    with np.load(folder / "maps.npz") as stored:
        maps = dict(stored)
    rows = maps["floor_of_row"] == floor
    height, at = model.attenuation.floors.height_m[floor], maps["measured_position"][rows, :2]
    cells = np.stack(np.meshgrid(maps["x"], maps["y"]), axis=-1).reshape(-1, 2)
    found = model.predict(np.c_[cells, np.full(len(cells), height)])
    above = np.array([probability(mean, std) for mean, std in zip(found.mean, found.std, strict=True)])
    inside, near = inside_by_halfspaces(cells, at), cdist(cells, at).min(axis=1) <= reach(model)
    known = inside & near
    assert known.sum() < inside.sum()
    expected = {
        "covered": (above[known] >= 0.9).mean(),
        "not_covered": (above[known] <= 0.1).mean(),
        "uncertain": ((above > 0.1) & (above < 0.9))[known].mean(),
        "not_measured": 1 - near[inside].mean(),
        "scans_above": (maps["measured"][rows].max(axis=1) > -75).mean(),
    }
    assert {name: metrics["coverage"][floor][name] for name in expected} == pytest.approx(expected)
    assert metrics["coverage"][floor]["floor"] == NAMES[floor]
    shares = {name: f"{share:.0%}" for name, share in expected.items()}
    assert 0.1 < expected[("covered", "not_covered")[floor]] < 0.9
    place = f"the measured area of {('Ground floor', 'floor 1')[floor]}"
    headline = f"{shares['covered']} of {place}"
    sentence = (
        f"{headline} is covered (one of 3 receivers above -75 dBm with at least 90% probability), "
        f"{shares['not_covered']} is not covered (at most 10%), {shares['uncertain']} is uncertain (between them). "
        f"{shares['scans_above']} of the {rows.sum()} scans pass the threshold. {shares['not_measured']} of the area "
        f"between the scans is not measured, over {reach(model):.1f} m from any scan."
    )
    report = unescape(re.sub("<[^>]*>", "", (folder / "report.html").read_text()))
    for text in (terminal, report):
        assert sentence in text
    answer = [line for line in terminal.splitlines() if headline in line]
    assert answer == [sentence]  # the numbers are stated once
    assert re.search(rf"{shares['covered']}\s*of {place} above -75 dBm", report)
    view = open_source(folder)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("swiftwrf.rssi.maps.CELLS", 16)
        shown = view.coloured(MapSelection("coverage", 0, height, at_least=1)).sentence
    assert shown == sentence.replace(place, "the measured area")
    np.testing.assert_allclose(maps["above"][floor].ravel(), above, atol=1e-4)


@pytest.mark.parametrize("floor", [0, 1])
def test_test_scans_are_counted_beside_their_prediction(building, floor):
    """In coverage.csv, for one of all receivers, for two, and for each, from the split and the model of the run."""
    folder, terminal = building
    model, table = load(folder / "model.safetensors"), pd.read_csv(folder / "coverage.csv")
    _, test = load_rssi(folder.parent / "walk.csv").split()
    test = test[model.attenuation.floors.number(test.transmitter_position) == floor]
    found = model.predict_detected(test)
    mean, std, rssi = found.mean.numpy(), found.std.numpy(), test.rssi_dbm.numpy()
    of_floor = table[table["floor"].astype(str) == NAMES[floor]].set_index("receiver")
    assert of_floor.index.tolist() == ["any receiver", "two receivers", "a", "b", "c"]
    assert (of_floor["n_test"] == len(test)).all()
    any_above = np.mean([probability(*row) for row in zip(mean, std, strict=True)])
    expected = {"any receiver": (any_above, (rssi > -75).any(axis=1).mean())}
    expected |= {
        name: (norm.sf(-75, mean, std)[:, i].mean(), (rssi[:, i] > -75).mean()) for i, name in enumerate("abc")
    }
    for name, shares in expected.items():
        assert of_floor.loc[name, ["test_predicted", "test_above"]].tolist() == pytest.approx(shares, abs=1e-3)
    assert of_floor.loc["two receivers", "test_above"] == ((rssi > -75).sum(axis=1) >= 2).mean()
    every = table[table["receiver"] == "any receiver"]
    counted, predicted = (np.average(every[name], weights=every["n_test"]) for name in ("test_above", "test_predicted"))
    scans = f"Of {every['n_test'].sum()} test scans, which took no part in the fit"
    assert f"{scans}, {counted:.0%} pass and {predicted:.0%} were predicted to." in terminal


def test_the_answer_states_how_near_the_test_rows_are_to_training_rows(building):
    """The distances are those of the split: errors at a neighbouring scan are not those of an unmeasured place."""
    folder, terminal = building
    train, test = load_rssi(folder.parent / "walk.csv").split()
    apart = cdist(test.transmitter_position.numpy(), train.transmitter_position.numpy()).min(axis=1)
    near = np.median(np.repeat(apart, test.detected.sum(dim=1).numpy()))
    n = int(test.detected.sum())
    assert f"Tested on {n} measurements, half of them within {near:.1f} m of one of the {len(train)} rows" in terminal


def test_weak_spots_are_listed_from_the_largest(building):
    folder, terminal = building
    spots = pd.read_csv(folder / "weak_spots.csv", dtype={"floor": str})
    with np.load(folder / "maps.npz") as stored:
        maps = dict(stored)
    weak = maps["known"] & (maps["above"] < 0.9)
    cell = maps["x"][1] - maps["x"][0]
    for floor, name in enumerate(NAMES):
        assert spots[spots["floor"] == name]["area_m2"].sum() == pytest.approx(weak[floor].sum() * cell**2, abs=0.01)
    first = spots.sort_values(["not_covered_m2", "area_m2"], ascending=False).iloc[0]
    place = f"{first['area_m2']:,.0f} m², weakest at x = {first['x_m']:.1f} m, y = {first['y_m']:.1f} m on floor 1 ("
    sentence = f"Largest weak spots: {place}{first['missing_db']:.0f} dB missing at {first['receiver']})"
    report = unescape(re.sub("<[^>]*>", "", (folder / "report.html").read_text()))
    assert sentence in terminal
    assert sentence in report
    assert "-75 dBm is the default for receivers that no name shows to be Wi-Fi; --above DBM sets another" in report


def test_rooms_have_the_coverage_of_their_cells(building):
    folder, _ = building
    read = json.loads((folder / "environment.json").read_text())["input_sha256"]
    assert read["rooms.csv"] == sha256((folder.parent / "rooms.csv").read_bytes()).hexdigest()
    table = pd.read_csv(folder / "rooms.csv").set_index("room")
    with np.load(folder / "maps.npz") as stored:
        maps = dict(stored)
    x, y = np.meshgrid(maps["x"], maps["y"])
    within, cell = (x > 3) & (x < 12) & (y > 2) & (y < 9), maps["x"][1] - maps["x"][0]
    assert table.index.tolist() == ["hall", "office"]
    for floor, room in enumerate(("hall", "office")):
        above, known = maps["above"][floor][within], maps["known"][floor][within]
        expected = {
            "area_m2": within.sum() * cell**2,
            "covered": (above[known] >= 0.9).mean(),
            "not_covered": (above[known] <= 0.1).mean(),
            "not_measured": 1 - known.mean(),
        }
        assert table.loc[room, list(expected)].to_dict() == pytest.approx(expected)
        strongest = maps["predicted"][floor][:, within].mean(axis=1).argmax()
        assert table.loc[room, "best_receiver"] == "abc"[strongest]
    report = unescape(re.sub("<[^>]*>", "", (folder / "report.html").read_text()))
    assert re.search(rf"hall\s*-75\s*{table.loc['hall', 'area_m2']:.0f}\s*{table.loc['hall', 'covered']:.0%}", report)


def test_widths_are_those_of_the_80_percent_interval(building):
    folder, _ = building
    model = load(folder / "model.safetensors")
    with np.load(folder / "maps.npz") as stored:
        maps = dict(stored)
    cells = np.stack(np.meshgrid(maps["x"], maps["y"]), axis=-1).reshape(-1, 2)
    for floor, height in enumerate(model.attenuation.floors.height_m):
        std = model.predict(np.c_[cells, np.full(len(cells), height)]).std.numpy()
        width = np.subtract(*norm.interval(0.8, scale=std)[::-1])
        np.testing.assert_allclose(maps["width"][floor], width.T.reshape(maps["width"].shape[1:]), rtol=1e-4)


def test_no_share_is_stated_of_a_floor_without_measured_cells(building):
    folder, _ = building
    metrics = json.loads((folder / "metrics.json").read_text())
    metrics["coverage"][1] |= {"covered": None, "uncertain": None, "not_covered": None}
    found = page([Records(folder, metrics)])
    assert "No cell of the map is in the measured area of floor 1." in found.summary.conclusion
    stated = [number.meaning for number in found.summary.numbers if number.value.endswith("%")]
    assert [meaning.partition(" above")[0] for meaning in stated[:-1]] == ["of the measured area of Ground floor"]


def test_nothing_is_covered_between_ends_that_both_move(tmp_path):
    """Places where a receiver was are not there at once; 0 % was stated before, whatever the links were."""
    draw = np.random.default_rng(0)
    links = pd.DataFrame(draw.uniform(0, 9, (60, 4)), columns=["tx_x", "tx_y", "rx_x", "rx_y"])
    links["rssi"] = (-40 - 20 * np.log10(1 + np.hypot(links.tx_x - links.rx_x, links.tx_y - links.rx_y))).round()
    links.to_csv(tmp_path / "links.csv", index=False)
    with quick.recorded(tmp_path), quick.sketched():
        assert quick.command("rssi", "--data", tmp_path / "links.csv", "--out", tmp_path / "run") == 0
    report = unescape(re.sub("<[^>]*>", "", (tmp_path / "run" / "report.html").read_text()))
    for text in ((tmp_path / "out.txt").read_text(), report):
        assert "Predictions are within" in text
        assert not re.search(r"is covered|[Ww]eak spots|threshold|% of the measured area", text)
    assert json.loads((tmp_path / "run" / "metrics.json").read_text())["coverage"][0]["covered"] is None
