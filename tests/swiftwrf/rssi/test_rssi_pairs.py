"""RSSI where both ends of the link move: tables with two positions, the split by place, and models over pairs."""

import json

import numpy as np
import pandas as pd
import pytest
import torch
from quick import command, sketched
from small import only, small

import swiftwrf
from swiftwrf import InputError, PairModel, Rssi, load_rssi
from swiftwrf.choices import RSSI_PREDICTORS
from swiftwrf.positions import cells

WALL_DB, WALL_X, ROOM_M = 14.0, 4.0, 8.0


def links(n_places=30, rows=30, seed=0, noise_db=1.0):
    """Links across a wall at x = 4 m, which takes 14 dB. A row of the table has one position of each end."""
    draw = np.random.default_rng(seed)
    tx = np.repeat(draw.uniform(0, ROOM_M, (n_places, 2)), rows, axis=0)
    rx = draw.uniform(0, ROOM_M, (len(tx), 2))
    distance = np.hypot(*(tx - rx).T).clip(0.3)
    behind = (tx[:, 0] < WALL_X) != (rx[:, 0] < WALL_X)
    rssi = -40 - 20 * np.log10(distance) - WALL_DB * behind + noise_db * draw.normal(size=len(tx))
    return pd.DataFrame({"rx_x": rx[:, 0], "rx_y": rx[:, 1], "tx_x": tx[:, 0], "tx_y": tx[:, 1], "rssi": rssi})


def error_db(predictor, train, test):
    predictor.fit(train)
    mean = predictor.predict_detected(test).mean
    return float((mean - test.rssi_dbm).abs().nanmean())


def test_columns_of_both_ends_are_recognised():
    table = links(n_places=12)
    data = Rssi.from_frame(table)
    assert data.receiver_moves
    assert data.receiver_names == tuple(f"place{number}" for number in range(1, 13))
    row, column = data.detected.nonzero(as_tuple=True)
    assert row.tolist() == list(range(len(table)))
    torch.testing.assert_close(data.rssi_dbm[row, column], torch.tensor(table["rssi"].to_numpy()))
    torch.testing.assert_close(data.receiver_position[column, :2], torch.tensor(table[["tx_x", "tx_y"]].to_numpy()))
    torch.testing.assert_close(data.transmitter_position[:, :2], torch.tensor(table[["rx_x", "rx_y"]].to_numpy()))
    assert any("both ends move; 12 positions" in note for note in data.notes)


@pytest.mark.parametrize(
    ("names", "transmitter"),
    [
        (["x", "y", "x_tx", "y_tx"], ()),
        (["x", "y", "Transmitter X [m]", "Transmitter Y [m]"], ()),
        (["rx_x", "rx_y", "x", "y"], ()),
        (["x", "y", "router east", "router north"], ("router east", "router north")),
    ],
)
def test_names_of_both_ends(names, transmitter):
    table = links(n_places=12)
    renamed = table.set_axis([*names, "rssi"], axis=1)
    found = Rssi.from_frame(renamed, transmitter=transmitter)
    expected = Rssi.from_frame(table)
    assert torch.equal(found.rssi_dbm.nan_to_num(0), expected.rssi_dbm.nan_to_num(0))
    assert torch.equal(found.receiver_position, expected.receiver_position)


def test_the_end_with_fewer_positions_is_the_receivers():
    table = links(n_places=12)
    exchanged = table.rename(
        columns=lambda name: {"rx": "tx", "tx": "rx"}.get(name[:2], "") + name[2:] if "_" in name else name
    )
    assert torch.equal(Rssi.from_frame(exchanged).receiver_position, Rssi.from_frame(table).receiver_position)


def test_columns_given_by_role_leave_the_second_end_out():
    data = Rssi.from_frame(links(), columns={"x": "rx_x", "y": "rx_y"})
    assert not data.receiver_moves
    assert data.receiver_names == ("rssi",)


