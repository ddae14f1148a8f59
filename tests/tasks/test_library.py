"""Results of the library, which need no directory, process or terminal."""

import json
import re
from contextlib import nullcontext
from html import unescape
from unittest import mock

import pandas as pd
import pytest
from quick import cheap, sketched

import augment
import swiftwrf
from swiftwrf import AngularGrid, InputError
from swiftwrf.choices import RSSI_PREDICTORS
from swiftwrf.contrib.comparison.steps import Memo
from swiftwrf.models.neighbours import IDWModel


@pytest.fixture(autouse=True)
def small_parts():
    """Fits and figures that take a second; they have their own tests."""
    with cheap(), sketched():
        yield


def turbo(*estimators):
    data = swiftwrf.simulated_room(n=40, grid=AngularGrid.hemisphere(10, 40))
    return augment.turbo_learning(data, measured=0.5, models=["nearest"], estimators=estimators, extra=0)


RESULTS = {
    "angles": lambda: turbo("peak"),
    "RSSI": lambda: swiftwrf.rssi.compare(swiftwrf.rssi_room(n=60), receivers=["6"]),
    "positions": lambda: swiftwrf.locate.compare(swiftwrf.rssi_room(n=80), n_cells=300),
}


@pytest.mark.parametrize("name", RESULTS)
def test_a_result_writes_the_report_of_its_command_into_one_file(name, tmp_path):
    result, file = RESULTS[name](), tmp_path / "report.html"
    result.report(file)
    html = file.read_text(encoding="utf-8")
    best = result.summary().index[0]
    assert html.count("<svg") > 3
    assert best in html
    assert f"{result.summary()['median'].iloc[0]:.2f}" in html
    assert "swiftwrf view" not in html, "commands on a directory of a run that does not exist"
    assert 'href="figures' not in html
    assert [entry.name for entry in tmp_path.iterdir()] == ["report.html"]
    with pytest.raises(InputError, match="exists already"):
        result.report(file)
    answer, text = result.answer(), unescape(re.sub("<[^>]+>", "", html))
    assert all(sentence.replace("`", "") in text for sentence in answer.conclusion)
    assert str(answer).splitlines() == answer.conclusion
    assert answer.chosen in result.summary().index


def test_the_best_estimator_of_a_result_predicts_and_is_saved(tmp_path):
    result = turbo()
    result.best.save(tmp_path / "best.safetensors")
    spectra = result.experiment.test.spectrum
    assert swiftwrf.load(tmp_path / "best.safetensors").predict(spectra).equal(result.best.predict(spectra))


def test_predictions_are_those_of_the_models():
    train, test = swiftwrf.rssi_room(n=60).split()
    locator = swiftwrf.RssiLocator(n_cells=300).fit(train)
    found, posterior = swiftwrf.predict(locator, test), locator.locate(test.rssi_dbm[test.detected.any(dim=1)])
    assert found[["x_m", "y_m", "z_m"]].to_numpy() == pytest.approx(posterior.median.numpy())
    assert "position_error_m" in found
    assert "position_error_m" not in swiftwrf.predict(locator, test, truth=False)
    at = test.transmitter_position
    assert swiftwrf.predict(locator.model, at).mean.equal(locator.model.predict(at).mean)
    spectra = swiftwrf.simulated_room(n=12, grid=AngularGrid.hemisphere(10, 40))
    estimator = augment.estimators.make_estimator("peak").fit(augment.Mixed.measured(spectra))
    assert len(swiftwrf.predict(estimator, spectra.store)) == 12
    assert swiftwrf.predict(estimator, spectra)["great_circle_deg"].between(0, 180).all()


def weaker(data):
    return data.derived(rssi_dbm=data.rssi_dbm - 20)


def of_own_model(synthesize):
    """Return a class as a notebook defines it again after a change."""
    return type("Mine", (IDWModel,), {"synthesize": synthesize, "__module__": "__main__"})


