"""Choice of the estimator: on the same held-out spectra for all methods, by median and, among equals, by the mean."""

from unittest import mock

import numpy as np
import pytest
import torch

from augment import turbo_learning
from augment.cross_validation import choose_estimator
from augment.estimators.kernel_regression import KernelRegression
from augment.mix import withhold
from augment.turbo.condition import MeasuredSubset
from augment.turbo.experiment import Experiment
from swiftwrf import AngularGrid, load, simulated_room
from swiftwrf.contrib.comparison.steps import Memo
from swiftwrf.metrics import angle_errors

CALLS = []  # training sets of `Recorded`, and the spectra that it was applied to


def smallest_difference(first, second):
    """Return the lower end of the median of the first errors less that of the second, 95 % bootstrap over spectra."""
    rows = np.random.default_rng(7).integers(len(first), size=(5000, len(first)))
    return np.quantile(np.median(first[rows], axis=1) - np.median(second[rows], axis=1), 0.025)


def test_the_median_decides_and_not_the_mean():
    """Two of 40 spectra are far off, which doubles the mean and not the error of most directions."""
    skewed = np.where(np.arange(40) < 2, 100.0, 1.0)
    choice = choose_estimator({"even": np.full(40, 3.0), "skewed": skewed})
    assert skewed.mean() > 3
    assert (choice["name"], choice["n_held_out"]) == ("skewed", 40)
    assert choice["held_out_deg"] == {"even": 3.0, "skewed": 1.0}


@pytest.mark.parametrize(("far_off", "chosen"), [(36.0, "network"), (0.0, "peak")])
def test_among_medians_that_are_equal_up_to_chance_large_errors_decide(far_off, chosen):
    """The peak of a circular array is ahead by a hair, and far off for a sixth of the spectra."""
    generator = np.random.default_rng(0)
    network = generator.gamma(4, 3, 40)
    peak = network * generator.uniform(0.6, 1.25, 40)
    peak = np.where(network > np.quantile(network, 0.85), far_off + network, peak)
    errors = {"peak": peak, "network": network, "nearest": network + 9}
    assert np.median(peak) < np.median(network)
    assert (network.mean() < peak.mean()) == (chosen == "network")
    assert smallest_difference(network, peak) < 0
    choice = choose_estimator(errors)
    assert choice["name"] == chosen
    assert choice["held_out_mean_deg"] == pytest.approx({name: x.mean() for name, x in errors.items()})


def test_a_significantly_smaller_median_outweighs_large_errors():
    generator = np.random.default_rng(0)
    better = np.where(np.arange(100) < 15, 50.0, generator.uniform(0.5, 1.5, 100))
    even = generator.uniform(2, 3, 100)
    assert even.mean() < better.mean()
    assert smallest_difference(even, better) > 0
    assert choose_estimator({"even": even, "better": better})["name"] == "better"


def test_spectra_of_one_place_are_no_independent_evidence():
    """18 of 24 spectra favour `first`, which is evidence from 24 places and none from four."""
    first = np.repeat([1.0, 1.0, 1.0, 5.0], 6)
    second = np.repeat([1.5, 1.5, 1.5, 0.1], 6)
    assert second.mean() < first.mean()
    errors = {"first": first, "second": second}
    assert choose_estimator(errors)["name"] == "first"
    assert choose_estimator(errors, np.repeat(np.arange(4), 6))["name"] == "second"


def test_no_method_behind_the_mean_direction_is_chosen():
    """The median of `behind` is equal to the smallest one up to chance, and its mean is the smallest."""
    first = np.random.default_rng(0).gamma(1, 8, 20)
    errors = {"first": first, "constant": first + 0.5, "behind": np.full(20, np.median(first) + 1)}
    assert smallest_difference(errors["behind"], first) < 0
    assert errors["behind"].mean() < first.mean()
    assert choose_estimator(errors)["name"] == "first"
    assert choose_estimator({name: errors[name] for name in ("first", "behind")})["name"] == "behind"


def test_a_spectrum_without_an_estimate_is_a_large_error():
    errors = {"gaps": np.array([1.0] * 4 + [np.nan] * 6), "whole": np.full(10, 5.0)}
    assert choose_estimator(errors)["name"] == "whole"


class Recorded(KernelRegression):
    """Kernel regression that leaves the training sets and the spectra that it was applied to."""

    def _fit(self, train, device):
        CALLS.append(train)
        super()._fit(train, device)

    def predict(self, spectra):
        CALLS.append(spectra)
        return super().predict(spectra)


