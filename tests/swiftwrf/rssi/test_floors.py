"""Floors: read as a dimension of their own, and the attenuation of each floor."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from swiftwrf import InputError, PairModel, Rssi, RssiModel
from swiftwrf.choices import RSSI_PREDICTORS
from swiftwrf.data.coordinates import Floors
from swiftwrf.rssi import estimate_floor_attenuation
from swiftwrf.testing import check_predictor

FLOOR_DB, STOREY_M, SIDE_M = 15.0, 3.5, 30.0
RECEIVERS = {
    f"ap{i}": (x, y, STOREY_M * floor + 2.5) for i, (x, y, floor) in enumerate([(3, 3, 0), (25, 6, 1), (9, 24, 2)])
}


def building(n=240, seed=0, noise_db=2.0, floor_db=FLOOR_DB):
    """A table of three floors, three access points, and 15 dB a floor between them."""
    draw = np.random.default_rng(seed)
    floor = draw.integers(0, 3, n)
    table = pd.DataFrame({"x": draw.uniform(0, SIDE_M, n), "y": draw.uniform(0, SIDE_M, n)})
    table["z"], table["floor"] = STOREY_M * floor + 1.2, floor
    for name, (x, y, z) in RECEIVERS.items():
        distance = np.hypot(table.x - x, table.y - y).clip(1)
        crossed = np.abs(floor - z // STOREY_M)
        table[name] = -35 - 25 * np.log10(distance) - floor_db * crossed + noise_db * draw.normal(size=n)
    return table


def rssi(table, located=True):
    return Rssi.from_frame(table, receiver_position=RECEIVERS if located else None)


@pytest.mark.parametrize("located", [True, False])
@pytest.mark.parametrize("true_db", [5.0, 15.0])
def test_attenuation_of_a_floor_is_recovered(located, true_db):
    found = estimate_floor_attenuation(rssi(building(floor_db=true_db), located))
    assert found.receiver_floor == (0, 1, 2)
    assert found.db == pytest.approx(true_db, abs=1.0 if located else 2.0)  # chance of the rows, without distances


def test_a_receiver_that_was_detected_twice_is_on_the_floor_of_its_rows():
    table = building()
    table["rare"] = np.where(table.index.isin(table.index[table.floor == 2][:2]), -70.0, np.nan)
    assert estimate_floor_attenuation(rssi(table, located=False)).receiver_floor == (0, 1, 2, 2)


def test_floors_by_number_without_heights_and_with_heights_above_the_floor():
    table = building()
    for changed in (table.drop(columns="z"), table.assign(z=1.2)):
        data = Rssi.from_frame(changed)
        assert data.floors.names == ("0", "1", "2")
        assert np.diff(data.floors.height_m) == pytest.approx([4.0, 4.0])
        assert any("each floor of column floor" in note for note in data.notes)
    assert np.diff(rssi(table).floors.height_m) == pytest.approx([STOREY_M, STOREY_M])


def test_floors_by_name_without_heights():
    table = building().drop(columns="z")
    names = np.array(["Ground", "First", "Second"])[table["floor"]]
    assert rssi(table.assign(floor=names)).floors == Floors(("Ground", "First", "Second"), (0.0, 4.0, 8.0))
    with pytest.raises(InputError, match="the order of floor 'Annex' is unknown"):
        rssi(table.assign(floor=np.where(names == "First", "Annex", names)))


def test_floors_without_an_order_are_not_merged():
    """Heights from each floor make one place of all floors, and error of the fit is 4.9 dB for 1.0."""
    table = building()
    names = np.array(["red", "green", "blue"])[table["floor"]]
    with pytest.raises(InputError, match=r"floors 'blue' and 'green' have heights of 1 and 1 m at the same places"):
        rssi(table.assign(z=1.0, floor=names))
    with pytest.raises(InputError, match=r"floors '0' and '1' have heights of 1 and 1.2 m at the same places"):
        rssi(table.assign(z=np.array([1.0, 1.2, 4.5])[table["floor"]]))
    assert rssi(table.assign(floor=names)).floors.names == ("red", "green", "blue")
    assert rssi(table.assign(z=np.array([0.0, 1.0, 4.5])[table["floor"]])).floors.names == (
        "0, 1",
        "2",
    )  # levels of one


def test_heights_that_fall_with_the_number_of_the_floor_stand():
    table = building()
    data = rssi(table.assign(z=-3.0 * table["floor"]))
    assert data.floors == Floors(("2", "1", "0"), (-6.0, -3.0, 0.0))


@pytest.mark.parametrize("with_heights", [True, False])
def test_an_empty_column_of_floors_is_none(with_heights):
    table = building()[["x", "y", *(["z"] if with_heights else []), *RECEIVERS]].assign(floor="")
    data = rssi(table)
    assert data.floors is None
    assert len(data) == len(table)
    assert "column floor is empty, so there are no floors" in data.notes


def test_floors_by_name():
    table = building()
    table["floor"] = np.array(["UG", "EG", "OG"])[table["floor"]]
    assert Rssi.from_frame(table).floors.names == ("UG", "EG", "OG")
    table["level"] = np.where(table.x < 15, "west ", "east ") + table.pop("floor")
    data = Rssi.from_frame(table, columns={"floor": "level"})
    assert data.floors.names == ("east UG, west UG", "east EG, west EG", "east OG, west OG")
    assert Rssi.from_frame(table.assign(floor=1)).floors is None


@pytest.mark.parametrize(
    "name", ["swiftwrf", "gp", "knn", "mri_pooled", "mri_receiver", "mri_residual", "mean", "pairs"]
)
def test_predictors_take_the_floor_into_account(name):
    train, test = rssi(building(120 if name == "pairs" else 240)).split()
    error = []
    for floors in (train.floors, None):
        predictor = RSSI_PREDICTORS[name]().fit(replace(train, floors=floors))
        error.append(float((predictor.predict(test.transmitter_position).mean - test.rssi_dbm).abs().mean()))
    assert error[0] < error[1]
    assert name in ("mean", "knn") or error[0] < 3.0


@pytest.mark.parametrize("kind", [RssiModel, PairModel])
def test_the_attenuation_is_a_part_of_the_model_and_of_its_file(kind):
    data, model = rssi(building(n=90)), kind()
    check_predictor(model, data)
    assert model.attenuation.db == pytest.approx(FLOOR_DB, abs=1.5)
    assert kind().fit(replace(data, floors=None)).attenuation is None


def test_some_rows_determine_the_attenuation():
    data = rssi(building(floor_db=15.0))
    some, every = (estimate_floor_attenuation(data, max_rows=most) for most in (len(data) // 2, len(data)))
    assert some.db != every.db
    assert some.db == pytest.approx(every.db, abs=1.0)