def test_names_of_places_with_their_positions_beside(tmp_path):
    table = links(n_places=12, rows=12)
    places = table[["tx_x", "tx_y"]].drop_duplicates().set_axis(["x", "y"], axis=1)
    places.insert(0, "receiver", [f"desk {number}" for number in range(12)])
    places.to_csv(tmp_path / "receivers.csv", index=False)
    walk = pd.DataFrame(
        {"x": table.rx_x, "y": table.rx_y, "router": np.repeat(places.receiver, 12).to_numpy(), "rssi": table.rssi}
    )
    walk.to_csv(tmp_path / "walk.csv", index=False)
    data = load_rssi(tmp_path, transmitter=["router"])
    assert data.receiver_moves
    assert data.receiver_names == tuple(places.receiver)
    assert "both ends move; 12 positions of column router count as receivers" in data.notes
    np.testing.assert_allclose(data.receiver_position[:, :2], places[["x", "y"]])
    places[1:].to_csv(tmp_path / "receivers.csv", index=False)
    with pytest.raises(InputError, match="must contain each of them"):
        load_rssi(tmp_path, transmitter=["router"])


def test_both_ends_in_degrees():
    table = links(n_places=12)
    degrees = table[["rx_x", "rx_y", "tx_x", "tx_y"]] / [74000, 111200, 74000, 111200] + [11, 48, 11, 48]
    degrees = degrees.set_axis(["longitude", "latitude", "lon of tag", "lat of tag"], axis=1).assign(rssi=table.rssi)
    data = Rssi.from_frame(degrees, transmitter=["lon of tag", "lat of tag"])
    expected = Rssi.from_frame(table)
    between = [torch.cdist(d.transmitter_position[:5], d.receiver_position) for d in (data, expected)]
    row, column = data.detected[:5].nonzero(as_tuple=True)
    own = expected.detected[:5].nonzero(as_tuple=True)[1]
    torch.testing.assert_close(between[0][row, column], between[1][row, own], rtol=0.02, atol=0.02)


def test_many_positions_of_both_ends_are_averaged():
    table = links(n_places=700, rows=1)
    data = Rssi.from_frame(table)
    assert 100 < len(data.receiver_names) <= 500
    column = data.detected.nonzero(as_tuple=True)[1]
    edge = cells(torch.tensor(table[["tx_x", "tx_y"]].to_numpy()), 500)[1]
    assert 0 < edge < 1
    assert any("averaged in cubes of" in note for note in data.notes)
    moved = (data.receiver_position[column, :2] - torch.tensor(table[["rx_x", "rx_y"]].to_numpy())).abs().amax()
    own = (data.receiver_position[column, :2] - torch.tensor(table[["tx_x", "tx_y"]].to_numpy())).abs().amax()
    assert min(float(moved), float(own)) <= edge


def test_split_by_place_holds_out_receivers():
    data = Rssi.from_frame(links())
    train, test = data.split("place", seed=1)
    assert train.receiver_names == test.receiver_names == data.receiver_names
    trained, tested = (part.detected.any(dim=0) for part in (train, test))
    assert not bool((trained & tested).any())
    assert int(tested.sum()) == 6
    assert len(train) + len(test) == len(data)
    with pytest.raises(InputError, match="at least 5 receivers of known position"):
        data.columns([0, 1, 2]).split("place")


def test_all_places_are_kept_though_few_rows_detect_them():
    assert len(Rssi.from_frame(links(rows=3)).receivers(["all"]).receiver_names) == 30


def test_pairs_predict_new_places_better_than_models_that_ignore_the_second_end():
    train, test = Rssi.from_frame(links()).split("place")
    error = {
        name: error_db(RSSI_PREDICTORS[name](), train, test)
        for name in ("pairs", "knn_pairs", "mri_pooled", "mean", "knn")
    }
    assert error["pairs"] < 0.7 * min(error[name] for name in ("mri_pooled", "mean", "knn"))
    assert error["pairs"] < error["knn_pairs"] < error["mean"]


