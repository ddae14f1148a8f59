"""Arms of several repeats that chose differently."""

import json
from dataclasses import replace
from itertools import cycle
from unittest import mock

import pandas as pd
from quick import run

from tasks.aoa.pooled import pooled
from tasks.aoa.results import mix_metrics
from tasks.aoa.steps import choose_synthesizer
from tasks.metrics import ANGLES, SCORES


def rows(*repeats):
    """Rows of one share: in each repeat the arms of these trainings, and what is not synthetic."""
    return [
        {"mix": 0.3, "repeat": repeat, "method": method, "value": 10 * repeat + number}
        for repeat, methods in enumerate(repeats)
        for number, method in enumerate(("measured_only", *methods))
    ]


def values(found, method):
    return [row["value"] for row in found if row["method"] == method]


def test_repeats_that_agree_stay_as_they_are():
    given = rows(("turbo_gp", "kernel_ridge_turbo_gp"), ("turbo_gp", "kernel_ridge_turbo_gp"))
    assert pooled(given, auto=True) == given


def test_what_each_repeat_chose_is_one_arm():
    given = rows(
        ("turbo_gp", "kernel_ridge_turbo_gp"), ("turbo_idw", "turbo_idw_extra", "kernel_ridge_turbo_idw_extra")
    )
    found = pooled(given, auto=True)
    assert {row["method"] for row in found} == {"measured_only", "turbo_auto", "kernel_ridge_turbo_auto"}
    assert values(found, "turbo_auto") == [1, 12]  # with further positions where there are some
    assert values(found, "kernel_ridge_turbo_auto") == [2, 13]
    assert values(found, "measured_only") == [0, 10]


def test_named_synthesizers_add_nothing_where_nothing_is_advised():
    found = pooled(rows(("turbo_gp",), ("turbo_gp", "turbo_gp_extra")), auto=False)
    assert values(found, "turbo_gp") == [1, 11]
    assert values(found, "turbo_gp_extra") == [1, 12]


def test_all_networks_count_where_the_time_went():
    """Those of arms that are not taken and the one that stands for two, too."""
    trained = rows(("turbo_gp",), ("turbo_idw", "turbo_idw_extra"))
    training = [row | {"train": 10.0, "estimate": 1.0} for row in trained]
    drawn = [{"mix": 0.3, "repeat": repeat, "synthesizer": "gp"} for repeat in range(2)]
    for auto in (True, False):
        table = {
            "errors": [row | {"index": 0} | dict.fromkeys(ANGLES, 1.0) for row in pooled(trained, auto)],
            "training_seconds": training,
            "arm_seconds": pooled(training, auto),
            "synthesis": [row | {"index": 0} | dict.fromkeys(SCORES, 1.0) for row in drawn],
            "synthesis_seconds": [row | {"fit": 2.0, "synthesize": 1.0, "draw": 3.0, "trains": True} for row in drawn],
        }
        metrics = mix_metrics(0.3, 10, {}, None, None, table)
        assert metrics["seconds"] == {"fit": 4.0, "synthesize": 6.0, "train": 50.0}
        assert metrics["synthesis"]["gp"]["seconds"] == {"fit": 2.0, "synthesize": 1.0}


def test_a_run_whose_repeats_choose_differently(tmp_path):
    chosen = cycle(("gp", "idw"))

    def choose(measured, settings, names):
        return replace(choose_synthesizer(measured, settings, ("gp", "idw")), name=next(chosen))

    with (
        mock.patch("tasks.aoa.steps.choose_synthesizer", choose),
        mock.patch("tasks.aoa.steps.candidates", return_value=[]),  # a search for rooms would take most of the time
    ):
        assert run("aoa", "--mix", 0.7, "--repeats", 2, "--extra", 0, "--out", tmp_path / "run") == 0
    methods = json.loads((tmp_path / "run" / "metrics.json").read_text())["mixes"]["0.7"]["methods"]
    assert [name for name in methods if name.startswith("turbo_")] == ["turbo_auto"]
    errors = pd.read_csv(tmp_path / "run" / "errors.csv")
    per_arm = errors.groupby("method").size()
    assert per_arm["turbo_auto"] == per_arm["measured_only"]
    assert "turbo_auto" in (tmp_path / "run" / "report.html").read_text()
