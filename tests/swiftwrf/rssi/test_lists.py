"""Rows that list the strongest or the associated receivers only: what an empty cell is, and the map where it is empty."""

import numpy as np
import pandas as pd
import pytest
import torch

from swiftwrf import Rssi, RssiModel, rssi_room
from swiftwrf.data.scans import list_margin

FLOOR = rssi_room(n=300, seed=1)


def strongest(number: int, hysteresis_db: float = 0.0) -> Rssi:
    """Return the table of a floor with the strongest receivers of each row only, with a random lead over the others."""
    generator = torch.Generator().manual_seed(0)
    rssi = FLOOR.rssi_dbm.nan_to_num(-200.0)
    rank = rssi + hysteresis_db * torch.rand(rssi.shape, generator=generator)
    kept = torch.zeros_like(rssi, dtype=torch.bool).scatter(1, rank.topk(number, dim=1).indices, True)
    table = pd.DataFrame(FLOOR.rssi_dbm.where(kept, torch.nan), columns=list(FLOOR.receiver_names))
    x, y, z = FLOOR.transmitter_position.T.numpy()
    return Rssi.from_frame(table.assign(x=x, y=y, z=z))


@pytest.mark.parametrize(("number", "margin_db"), [(4, 0.0), (1, 8.0)])
def test_the_map_of_a_receiver_that_is_not_listed_is_nearer_to_the_truth(number, margin_db):
    data = strongest(number, hysteresis_db=margin_db / 2)
    assert data.margin_db == margin_db
    assert any("no sign of a signal below the limit" in note for note in data.notes)
    truth = FLOOR.rssi_dbm[:, [FLOOR.receiver_names.index(name) for name in data.receiver_names]]
    empty = ~data.detected & ~truth.isnan()
    error = {}
    for meaning in ("auto", "unknown", "weak"):
        model = RssiModel(not_detected=meaning).fit(data)
        error[meaning] = float((model.predict(data.transmitter_position).mean - truth)[empty].abs().mean())
        if meaning == "auto":  # being listed is no detection
            assert bool((model.predict_detection(data.transmitter_position) == 1).all())
    assert error["auto"] < 0.75 * error["unknown"]
    assert number == 1 or error["auto"] < 0.9 * error["weak"]


def test_a_receiver_is_uncertain_where_another_one_was_associated():
    """The standard deviation is that of kriging with the receiver's own rows, in plain NumPy; the path loss is certain."""
    data = strongest(1, hysteresis_db=4.0)
    model = RssiModel().fit(data)
    model.covariance = torch.zeros_like(model.covariance)
    at, std = data.transmitter_position[:50], model.predict(data.transmitter_position[:50]).std
    for number, seen in enumerate(data.detected.T):
        own = data.transmitter_position[seen]
        cross = model.kernel(at, own).numpy()
        explained = (cross * np.linalg.solve(model.kernel.covariance(own).numpy(), cross.T).T).sum(axis=1)
        variance = float(model.noise_db[number]) ** 2 + float(model.field_db[number]) ** 2 * (1 - explained)
        np.testing.assert_allclose(std[:, number], np.sqrt(variance), rtol=0.02)


def packets(order: str) -> tuple[np.ndarray, np.ndarray]:
    """Return rows of one of three receivers along a line, in turn or by regions, and their positions."""
    row = np.arange(90)
    receiver = row % 3 if order == "in turn" else row // 30
    return np.where(receiver[:, None] == np.arange(3), -60.0, np.nan), np.outer(row, [1.0, 0, 0])


def test_single_packets_of_receivers_in_turn_are_no_associations():
    assert list_margin(*packets("in turn")) == np.inf
    assert list_margin(*packets("by regions")) == 8.0


def ordinary(kind: str) -> np.ndarray:
    """Return RSSI whose empty cells follow from what each receiver detects."""
    draw = np.random.default_rng(0)
    rssi = draw.uniform(-90, -40, (200, 8))
    if kind == "two buildings":  # with four receivers each
        return np.where((np.arange(200)[:, None] < 100) == (np.arange(8) < 4), rssi, np.nan)
    if kind == "one far receiver":  # that few rows detect, where the other one was off
        return np.where((np.arange(200)[:, None] < 8) == (np.arange(2) == 1), rssi[:, :2], np.nan)
    return np.where(rssi > {"sensitive": -90.0, "insensitive": -65.0, "rare": -45.0}[kind], rssi, np.nan)


@pytest.mark.parametrize("kind", ["two buildings", "one far receiver", "sensitive", "insensitive", "rare"])
def test_other_surveys_are_no_lists(kind):
    assert list_margin(ordinary(kind), np.random.default_rng(1).random((200, 3))) is None


@pytest.mark.data
@pytest.mark.parametrize(
    "name", ["ts-dsi1/survey.csv", "ts-ujib1/survey.csv", "ts-tut5/survey.csv", "dae-2025/survey.csv"]
)
def test_measured_scans_are_no_lists(measured_data, name):
    table = pd.read_csv(measured_data / name)
    rssi = table.drop(columns=["x", "y", "z", "floor"], errors="ignore").to_numpy(float)
    rssi[(rssi == 100) | (rssi == -100)] = np.nan
    assert list_margin(rssi, table[["x", "y"]].to_numpy(float)) is None
