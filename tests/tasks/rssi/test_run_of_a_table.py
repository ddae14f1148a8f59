"""Runs on a table of a walk in degrees, by two phones, with a sign of not detected and rows that repeat."""

import json
import re
from shutil import copytree

import numpy as np
import pandas as pd
import pytest
import quick
from samples import walk

from swiftwrf import Rssi, RssiModel, load, load_rssi
from swiftwrf.choices import RSSI_PREDICTORS
from swiftwrf.data.coordinates import GeodeticOrigin
from swiftwrf.data.rssi import Offsets
from swiftwrf.locate import RssiLocator
from swiftwrf.rssi import estimate_offsets

NAMES, ORIGIN, FILLER = ["a", "b", "c", "d"], GeodeticOrigin(59.33, 18.07), -107
OFFSET = {"pixel": 0.0, "galaxy": -11.0}
DRAW = np.random.default_rng(0)
PHONE, SILENT = DRAW.choice(list(OFFSET), 60, p=[0.6, 0.4]), DRAW.random((60, 4)) < 0.2


def by_phone(name):
    """The RSSI of the walk as phones of these names measure it."""
    return walk()[NAMES] + np.array([OFFSET[each] for each in np.broadcast_to(name, 60)])[:, None]


DEGREES = ORIGIN.to_degrees(walk()[["x", "y"]].to_numpy())
PLACED = pd.DataFrame(DEGREES, columns=["lat", "lon"]).assign(z=1.1)
TABLE = PLACED.join(by_phone(PHONE).mask(SILENT, FILLER)).assign(Device=PHONE)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The table, each row twice, with a split that tests look-up, and a run of RSSI on it."""
    folder = tmp_path_factory.mktemp("walked")
    (folder / "walk").mkdir()
    pd.concat([TABLE] * 2).to_csv(folder / "walk" / "walk.csv", index=False)
    order = np.random.default_rng(1).permutation(120)
    for part, rows in (("train", order[:96]), ("test", order[96:])):
        (folder / "walk" / f"{part}_index.txt").write_text("\n".join(map(str, rows)))
    copytree(folder / "walk", folder / "unread")
    (folder / "walk" / "reading.yaml").write_text("offset_by: Device=galaxy")
    source = ("--rx", "all", "--data", folder / "walk")
    assert quick.run("rssi", *source, "--out", folder / "rssi") == 0
    return folder


def assert_noted(page):
    """The first screen states what the reader and the split do."""
    first = page[: page.index("What to do next")]
    assert re.search(r"This split tests look-up: [5-9]\d% of the test rows", first)
    assert f"{FILLER} counts as not detected: {2 * SILENT.sum()} of 480 cells" in first


def test_predictions_are_of_the_rows_in_degrees_and_of_their_phones(folder):
    run = folder / "rssi"
    page = (run / "report.html").read_text()
    assert_noted(page)
    assert "unknown positions of access points" in page
    notes = json.loads((run / "metrics.json").read_text())["notes"]
    assert any("offsets of Device relative to galaxy" in note for note in notes)
    predicted = pd.read_csv(run / "predictions.csv")
    away = np.abs(predicted[["latitude_deg", "longitude_deg"]].to_numpy()[:, None] - DEGREES).max(axis=2).min(axis=1)
    assert away.max() < 1e-8
    assert set(predicted["group"]) == set(OFFSET)
    assert predicted["measured"].isin(TABLE[NAMES].to_numpy().ravel()).all()
    cells = pd.read_csv(run / "figures" / "summary.csv")
    assert cells["latitude_deg"].between(*(DEGREES[:, 0].min() - 1e-4, DEGREES[:, 0].max() + 1e-4)).all()
    assert load(run / "model.safetensors").offsets.reference == "galaxy"


def test_what_a_run_of_locate_and_an_inspection_note(folder, capsys):
    where = ("--rx", "all", "--data", folder / "walk", "--cells", 200)
    assert quick.run("locate", *where, "--out", folder / "locate") == 0
    assert_noted((folder / "locate" / "report.html").read_text())
    capsys.readouterr()
    assert quick.run("inspect", folder / "unread", "--out", folder / "inspection") == 0
    printed = capsys.readouterr().out
    assert "Split random tests look-up" in printed
    assert "--offset-by Device" in printed
    zone, day = np.where(walk().x < 12, "west", "east"), DRAW.choice(["monday", "friday"], 60)
    plain = PLACED.join(walk()[NAMES]).assign(zone=zone, day=day)
    plain.to_csv(folder / "plain.csv", index=False)
    assert quick.run("inspect", folder / "plain.csv", "--out", folder / "other") == 0
    assert "--offset-by" not in capsys.readouterr().out  # of columns without offsets
    (folder / "nowhere.yaml").write_text("offset_by: Device=nowhere")
    assert quick.run("rssi", *where[:4], "--read", folder / "nowhere.yaml", "--out", folder / "none") == 2
    assert "nowhere" in quick.said(capsys)


def test_a_locator_returns_degrees_of_its_own_origin_whatever_the_phone(folder):
    data = load_rssi(folder / "walk", offset_by="Device")
    RssiLocator(n_cells=300).fit(estimate_offsets(data, "pixel").removed(data)).save(folder / "locator")
    assert load(folder / "locator").model.origin == data.origin
    later, found = slice(40, 60), {}  # a later log, with another median of its positions
    for phone in OFFSET:  # the same transmitters, at positions that the second table does not contain
        table = PLACED.join(by_phone(phone)) if phone == "pixel" else by_phone(phone)
        table.assign(Device=phone)[later].to_csv(folder / f"{phone}.csv", index=False)
        out = folder / f"{phone}-positions.csv"
        assert quick.command("predict", folder / "locator", folder / f"{phone}.csv", "--out", out) == 0
        found[phone] = pd.read_csv(out)
    positions, metres = found["pixel"], [found[phone][["x_m", "y_m"]].to_numpy() for phone in OFFSET]
    assert np.median(np.linalg.norm(metres[0] - metres[1], axis=1)) < 1.0
    truth = data.origin.to_metres(DEGREES[later])
    np.testing.assert_allclose(positions[["truth_x_m", "truth_y_m"]], truth, atol=1e-3)
    estimate = data.origin.to_metres(positions[["latitude_deg", "longitude_deg"]].to_numpy())
    np.testing.assert_allclose(estimate, metres[0], atol=2e-3)  # both are rounded to a millimetre


@pytest.mark.parametrize("kind", ["devices", "channels"])
def test_offsets_between_groups_of_rows(kind):
    at = np.random.default_rng(3)
    if kind == "devices":
        truth, column = OFFSET, "Device"
        table = walk()[["x", "y"]].join(by_phone(PHONE)).assign(Device=PHONE)
    else:
        truth, column = {"37": 0.0, "38": 6.0, "39": -5.0}, "ch"
        table = walk().melt(["x", "y"], var_name="gateway", value_name="rssi")
        table = table.loc[table.index.repeat(3)].reset_index(drop=True).assign(ch=list(truth) * 240)
        table["rssi"] += table["ch"].map(truth) + at.normal(0, 1, 720)
        table = table[at.random(720) < 0.8]  # packets are lost
    train, test = Rssi.from_frame(table, offset_by=column).split("random")
    reference = next(iter(truth))
    offsets = estimate_offsets(train, reference)
    assert offsets.offset_db == pytest.approx(truth, abs=1.0)
    errors = []
    for known in (Offsets(column, reference, {}, 0.0), offsets):
        predicted = RssiModel().fit(known.removed(train)).predict(test.transmitter_position).mean
        errors.append(float((predicted + known.of(test)[:, None] - test.rssi_dbm).abs().nanmedian()))
    assert errors[1] < 0.65 * errors[0]


@pytest.mark.parametrize("scale", [0.01, 1.0, 100.0])
def test_the_lengths_of_a_gaussian_process_follow_the_extent(scale):
    table = walk()
    train, test = Rssi.from_frame(table.assign(x=scale * table.x, y=scale * table.y)).split("random")
    errors = [
        float((RSSI_PREDICTORS[name]().fit(train).predict(test.transmitter_position).mean - test.rssi_dbm).abs().mean())
        for name in ("gp", "mean")
    ]
    assert errors[0] < 0.6 * errors[1]
