"""Conditions of several repeats that chose differently."""

from dataclasses import replace

from augment.turbo.condition import Condition, MeasuredSubset, pooled
from augment.turbo.experiment import Experiment
from augment.turbo.results import Results
from augment.turbo.synthesis import Evaluation
from swiftwrf import simulated_room

MEASURED = Condition("aann_kernel", "measured", measured_fraction=0.3)
GP, IDW = (Condition("aann_kernel", "measured + synthetic", name, measured_fraction=0.3) for name in ("gp", "idw"))
GP_EXTRA, IDW_EXTRA = (
    replace(condition, training="measured + synthetic + extra", n_synthetic=9) for condition in (GP, IDW)
)


def regression(condition):
    """Return the condition with another estimator."""
    return replace(condition, estimator="kernel_regression")


def results(*repeats):
    """Return a value for each of these conditions, and for the reference, in each repeat."""
    return [
        (replace(condition, repeat=repeat), 10 * repeat + number)
        for repeat, conditions in enumerate(repeats)
        for number, condition in enumerate((MEASURED, *conditions))
    ]


def values(found, method):
    return [value for condition, value in found if condition.method == method]


def test_repeats_that_agree_are_unchanged():
    given = results((GP, regression(GP)), (GP, regression(GP)))
    assert pooled(given, auto=True) == given


def test_the_choices_of_all_repeats_are_one_condition():
    given = results((GP, regression(GP)), (IDW, IDW_EXTRA, regression(IDW_EXTRA)))
    found = pooled(given, auto=True)
    methods = {condition.method for condition, _ in found}
    assert methods == {
        "network, measured",
        "network, measured + synthetic (auto)",
        "kernel_regression, measured + synthetic (auto)",
    }
    assert values(found, "network, measured + synthetic (auto)") == [1, 12]  # with extra positions if there are some
    assert values(found, "kernel_regression, measured + synthetic (auto)") == [2, 13]
    assert values(found, "network, measured") == [0, 10]


def test_field_models_asked_for_by_name_add_no_positions_against_cross_validation():
    found = pooled(results((GP,), (GP, GP_EXTRA)), auto=False)
    assert values(found, "network, measured + synthetic (gp)") == [1, 11]
    assert values(found, "network, measured + synthetic + extra (gp)") == [1, 12]


def test_a_network_with_further_positions_alone_is_pooled_with_those_without_any():
    """The network is trained one way in each repeat, other estimators both ways."""
    given = results((GP, regression(GP)), (GP_EXTRA, regression(GP), regression(GP_EXTRA)))
    found = pooled(given, auto=False)
    assert values(found, "network, measured + synthetic (gp)") == []
    assert values(found, "network, measured + synthetic + extra (gp)") == [1, 11]
    assert values(found, "kernel_regression, measured + synthetic (gp)") == [2, 12]
    assert values(found, "kernel_regression, measured + synthetic + extra (gp)") == [2, 13]


def test_fractions_are_pooled_apart():
    other = [(replace(condition, measured_fraction=0.5), value) for condition, value in results((GP,), (GP,))]
    given = results((GP,), (IDW,)) + other
    assert [result for result in pooled(given, auto=True) if result[0].measured_fraction == 0.5] == other


def test_the_time_of_all_networks_counts():
    """Also of conditions that are not pooled, and once if a training stands for two conditions."""
    room = simulated_room(n=20)
    trained = results((GP,), (IDW, IDW_EXTRA))
    for synthesizer in (("auto",), ("gp", "idw")):
        found = Results(Experiment(simulated_room(n=40), room, (0.3,), synthesizer, estimators=()))
        for condition, _ in trained:
            value = {
                "estimate": room.label.tolist(),
                "seconds": {"train": 10.0, "estimate": 1.0},
                "history": [],
                "counts": {},
            }
            found.add(Evaluation(condition), value)
        for repeat in range(2):
            subset = MeasuredSubset(0.3, repeat)
            found.synthesis.append(
                subset.columns | {"synthesizer": "gp", "index": 0, "psnr_db": 1.0, "ssim": 1.0, "l1": 1.0}
            )
            seconds = {"fit": 2.0, "synthesize": 1.0, "draw": 3.0, "trains": True}
            found.synthesis_seconds.append(subset.columns | {"synthesizer": "gp"} | seconds)
        metrics = found.summary(0.3)
        assert metrics["seconds"] == {"fit": 4.0, "synthesize": 6.0, "train": 50.0}
        assert metrics["synthesis"]["gp"]["seconds"] == {"fit": 2.0, "synthesize": 1.0}
