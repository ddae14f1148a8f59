"""Sessions of measurements: read, written, split, and held out whole."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from swiftwrf import InputError, Rssi, RssiModel, load_rssi, rssi_room
from swiftwrf.contrib.comparison.base import split_notes
from swiftwrf.data.splits import folds
from swiftwrf.data.writing import write_rssi

SIZES = (50, 30, 40, 20, 10, 10)


def of_sessions(drift_db=6.0, n=300):
    """RSSI of five sessions at the same positions. A smooth map of each session adds to it."""
    data = rssi_room(n=n)
    session = torch.arange(n) % 5
    x, y, _ = data.transmitter_position.T
    wave = torch.stack([torch.sin(0.9 * (x * np.cos(a) + y * np.sin(a)) + a) for a in range(5)])
    drift = drift_db * wave.gather(0, session[None])[0]
    return replace(data, rssi_dbm=data.rssi_dbm + drift[:, None], session=session)


def test_folds_are_whole_sessions_of_nearly_equal_size():
    session = torch.repeat_interleave(torch.arange(len(SIZES)), torch.tensor(SIZES))
    fold = folds(torch.rand(len(session), 3), "session", 0, session=session)
    assert all(len(fold[session == number].unique()) == 1 for number in session.unique())
    assert sorted(fold.bincount().tolist()) == [20, 20, 30, 40, 50]


def test_a_single_session_has_random_folds():
    position = torch.rand(20, 3)
    single = folds(position, "session", 0, session=torch.zeros(20).long())
    assert torch.equal(single, folds(position, "random", 0))


def test_split_of_other_sessions_holds_out_sessions():
    data = of_sessions()
    apart = (data.session != 4).nonzero()[:, 0], (data.session == 4).nonzero()[:, 0]
    data = replace(data, named_splits={"day": apart})
    train, test = data.split("day")
    assert train.validation_for("day", test) == "session"
    assert "cross-validation holds out sessions" in split_notes(train, test, "day")[0]
    assert [data.split(name)[0].validation_for(name, data.split(name)[1]) for name in ("random", "block")] == [
        "random",
        "block",
    ]


def test_intervals_contain_the_difference_between_sessions():
    data = of_sessions(drift_db=10.0).columns(range(0, 12, 2))
    covered = {}
    for validation in ("random", "session"):
        inside = []
        for number in range(5):
            train, test = (data.subset(rows) for rows in (data.session != number, data.session == number))
            low, high = RssiModel(validation=validation).fit(train).predict_detected(test).interval(0.8)
            inside.append(((low <= test.rssi_dbm) & (test.rssi_dbm <= high))[test.detected])
        covered[validation] = float(torch.cat(inside).double().mean())
    assert covered["random"] < 0.76
    assert 0.77 < covered["session"] < 0.83


def test_sessions_in_other_files_of_the_layout(tmp_path):
    data = of_sessions(n=60)
    write_rssi(data, tmp_path)
    (tmp_path / "meta.csv").write_text("run\nmonday\n")
    with pytest.raises(InputError, match="has 1 rows, the RSSI 60"):
        load_rssi(tmp_path)
    (tmp_path / "meta.csv").write_text("heading\n" + "1\n" * 60)
    assert load_rssi(tmp_path).session is None


@pytest.mark.parametrize("long", [False, True])
def test_sessions_of_a_table(long):
    """Packets of two sessions at one position do not share a row."""
    table = rssi_room(n=12).to_frame().rename(columns={"x_m": "x", "y_m": "y", "z_m": "z"}).reset_index(drop=True)
    table["walk"] = ["out", "back"] * 6
    if long:
        table.loc[1, ["x", "y", "z"]] = table.loc[0, ["x", "y", "z"]]
        table = table.melt(["x", "y", "z", "walk"], var_name="receiver", value_name="rssi").dropna()
    data = Rssi.from_frame(table)
    assert len(data) == 12
    assert data.session.bincount().tolist() == [6, 6]
    assert Rssi.from_frame(table.rename(columns={"walk": "hour"}), columns={"session": "hour"}).session is not None


def test_sessions_by_name():
    names = ["monday", "tuesday"] * 10
    data = Rssi([[-60.0]] * 20, torch.rand(20, 3), session=names)
    assert data.session.tolist() == [0, 1] * 10


def test_kernel_is_chosen_again_without_sessions():
    model = RssiModel(validation="session").fit(of_sessions(n=60))
    assert len(model.with_chosen_kernel().region()) == 60


@pytest.mark.data
def test_intervals_of_another_run_of_a_robot(measured_data):
    data = load_rssi(measured_data / "kolak")
    train, test = data.split("spatial")
    validation = train.validation_for("spatial", test)
    low, high = RssiModel(validation=validation).fit(train).predict_detected(test).interval(0.8)
    inside = ((low <= test.rssi_dbm) & (test.rssi_dbm <= high))[test.detected]
    assert validation == "session"
    assert 0.77 < float(inside.double().mean()) < 0.84
