"""Surveys of fewer than 13 rows: every place is predicted by all others."""

import numpy as np
import pytest
import quick
import torch
from small import only

from swiftwrf import InputError, Rssi, RssiModel
from swiftwrf.choices import RSSI_PREDICTORS
from swiftwrf.rssi import compare
from swiftwrf.rssi.path_loss import log_distance


def survey(n=9, receivers=3, repeats=False, seed=0):
    """Path loss and 3 dB of noise in a home of 10 x 8 m; with repeats the last three rows are at the places of the first."""
    generator = torch.Generator().manual_seed(seed)
    at = torch.rand(n, 3, generator=generator).double() * torch.tensor([10.0, 8.0, 0.0])
    if repeats:
        at[-3:] = at[:3]
    receiver = torch.tensor([[0.0, 0.0, 2.0], [10.0, 4.0, 2.0], [5.0, 8.0, 2.0]]).double()[:receivers]
    rssi = -42 - 30 * log_distance(at, receiver) + 3 * torch.randn(n, receivers, generator=generator)
    return Rssi(rssi, at, receiver_position=receiver, receiver_names=list("abc")[:receivers], name="home")


@only(RSSI_PREDICTORS, "swiftwrf", "mean")
@pytest.mark.parametrize("repeats", [False, True])
def test_each_place_is_predicted_by_all_others(repeats):
    data = survey(12, repeats=repeats)
    result, rssi, at = compare(data), data.rssi_dbm.numpy(), data.transmitter_position
    expected = {"mean": np.empty_like(rssi), "swiftwrf": np.empty_like(rssi)}
    for row in range(12):
        others = (torch.cdist(at, at[row : row + 1])[:, 0] > 1e-3).nonzero()[:, 0]
        assert len(others) == (10 if repeats and row % 9 < 3 else 11)
        expected["mean"][row] = np.nanmean(rssi[others], axis=0)
        model = RssiModel(validation="random").fit(data.subset(others))
        expected["swiftwrf"][row] = model.predict_detected(data.subset(torch.tensor([row]))).mean
    row, column = np.nonzero(~np.isnan(rssi))
    for name, values in expected.items():
        error = np.abs(values - rssi)[row, column]
        found = result.errors[result.errors["method"] == name]["abs_error_db"]
        np.testing.assert_allclose(found, error, atol=1e-3)
        assert result.values[name]["mean"] == pytest.approx(error.mean(), abs=1e-3)
    apart = torch.cdist(at, at)
    apart[apart < 1e-3] = torch.inf
    own = result.errors[result.errors["method"] == "mean"]
    np.testing.assert_allclose(own["from_training_m"], apart.amin(dim=1).numpy()[row], rtol=1e-6)
    assert len(result.predictors["swiftwrf"].region()) == 12  # the model that is kept knows all rows
    count = 9 if repeats else 12
    assert f"12 rows are too few for a test part: rows of each of {count} positions" in result.notes[0]


@only(RSSI_PREDICTORS, "swiftwrf", "mean")
def test_five_positions_and_one_receiver_are_enough_and_four_are_not():
    data = survey(5, receivers=1)
    result = compare(data)
    assert result.test.detected.sum() == 5
    # the largest of four held-out errors bounds a fifth one with a probability of 0.8
    assert result.coverage >= 0.6
    with pytest.raises(InputError, match="detected the transmitter in 5 rows"):
        compare(survey(4))
    with pytest.raises(InputError, match="4 different positions; measure at 5 or more"):
        compare(survey(7, repeats=True))


@only(RSSI_PREDICTORS, "swiftwrf", "mean")
def test_intervals_of_eight_positions_hold():
    assert 0.76 < np.mean([compare(survey(8, seed=seed)).coverage for seed in range(8)]) < 0.97


def test_command_answers_from_a_table_of_eight_positions(tmp_path, capsys):
    frame = survey(8).to_frame()
    (tmp_path / "home").mkdir()
    frame.to_csv(tmp_path / "home" / "survey.csv", index=False)
    assert quick.run("rssi", "--data", tmp_path / "home", "--rx", "all", "--out", tmp_path / "run") == 0
    text = " ".join(capsys.readouterr().out.split())
    assert "All others predict each of 8 positions, 24 measurements in all" in text
    assert (tmp_path / "run" / "report.html").is_file()