@pytest.mark.parametrize("measured", [0.25, 0.7])  # two folds, two pairs of folds
def test_all_methods_are_compared_on_the_same_spectra_which_trained_none(tmp_path, measured, monkeypatch):
    monkeypatch.setattr("augment.turbo.stages.MAX_HELD_OUT_EXTRA", 6)
    data = simulated_room(n=60, grid=AngularGrid.hemisphere(8, 32))
    CALLS.clear()
    options = {"models": ["idw", "nearest"], "estimators": ["peak", Recorded()], "extra": 9, "keep": Memo(tmp_path)}
    result = turbo_learning(data, measured=measured, **options)
    methods = {name for name, one in result.metrics["methods"].items() if one["training"] != "all measured"}
    assert set(result.choice["held_out_deg"]) == methods
    train, test = data.split("random", 0)
    known, _ = withhold(train, measured, 0)

    def rows_of(spectra):
        """Return the rows of the data with these spectra."""
        return set((spectra[:, None] == data.spectrum).flatten(2).all(dim=2).nonzero()[:, 1].tolist())

    held_out, errors, n_synthetic = set(), [], []
    for training, asked in zip(CALLS[::2], CALLS[1::2], strict=True):
        own, rows = set(training.index[~training.synthetic].tolist()), rows_of(asked)
        assert rows.isdisjoint(training.index.tolist())
        if rows != set(test.index.tolist()):
            assert own < set(known.index.tolist())
            assert rows <= set(known.index.tolist())
            held_out |= rows
            n_synthetic.append(int(training.synthetic.sum()))
            if not bool(training.synthetic.any()):
                peak = data.grid.peak_direction(asked)
                errors.append(angle_errors(peak, data.subset(torch.tensor(sorted(rows))).label)["great_circle"])
    assert len(held_out) >= (0.7 if len(known) >= 25 else 0.15) * len(known)
    n = len(train) - len(known)
    assert sorted(n_synthetic) == sorted(2 * [0, n, n, n + 6, n + 6])  # in two parts, with spectra of two field models
    assert result.choice["n_held_out"] == len(held_out)
    assert result.choice["held_out_deg"]["peak"] == pytest.approx(float(torch.cat(errors).rad2deg().quantile(0.5)))


@pytest.mark.parametrize(("n", "folds"), [(12, [1, 1]), (20, [1, 1]), (30, [2, 2]), (60, [2])])
def test_each_part_leaves_enough_spectra_to_train_and_few_parts_hold_enough_out(n, folds):
    train, test = simulated_room(n=130, grid=AngularGrid.hemisphere(8, 32)).split("random", 0)
    experiment, whole = Experiment(train, test), MeasuredSubset(n / len(train))
    parts = experiment.parts(whole)
    assert [len(part.without) for part in parts] == folds
    every = experiment.withhold(whole)[0].index.tolist()
    for part in parts:
        rest, held_out = experiment.withhold(part)[0].index.tolist(), experiment.held_out(part)[1].index.tolist()
        assert sorted(rest + held_out) == every


def test_ten_spectra_are_too_few_to_hold_some_out():
    train, test = simulated_room(n=50, grid=AngularGrid.hemisphere(8, 32)).split("random", 0)
    assert Experiment(train, test).parts(MeasuredSubset(0.25)) == []


@pytest.mark.parametrize("training", ["measured", "measured + synthetic (idw)", "measured + synthetic + extra (idw)"])
def test_the_recommended_estimator_is_the_one_in_its_file(tmp_path, training):
    """A run keeps the files of two of these trainings in any case."""
    data, method = simulated_room(n=60, grid=AngularGrid.hemisphere(8, 32)), f"kernel_regression, {training}"

    def chosen(errors, place):
        assert method in errors
        return {"name": method, "held_out_deg": dict.fromkeys(errors, 1.0)}

    with mock.patch("augment.turbo.results.choose_estimator", chosen):
        options = {"models": ["idw"], "estimators": ["peak"], "extra": 30, "keep": Memo(tmp_path)}
        result = turbo_learning(data, measured=0.7, **options)
        found = [load(tmp_path / result.choice["file"]), result.best]
    own = result.errors[result.errors.method == method]
    test = data.subset(torch.tensor(own["index"].tolist()))
    for estimator in found:
        error = angle_errors(estimator.estimate(test), test.label)["great_circle"].rad2deg()
        np.testing.assert_allclose(error, own["great_circle_deg"], atol=1e-3)
