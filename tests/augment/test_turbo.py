"""Turbo learning in one call equals the command, and takes field models and estimators of one's own."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pandas as pd
import pytest
import torch
from quick import cheap
from small import Counted

from augment import turbo_learning
from augment.estimators import Estimator
from swiftwrf import AngularGrid, load_spectra, simulated_room
from swiftwrf.contrib.comparison.steps import Memo
from swiftwrf.metrics import angle_errors
from swiftwrf.models.neighbours import NearestModel


class Zenith(Estimator):
    """Answers the same direction to everything."""

    def _fit(self, train, device):
        self.label = train.label.mean(dim=0)

    def predict(self, spectra):
        return self.label.expand(len(spectra), 2)


class Renamed(NearestModel):
    name = "renamed"


@pytest.fixture(scope="module")
def data():
    return simulated_room(n=30, grid=AngularGrid.hemisphere(8, 32))  # as the quick tasks have it


def test_models_and_estimators_of_ones_own(data):
    result = turbo_learning(data, measured=0.5, models=[Renamed(), "idw"], estimators=["peak", Zenith()], extra=0)
    methods = {
        "peak",
        "Zenith, measured",
        "Zenith, measured + synthetic (renamed)",
        "kernel_regression, measured + synthetic (renamed)",
        "kernel_regression, measured + synthetic (idw)",
    }
    found = set(result.summary().index)
    assert methods <= found
    assert not {"network, measured", "matched_field, measured"} & found  # neither was asked for
    assert result.summary()["median"].is_monotonic_increasing
    assert set(result.metrics["synthesis"]) == {"renamed", "idw"}
    change = result.summary().loc["Zenith, measured + synthetic (renamed)"]
    assert change["change_low"] <= change["change"] <= change["change_high"]
    own = result.errors[result.errors.method == result.choice["name"]]
    test = data.subset(torch.tensor(own["index"].tolist()))
    error = angle_errors(result.best.predict(test.spectrum), test.label)["great_circle"].rad2deg()
    np.testing.assert_allclose(error, own["great_circle_deg"], atol=1e-2, rtol=0)


def test_the_call_gives_the_errors_of_the_command(aoa_run):
    data, estimators = load_spectra(aoa_run.parent / "data"), ["peak", "nearest_spectrum"]
    with cheap():
        result = turbo_learning(data, measured=0.5, models=["swiftwrf"], estimators=estimators, extra=0)
    command = pd.read_csv(aoa_run / "errors.csv").query("measured_fraction == 0.5")
    command = command.set_index(["method", "index"])["great_circle_deg"]
    found = result.errors.set_index(["method", "index"])["great_circle_deg"]
    pd.testing.assert_series_equal(found, command.loc[found.index], atol=1e-3)


def test_a_call_continues_after_the_steps_that_it_kept_and_computes_the_others_in_an_executor(data, tmp_path):
    options = {"measured": 0.5, "models": ["idw"], "estimators": ["peak"], "extra": 0}
    with ThreadPoolExecutor(1) as executor:
        first = turbo_learning(data, **options, keep=Memo(tmp_path), executor=executor)
    steps = {file: file.stat().st_mtime_ns for file in (tmp_path / "steps").glob("*.json")}
    (tmp_path / "steps" / "kernel_regression_measured-mix0.5-r0.json").unlink()
    again = turbo_learning(data, **options, keep=Memo(tmp_path))
    pd.testing.assert_frame_equal(again.errors, first.errors)
    changed = [file.stem for file, time in steps.items() if file.stat().st_mtime_ns != time]
    assert changed == ["kernel_regression_measured-mix0.5-r0"]


@pytest.mark.parametrize(
    "options",
    [
        {"models": ["idw"], "estimators": ["peak"], "extra": 0},
        {"models": ["idw", "gp"], "estimators": ["kernel_regression"], "repeats": 2},
        pytest.param({"estimators": ["matched_field"]}, marks=pytest.mark.long),
    ],
    ids=["one", "two_repeated", "room"],
)
def test_the_number_of_steps_does_not_grow_and_no_two_titles_are_equal(data, tmp_path, options):
    first, again = Counted(tmp_path), Counted(tmp_path)
    with cheap():
        turbo_learning(data, measured=0.5, keep=first, **options)
    assert (np.diff(first.totals) <= 0).all(), first.totals
    assert first.totals[-1] - len(first.begun) in (0, 1), "all are done, but for one that saves what is recommended"
    assert len(set(first.begun)) == len(first.begun)
    with cheap():
        turbo_learning(data, measured=0.5, keep=again, **options)
    assert again.begun == []