def test_intervals_contain_the_nominal_fraction_at_new_places():
    train, test = Rssi.from_frame(links(n_places=60)).split("place")
    low, high = PairModel().fit(train).predict_detected(test).interval(0.8)
    inside = ((test.rssi_dbm >= low) & (test.rssi_dbm <= high))[test.detected]
    assert 0.7 < float(inside.double().mean()) < 0.92


@pytest.mark.parametrize("new_places", [True, False])
def test_predictions_of_pairs_rows_and_measured_cells_agree(tmp_path, new_places):
    data = Rssi.from_frame(links(n_places=8, rows=12))
    model = PairModel(seed=1, new_places=new_places).fit(data)
    model.save(tmp_path / "pairs.safetensors")
    loaded = swiftwrf.load(tmp_path / "pairs.safetensors")
    assert isinstance(loaded, PairModel)
    every, measured = model.predict(data.transmitter_position), loaded.predict_detected(data)
    torch.testing.assert_close(every.mean[data.detected], measured.mean[data.detected])
    torch.testing.assert_close(every.std[data.detected], measured.std[data.detected])
    assert bool(measured.mean[~data.detected].isnan().all())
    far = data.transmitter_position + torch.tensor([1000.0, 0.0, 0.0])  # out of reach
    assert not model.predict_detection(far).any()
    assert not loaded.predict_detection(far).any()
    with pytest.raises(InputError, match="each pair needs two positions"):
        model.predict_pairs(torch.zeros(2, 3), torch.zeros(1, 3))


def test_known_places_have_their_own_path_loss():
    """Transmitters of different power: a place that is known has its level, a new place has that of all."""
    table = links(n_places=12, rows=40)
    place = table.groupby(["tx_x", "tx_y"], sort=False).ngroup()
    strong = place % 2 == 0
    data = Rssi.from_frame(table.assign(rssi=table.rssi + np.where(strong, 10.0, -10.0)))
    train, test = data.split("random")
    model = PairModel(new_places=False)
    known, new = (error_db(one, train, test) for one in (model, PairModel()))
    assert known < 0.9 * new
    assert model.path_loss.correction.shape == (12, 2)
    away = model.path_loss(torch.tensor([[0.0, 0, 0, 0, 0, 1]]))
    torch.testing.assert_close(away, model.path_loss.shared[:1])


@small("maps")
@only(RSSI_PREDICTORS, "mri_pooled", "pairs", "knn_pairs")
def test_whole_run_at_new_places(tmp_path):
    links(n_places=10, rows=15).to_csv(tmp_path / "links.csv", index=False)
    where = ("--data", tmp_path / "links.csv", "--rx", "all", "--split", "place", "--out", tmp_path / "run")
    with sketched():
        assert command("rssi", *where) == 0
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert metrics["model"] == "pairs"
    assert set(metrics["overall"]) == {"mri_pooled", "pairs", "knn_pairs"}
    errors = pd.read_csv(tmp_path / "run" / "errors.csv")
    assert set(errors.receiver) == {name for name, e in metrics["receivers"].items() if e["pairs"]["abs_error_db"]["n"]}
    assert errors.receiver.nunique() == 2
    assert isinstance(swiftwrf.load(tmp_path / "run" / "model.safetensors"), PairModel)
    assert "the errors of pairs" in (tmp_path / "run" / "report.html").read_text()


@pytest.mark.data
def test_new_places_of_a_measured_router(measured_data):
    data = load_rssi(measured_data / "dcm-rssi", transmitter=["receiver"])
    train, test = data.subset(torch.arange(0, len(data), 6)).split("place")
    error = {name: error_db(RSSI_PREDICTORS[name](), train, test) for name in ("pairs", "mri_pooled", "mean")}
    assert error["pairs"] < 0.9 * error["mri_pooled"] < error["mean"]
