"""Gains by synthetic spectra: their reference, their interval, in reports, and over repeats that chose differently."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from pandas import DataFrame

from augment.cross_validation import LOCATOR
from augment.turbo.condition import Condition, MeasuredSubset, pooled
from augment.turbo.experiment import Experiment
from augment.turbo.results import TurboResult
from swiftwrf import simulated_room
from swiftwrf.contrib.comparison.errors import median_interval, paired_change, summaries
from swiftwrf.contrib.comparison.errors import summary as error_summary
from swiftwrf.contrib.comparison.steps import Memo
from tasks.aoa.page import answer, conclusion, first_screen
from tasks.aoa.records import FractionRecords
from tasks.configs import AoaConfig
from tasks.records import Records

MEASURED = Condition("aann_kernel", "measured", measured_fraction=0.3)
TURBO = replace(MEASURED, training="measured + synthetic", synthesizer="gp")


def test_what_positions_differ_in_does_not_widen_the_interval_of_a_change():
    """Errors over four decades, all of them halved but for a little noise."""
    generator = np.random.default_rng(0)
    before = 10 ** generator.uniform(-2, 2, 60)
    after = 0.5 * before * generator.uniform(0.95, 1.05, 60)
    change = paired_change(before, after)
    assert -0.6 < change["low"] < -0.5 < change["high"] < -0.4
    shuffled = paired_change(before, generator.permutation(after))
    assert shuffled["high"] - shuffled["low"] > 5 * (change["high"] - change["low"])


def summary_of(values):
    """Return the summary of errors (rows, repeats), each row at a place of its own."""
    index, repeat = (number.ravel() for number in np.indices(values.shape))
    table = DataFrame({"index": index, "place": index, "repeat": repeat, "error": values.ravel()})
    return summaries(table.assign(method="a"), "method", ["error"])["a"]["error"]


def test_a_median_over_repeats_is_that_of_all_errors():
    """One error of three is large, of another repeat in each row."""
    rows = np.arange(60)
    found = summary_of(np.where(rows[:, None] % 3 == np.arange(3), 30.0, 0.1))
    assert found["median"] == 0.1
    assert found["n"] == 60


def test_intervals_over_repeats_contain_the_true_median_at_the_stated_rate():
    """Errors of repeats that differ less from each other than rows do."""
    generator = np.random.default_rng(2)
    covered = alike = 0
    for _ in range(200):
        values = generator.normal(size=(80, 1)) + generator.normal(size=(80, 3)) / 2
        found = summary_of(values)
        covered += found["low"] <= 0 <= found["high"]
        alike += median_interval(values.ravel())[0] <= 0 <= median_interval(values.ravel())[1]
    assert covered >= 182  # 95 % of 200 are 190
    assert alike < 182


def test_one_repeat_has_the_interval_of_independent_values():
    values = np.random.default_rng(3).gamma(2, size=(50, 1))
    assert summary_of(values) == error_summary(values.ravel())


def results_of(errors):
    """Return the results of conditions with these elevation errors [deg] at the test positions."""
    room = simulated_room(n=20)
    found = TurboResult(Experiment(simulated_room(n=40), room, estimators=()), 0.3, Memo())
    for condition, error in errors.items():
        off = torch.stack([torch.zeros(20), torch.as_tensor(error)], dim=1).double().deg2rad()
        seconds = {"train": 1.0, "estimate": 1.0}
        found.add(condition, {"estimate": (room.label - off).tolist(), "seconds": seconds, "history": []})
    return found


def hold_out(result, errors):
    """Give a result these angular errors [deg], each at all held-out spectra of its measured subset."""
    parts = result.experiment.parts(MeasuredSubset(result.fraction))
    n = sum(len(result.experiment.held_out(part)[1]) for part in parts)
    result.held_out = {method: [error] * n for method, error in errors.items()}


def metrics_of(errors, repeats=1):
    """Return the metrics of conditions with these elevation errors [deg] at the test positions."""
    repeated = {replace(c, repeat=repeat): error for repeat in range(repeats) for c, error in errors.items()}
    return results_of(repeated)._method_metrics()


def test_the_chosen_estimator_is_named_as_in_the_results_where_repeats_choose_other_field_models():
    alone = Condition("kernel_regression", "measured", measured_fraction=0.3)
    first, *others = (
        replace(alone, training="measured + synthetic", synthesizer=name, repeat=k)
        for k, name in enumerate(("gp", "idw", "gp"))
    )
    measured = [replace(alone, repeat=k) for k in range(3)]
    found = results_of(dict.fromkeys((*measured, first, *others), np.ones(20)))
    # the locator itself was refused
    hold_out(found, {alone.method: 2.5, first.method: 1.0, "matched_field, measured": 0.1})
    choice = found._estimator_choice()
    assert choice["name"] == "kernel_regression, measured + synthetic (auto)"
    assert choice["name"] in found._method_metrics()[0]


def test_a_better_method_that_is_not_recommended_has_a_reason():
    """Here the search finds no planes without the spectra of a fold."""
    regression, locator = (replace(MEASURED, estimator=name) for name in ("kernel_regression", LOCATOR))
    spread = np.linspace(0.9, 1.1, 20)
    found = results_of({MEASURED: 4 * spread, regression: 2 * spread, locator: spread})
    hold_out(found, {MEASURED.method: 4.0, regression.method: 2.0})
    choice = found._estimator_choice()
    assert choice["name"] == regression.method
    assert choice["better"] == {locator.method: "it cannot be fitted without the held-out spectra"}


@pytest.mark.parametrize("preset", ["quick", "paper"])
def test_a_method_without_held_out_errors_that_stands_above_the_recommended_one_has_a_reason(preset):
    """Though its error on the test spectra is not significantly smaller."""
    regression = replace(MEASURED, estimator="kernel_regression")
    network = replace(MEASURED, estimator={"quick": "aann_kernel", "paper": "aann"}[preset])
    error = np.linspace(1, 9, 20)
    found = results_of({regression: error, network: np.roll(error, 7) * 0.95})
    found.experiment = replace(found.experiment, preset=preset)
    hold_out(found, {regression.method: 4.0})
    (reason,) = found._estimator_choice()["better"].values()
    assert ("takes too long" in reason) == (preset == "paper")
    hold_out(found, {regression.method: 4.0, network.method: 5.0})
    del found.chosen
    assert found._estimator_choice()["better"] == {}


def test_the_report_gives_each_reason_once_with_the_best_of_its_methods(aoa_run):
    fraction = FractionRecords.of(Records(aoa_run))[0]
    names = sorted(set(fraction.medians) - {fraction.chosen}, key=fraction.medians.get)[:3]
    choice = fraction.mix["estimator_choice"]
    choice["better"] = dict(zip(names, ("it is slow", "its error is larger", "it is slow"), strict=True))
    text = " ".join(conclusion(fraction))
    assert f"`{names[0]}` has {fraction.medians[names[0]]:.2f} degrees, but is not recommended: it is slow." in text
    assert f"`{names[1]}` has {fraction.medians[names[1]]:.2f} degrees, but is not recommended: its error" in text
    assert text.count("is not recommended") == 2
    other = next(name for name in choice["held_out_deg"] if name != fraction.chosen)
    choice["held_out_deg"][other] = 0.0
    assert f"The median of `{other}` is smaller there by chance only" in conclusion(fraction)[1]


def test_the_reference_of_a_gain_is_the_best_estimator_without_synthetic_spectra():
    peak, locator = (replace(MEASURED, estimator=name) for name in ("peak", LOCATOR))
    spread = np.linspace(0.9, 1.1, 20)
    methods, reference = metrics_of({MEASURED: 4 * spread, TURBO: 2 * spread, peak: 3 * spread, locator: spread})
    assert reference == "peak"
    assert set(methods["network, measured + synthetic (gp)"]["changes"]) == {"network, measured", "peak"}
    assert methods["network, measured + synthetic (gp)"]["changes"]["peak"]["change"] == pytest.approx(-1 / 3, abs=1e-3)
    assert methods["network, measured + synthetic (gp)"]["changes"]["network, measured"]["high"] < 0
    assert methods["peak"]["changes"] == {}


def test_repeats_do_not_narrow_the_interval_of_a_gain():
    generator = np.random.default_rng(0)
    errors = {MEASURED: generator.uniform(1, 3, 20), TURBO: generator.uniform(1, 3, 20)}
    once, often = (
        metrics_of(errors, repeats)[0]["network, measured + synthetic (gp)"]["changes"]["network, measured"]
        for repeats in (1, 4)
    )
    assert often["low"] == pytest.approx(once["low"], abs=1e-6)
    assert often["high"] == pytest.approx(once["high"], abs=1e-6)


def test_the_summary_begins_with_the_estimator_that_cross_validation_chose(aoa_run):
    fraction = FractionRecords.of(Records(aoa_run))[0]
    fraction.mix["estimator_choice"] = {
        "name": "peak",
        "held_out_deg": {"peak": 1.0},
        "held_out_mean_deg": {"peak": 4.0},
        "n_held_out": 9,
        "better": {},
    }
    first = first_screen(fraction, answer(fraction))
    assert first.conclusion[0].startswith(f"Directions are found within {fraction.medians['peak']:.2f} degrees")
    assert first.numbers[0].value == f"{fraction.medians['peak']:.2f}\N{DEGREE SIGN}"
    assert "peak" in first.numbers[0].meaning
    assert "network, measured + synthetic (swiftwrf)" in first.numbers[1].meaning
    usable, references = answer(fraction).short()
    assert "peak" in {one.name for one in usable}
    assert all(one.name not in ("peak", "network, measured") for one in references)


def test_the_preset_of_the_paper_has_its_fractions_and_no_further_positions():
    paper = AoaConfig(preset="paper")
    assert (paper.measured, paper.extra) == ((0.1, 0.3, 0.5, 0.7), 0)
    given = AoaConfig(measured=(0.2,), preset="paper", extra=9)
    assert (given.measured, given.extra) == ((0.2,), 9)
    assert AoaConfig(measured=(0.3,)).extra is None


GP, IDW = (Condition("aann_kernel", "measured + synthetic", name, measured_fraction=0.3) for name in ("gp", "idw"))
GP_EXTRA, IDW_EXTRA = (
    replace(condition, training="measured + synthetic + extra", n_synthetic=9) for condition in (GP, IDW)
)


def regression(condition):
    """Return the condition with another estimator."""
    return replace(condition, estimator="kernel_regression")


def of_repeats(*repeats):
    """Return a value for each of these conditions, and for the reference, in each repeat."""
    return [
        (replace(condition, repeat=repeat), 10 * repeat + number)
        for repeat, conditions in enumerate(repeats)
        for number, condition in enumerate((MEASURED, *conditions))
    ]


@pytest.mark.parametrize(
    ("auto", "repeats", "expected"),
    [
        # repeats that agree
        (True, [(GP, regression(GP))] * 2, {"network, {} (gp)": [1, 11], "kernel_regression, {} (gp)": [2, 12]}),
        # the choices of all repeats are one condition, with extra positions if there are some
        (
            True,
            [(GP, regression(GP)), (IDW, IDW_EXTRA, regression(IDW_EXTRA))],
            {"network, {} (auto)": [1, 12], "kernel_regression, {} (auto)": [2, 13]},
        ),
        # field models asked for by name add no positions against cross-validation
        (False, [(GP,), (GP, GP_EXTRA)], {"network, {} (gp)": [1, 11], "network, {} + extra (gp)": [1, 12]}),
        # the network is trained one way in each repeat, other estimators both ways
        (
            False,
            [(GP, regression(GP)), (GP_EXTRA, regression(GP), regression(GP_EXTRA))],
            {
                "network, {} + extra (gp)": [1, 11],
                "kernel_regression, {} (gp)": [2, 12],
                "kernel_regression, {} + extra (gp)": [2, 13],
            },
        ),
    ],
)
def test_choices_of_repeats_are_pooled(auto, repeats, expected):
    found = {}
    for condition, value in pooled(of_repeats(*repeats), auto=auto):
        found.setdefault(condition.method, []).append(value)
    named = {name.format("measured + synthetic"): values for name, values in expected.items()}
    assert found == {"network, measured": [0, 10]} | named


def test_the_time_of_all_networks_counts():
    """Also of conditions that are not pooled, and once if a training stands for two conditions."""
    room = simulated_room(n=20)
    trained = of_repeats((GP,), (IDW, IDW_EXTRA))
    for synthesizer in (("auto",), ("gp", "idw")):
        found = TurboResult(Experiment(simulated_room(n=40), room, (0.3,), synthesizer, estimators=()), 0.3, Memo())
        for condition, _ in trained:
            seconds = {"train": 10.0, "estimate": 1.0}
            value = {"estimate": room.label.tolist(), "seconds": seconds, "history": [], "counts": {}}
            found.add(condition, value)
        for repeat in range(2):
            scores = dict.fromkeys(("psnr_db", "ssim", "l1"), [1.0] * 20)
            seconds = {"fit": 2.0, "synthesize": 1.0, "draw": 3.0}
            found.add_synthesis(
                MeasuredSubset(0.3, repeat), "gp", True, {"scores": scores, "seconds": seconds, "history": []}
            )
        assert found.metrics["seconds"] == {"fit": 4.0, "synthesize": 6.0, "train": 50.0}
        assert found.metrics["synthesis"]["gp"]["seconds"] == {"fit": 2.0, "synthesize": 1.0}