FLOOR, SPECTRA = swiftwrf.rssi_room(n=60), swiftwrf.simulated_room(n=40, grid=AngularGrid.hemisphere(10, 40))
MINE = {"models": [of_own_model(lambda model, position: IDWModel.synthesize(model, position) * 0 + 0.5)()]}
MENDED = {"models": [of_own_model(lambda model, position: IDWModel.synthesize(model, position))()]}
KEPT = {
    "rssi": (swiftwrf.rssi.compare, {"data": FLOOR, "receivers": ["6"]}),
    "locate": (swiftwrf.locate.compare, {"data": FLOOR, "n_cells": 200}),
    "aoa": (
        augment.turbo_learning,
        {"data": SPECTRA, "measured": 0.5, "models": ["idw"], "estimators": ["peak"], "extra": 0} | MINE,
    ),
}
OTHER_CALLS = [
    ("rssi", {"data": weaker(FLOOR)}, "data"),
    ("rssi", {"receivers": ["5"]}, "receivers"),
    ("rssi", {"seed": 3}, "seed"),
    ("rssi", {"not_detected": "unknown"}, "not_detected"),
    ("locate", {"data": weaker(FLOOR)}, "data"),
    ("locate", {"seed": 5}, "seed"),
    ("aoa", {"data": swiftwrf.simulated_room(n=40, seed=7, grid=SPECTRA.grid)}, "data"),
    ("aoa", {"seed": 4}, "seed"),
    ("aoa", {"measured": 0.6}, "measured"),
    ("aoa", MENDED, "field models, models"),
]


@pytest.mark.parametrize("task", KEPT)
def test_kept_results_are_those_of_one_call(tmp_path, task):
    compare, options = KEPT[task]
    first = compare(**options, keep=Memo(tmp_path)).summary()
    with mock.patch.object(Memo, "begin", side_effect=AssertionError("nothing is computed again")):
        again = compare(**options, keep=Memo(tmp_path), executor=None, **({"parallel": map} if task == "rssi" else {}))
    pd.testing.assert_frame_equal(again.summary(), first)
    again.report(tmp_path / "report.html")
    for other, change, named in OTHER_CALLS:
        if other == task:
            with pytest.raises(
                InputError, match=rf"the input or a version has changed since .* began \({named}\); restore it or"
            ):
                compare(**options | change, keep=Memo(tmp_path))
    pd.testing.assert_frame_equal(compare(**options, keep=Memo(tmp_path)).summary(), first)


def test_a_predictor_of_ones_own_is_continued_as_it_was(tmp_path, monkeypatch):
    mean = RSSI_PREDICTORS["mean"]
    monkeypatch.setattr(RSSI_PREDICTORS, "_registered", {"swiftwrf": RSSI_PREDICTORS["swiftwrf"], "mean": mean})
    options = {"receivers": ["6"], "also": ["mine"], "keep": Memo(tmp_path)}
    for factor, says in ((1.0, None), (2.0, r"\(predictors\)")):

        class Mine(mean):
            name = "mine"

            def _predict(self, position, factor=factor):
                found, std = super()._predict(position)
                return factor * found, std

        RSSI_PREDICTORS._registered["mine"] = Mine
        with nullcontext() if says is None else pytest.raises(InputError, match=says):
            assert "mine" in swiftwrf.rssi.compare(FLOOR, **options).summary().index


COMPARISONS = {
    "rssi": (lambda: swiftwrf.rssi.compare(swiftwrf.rssi_room(n=40), receivers=["1", "6", "12"]), "abs_error_db"),
    "locate": (lambda: swiftwrf.locate.compare(swiftwrf.rssi_room(n=80), n_cells=300), "position_error_m"),
}


@pytest.mark.parametrize("task", COMPARISONS)
def test_a_comparison_without_a_folder_has_the_errors_of_the_command(task, rssi_run, locate_run):
    (compare, error), run = COMPARISONS[task], {"rssi": rssi_run, "locate": locate_run}[task]
    result, metrics = compare(), json.loads((run / "metrics.json").read_text())
    pd.testing.assert_frame_equal(result.errors, pd.read_csv(run / "errors.csv"), check_dtype=False)
    medians = {name: entry[error]["median"] for name, entry in metrics["overall"].items()}
    assert result.summary()["median"].to_dict() == pytest.approx(medians)
    inside = {float(level): inside for level, inside in metrics.get("calibration", {}).items()}
    assert result.coverage == pytest.approx(inside or metrics["interval"]["coverage"])
    assert task == "locate" or {*result.predictors} == {*medians}
