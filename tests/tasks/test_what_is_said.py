"""Numbers that results print, compared with plain NumPy on results of known truth.

Errors are 0 to 99, skewed so that mean and median order methods otherwise, four of similar size at each of 25 places.
"""

import json
import math
import re
from dataclasses import replace
from types import SimpleNamespace
from unittest import mock

import numpy as np
import pandas as pd
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from samples import snapshots
from scipy.spatial.distance import cdist
from scipy.stats import binomtest, norm
from test_calibration import spoilt

from augment.positions import sample_positions
from augment.turbo.artifacts import save_examples, save_located
from augment.turbo.condition import Condition, MeasuredSubset
from augment.turbo.experiment import Experiment
from augment.turbo.results import TurboResult
from swiftwrf import AngularGrid, Rssi, RssiModel, calibrate, make_model, rssi_room, simulated_room
from swiftwrf.contrib.comparison.base import split_notes
from swiftwrf.contrib.comparison.errors import summary
from swiftwrf.contrib.comparison.localizers import PosteriorLocalizer
from swiftwrf.contrib.comparison.locating import LocateComparison
from swiftwrf.contrib.comparison.steps import Memo
from swiftwrf.contrib.online import score
from swiftwrf.data.cells import seconds
from swiftwrf.data.coordinates import Floors, GeodeticOrigin
from swiftwrf.data.rssi import Offsets
from swiftwrf.locate import Posterior
from swiftwrf.models.prediction import Prediction
from swiftwrf.rssi import RssiComparison, RssiPredictor, estimate_offsets, log_distance
from swiftwrf.runtime.durable import write_json
from tasks.aoa import page as aoa_page
from tasks.aoa import room as aoa_room
from tasks.aoa import synthesis
from tasks.aoa.records import FractionRecords
from tasks.locate import page as locate_page
from tasks.page.page import number
from tasks.page.shared import compared, comparison_sentence, coverage_warning
from tasks.records import CONFIG, Records, read_npz, write_result
from tasks.rssi import page as rssi_page
from tasks.terminal import _table
from tasks.view import charts
from tasks.view.locating import Located

N = np.arange(100)
PLACE = N // 4
OWN, THIRD = N**2 / 99, np.full(100, 30.0)
OTHER = 0.5 * OWN + 0.2 * np.random.default_rng(0).permutation(100)
SIGN = np.where(N % 3, 1.0, -1.0)
STD = np.where(N % 2, 10.0, 60.0)  # of the predictions of RSSI
ALONG = torch.tensor([0.6, 0.0, 0.8])  # direction of the errors of positions
TIMES = {"fit": 1.0, "predict": 2.0, "train": 1.0, "estimate": 2.0, "room": 8.0, "locate": 9.0}
TIMES |= {"synthesize": 6.0, "draw": 7.0}
GAIN = {"n_synthetic": 300, "median_deg": 1.5, "change": -0.25, "low": -0.4, "high": -0.1}
GAINS = [GAIN | {"n_synthetic": 1000, "median_deg": 1.7}, GAIN]
RULE = {"median_deg": 1.6, "change": -0.2, "low": -0.35, "high": -0.05}
VALIDATION = {"stand_in": "kernel_regression", "n_held_out": 30, "measured_only_deg": 2.0, "gains": GAINS, "rule": RULE}
ERRORS = {
    "rssi": {"swiftwrf": OWN, "knn": OTHER, "gp": THIRD},
    "locate": {"posterior": OWN / 10, "knn": OTHER / 10, "knn_difference": OTHER / 5, "gp": THIRD / 10},
    "aoa": {
        "network, measured + synthetic (gp)": OWN / 20,
        "network, measured": OTHER / 10,
        "peak": THIRD / 20,
        "matched_field, measured": OTHER / 2,
    },
}
PAGES = {"rssi": rssi_page, "locate": locate_page, "aoa": aoa_page}


def bounds(statistic, rows=slice(None), rounding=0.005):
    """Return the 95 % interval of a statistic of rows (samples, rows) by samples of whole places, not that of 90 %."""
    of_place = PLACE[rows].argsort(kind="stable").reshape(25, -1)
    drawn = np.random.default_rng(7).integers(25, size=(4000, 25))
    low, high = np.percentile(statistic(of_place[drawn].reshape(4000, -1)), (2.5, 97.5))
    return [pytest.approx(end, abs=1.01 * rounding + 0.06 * (high - low)) for end in (low, high)]


def median_of(error, rounding=0.005):
    """Return the median of errors and its interval."""
    ends = bounds(lambda rows: np.median(error[rows], axis=-1), rounding=rounding)
    return [pytest.approx(np.median(error), abs=1.01 * rounding), *ends]


def change_of(after, before):
    """Return the change of a median [%] and its interval."""

    def change(rows):
        return 100 * (np.median(after[rows], axis=-1) / np.median(before[rows], axis=-1) - 1)

    return [pytest.approx(change(N), abs=0.501), *bounds(change, rounding=0.5)]


def difference_of(own, other, rows=slice(None)):
    """Return the mean difference of two errors and its interval."""
    apart = (own - other)[rows]
    return [pytest.approx(apart.mean(), abs=0.00501), *bounds(lambda rows: apart[rows].mean(axis=-1), rows)]


def compared_in(sentence):
    """Return the difference and the ends of its 95 % interval in a sentence."""
    difference, level, low, high = said_of(sentence)
    assert level == 95
    return [difference, low, high]


def said_of(text):
    """Return the numbers in a text."""
    return [float(found) for found in re.findall(r"(?<![\w.])[-+]?\d+(?:\.\d+)?", text)]


@pytest.fixture(scope="module")
def of_rssi():
    """Fifty test rows at two receivers, by two devices whose offset is known."""
    room = rssi_room(n=60).columns([0, 5])
    train, test = room.subset(torch.arange(30)), room.subset(torch.arange(10, 60))
    position = test.transmitter_position[:25].repeat_interleave(2, 0)
    groups = pd.Series(["a", "b"] * 25, name="phone")
    test = test.derived(transmitter_position=position, rssi_dbm=torch.full((50, 2), -60.0), groups=groups)
    train = train.derived(offsets=Offsets("phone", "a", {"a": 0.0, "b": -8.0}, 0.5))

    def value(error):
        without_offset = -60 + SIGN * error + 8 * (N // 2 % 2)
        return {"seconds": TIMES, "predicted": without_offset, "std": None, "detection": None, "n_primitives": 0}

    values = {name: value(error) for name, error in ERRORS["rssi"].items()}
    values["swiftwrf"] |= {"std": STD, "detection": (0.9, 0.6)}
    by_rows = pd.DataFrame({"swiftwrf": [3.0, 2.0], "knn": [4.0, 3.5]}, index=[10, 30])
    options = {"split": "random", "preset": "quick", "seed": 0}
    models = {"swiftwrf": RssiModel(n_primitives=0).fit(train)}
    return RssiComparison(train, test, values, options, {}, models, by_rows)


class Rings:
    """A locator whose posteriors have equal masses on 101 candidates, at 0 to 5 m along x either way."""

    def locate(self, rssi):
        at = torch.nn.functional.pad(torch.arange(-50, 51, dtype=torch.float64)[:, None] / 10, (0, 2))
        return Posterior(at.expand(len(rssi), -1, -1), torch.full((len(rssi), 101), 1 / 101).double().log())


@pytest.fixture(scope="module")
def of_locate():
    """A hundred test rows on two floors, the first of which have the largest errors."""
    room = rssi_room(n=100)
    at = room.transmitter_position[:25].repeat_interleave(4, 0) * torch.tensor([1.0, 1.0, 0.0])
    receiver = room.receiver_position.where(torch.arange(12)[:, None] > 0, torch.nan)
    floors = Floors(("ground", "first"), (0.0, 4.1))
    test = room.derived(transmitter_position=at, receiver_position=receiver, floors=floors)
    values = {}
    for name, error in ERRORS["locate"].items():
        estimate = at + torch.from_numpy(error[::-1, None].copy()) * ALONG
        values[name] = {"seconds": TIMES, "index": test.index, "truth": at, "estimate": estimate}
    radius = torch.tensor([[1.05, 3.05, 9.05]]).expand(100, 3)
    values["posterior"] |= {"radius": radius, "ambiguous": torch.arange(100) < 10, "weights": {"values": 0.5}}
    options = {"split": "random", "n_cells": 300, "seed": 0}
    return LocateComparison(test.subset(torch.arange(40)), test, values, options, locator=Rings(), n_undetected=3)


@pytest.fixture(scope="module")
def of_aoa():
    """A hundred test spectra, in another order than their numbers, and positions with errors of 0 to 99 mm."""
    grid = AngularGrid.hemisphere(8, 32)
    room, train = simulated_room(n=25, grid=grid), simulated_room(n=60, seed=1, grid=grid)
    test = room.subset(torch.arange(25).repeat_interleave(4)).derived(index=torch.arange(100) * 37 % 100)
    found = TurboResult(Experiment(train, test, (0.4,), ["gp"], estimators=[]), 0.4, Memo())
    place = test.position + torch.from_numpy(OWN[:, None] / 1000) * ALONG
    located = {"position": place.tolist(), "radius": N, "level": N / 120, "ambiguous": N < 7, "weights": {}}
    located["seconds"] = TIMES
    for method, error in ERRORS["aoa"].items():
        name, _, training = method.partition(", ")
        synthesizer = "gp" * ("gp" in training)
        known = {"network": "aann_kernel"}.get(name, name), training.partition(" (")[0] or "measured", synthesizer
        off = torch.from_numpy(np.stack([0 * error, error], axis=1)).deg2rad()
        value = {"estimate": (test.label - off).tolist(), "seconds": TIMES, "history": [], "counts": {}}
        more = {"located": located} if "matched" in name else {}
        found.add(Condition(*known, measured_fraction=0.4), value | more)
    for name, trains in (("idw", False), ("gp", True)):
        scores = {"psnr_db": OWN / (4 if trains else 5), "ssim": OWN / 100, "l1": OWN / 100}
        value = {"scores": scores, "seconds": TIMES, "history": []}
        found.add_synthesis(MeasuredSubset(0.4), name, trains, value)
    validation = VALIDATION | {"helps": True, "recommended_n_synthetic": 300}
    found.compared = {"cross_validation": {"gp": validation}}
    return found


@pytest.fixture(scope="module")
def said(of_rssi, of_locate, of_aoa, tmp_path_factory):
    """Return the records of each result, and the result."""
    found = {}
    for name, result in (("rssi", of_rssi), ("locate", of_locate), ("aoa", of_aoa)):
        folder = tmp_path_factory.mktemp(name)
        with mock.patch("swiftwrf.rssi.maps.CELLS", 6):
            metrics = write_result(result.recorded(), folder)
        metrics = json.loads(json.dumps(metrics))
        (folder / CONFIG).write_text(json.dumps({"command": "swiftwrf"}))
        run = Records(folder, metrics)
        found[name] = (FractionRecords.of(run)[0] if name == "aoa" else run), result
    return found


@pytest.mark.parametrize("task", PAGES)
def test_every_table_has_medians_90_percent_and_intervals_over_places(said, task):
    (run, result), errors, page = said[task], ERRORS[task], PAGES[task]
    answer, library = page.answer(run), result.summary()
    section = page._errors(run, answer)
    terminal = zip(*(column.cells for column in _table(answer).columns), strict=True)
    terminal = {name: [said_of(cell) for cell in cells] for name, *cells in terminal}
    assert [name for name in terminal if name.startswith("*")] == [f"* {answer.chosen}"]
    terminal = {name[2:]: cells for name, cells in terminal.items()}
    usable = [name for name in terminal if name in errors and name != "peak"]
    assert usable == sorted(usable, key=lambda name: np.median(errors[name]))
    plain = {one["method"]: one for one in answer.values()["rows"]}
    report = {row[0]: row for row in section.tables[0].rows}
    several = {name: said_of(cell) for name, cell in compared({"one": answer}, [], {}, "error").table.rows}
    dots, distribution, speed = (panel.axes[0] for panel in section.plots[0].panels[:3])
    names = [label.get_text().replace("\n", " ") for label in dots.get_yticklabels()]
    whiskers = dict(zip(names, dots.containers[0].lines[2][0].get_segments(), strict=True))
    points = {line.get_label(): line.get_xydata()[0].tolist() for line in speed.lines}
    assert distribution.lines[-1].get_ydata() == [0.5, 0.5]  # the median
    for name, error in errors.items():
        expected, p90 = median_of(error), pytest.approx(np.quantile(error, 0.9), abs=0.00501)
        assert [*terminal[name][0], *terminal[name][1]] == several[name] == said_of(report[name][1]) == expected
        assert (terminal[name][2], float(report[name][2]), library.loc[name, "p90"]) == ([p90], p90, p90)
        assert library.loc[name, ["median", "low", "high"]].tolist() == expected
        found = {key.removesuffix(f"_{answer.unit.lower()}"): value for key, value in plain[name].items()}
        assert [found[key] for key in ("median", "low", "high")] == expected
        assert (found["p90"], found["mean"], found["n"]) == (p90, pytest.approx(error.mean()), 100)
        assert (found["chosen"], said_of(report[name][-1])) == (name == answer.chosen, [1, 2])
        assert (whiskers[name][:, 0].tolist(), points[name]) == (expected[1:], [3, expected[0]])


def test_rssi(said):
    run, result = said["rssi"]
    answer, inside = rssi_page.answer(run), norm.ppf(0.9) * STD >= OWN
    assert rssi_page.best_baseline(run) == "knn"  # its median is less than that of gp, its 90 % are more
    (sure,) = [text for text in answer.conclusion if "90 % of the errors are below" in text]
    apart = cdist(result.test.transmitter_position.numpy(), result.train.transmitter_position.numpy()).min(axis=1)
    errors = [round(float(np.median(OWN)), 1), 90, round(np.quantile(OWN, 0.9), 1), 100 * inside.mean(), 80]
    assert said_of(sure) == [*errors, 100, pytest.approx(np.median(apart), abs=0.0501), 30]
    assert compared_in(answer.conclusion[-1]) == difference_of(OWN, OTHER)
    cells = {one.name: [said_of(cell) for cell in one.cells.values()] for one in answer.methods}
    expected = {name: [difference_of(OWN, ERRORS["rssi"][name]), []] for name in ("knn", "gp")}
    assert cells == expected | {"swiftwrf": [[], [0.75]]}
    assert [80, 100 * inside.mean()] in [said_of(step.text) for step in answer.next_steps]
    shown = [number.value for number in rssi_page._summary(run, answer).numbers][-3:]
    assert shown == [f"{np.median(OWN):.2f} dB", f"{np.median(OTHER):.2f} dB", f"{inside.mean():.0%}"]
    assert (run.metrics["n_train"], run.metrics["n_test"]) == (30, 50)
    assert any("b -8.0 dB" in note for note in run.metrics["notes"])
    for name, line in zip(("swiftwrf", "knn"), rssi_page._by_rows(run)[0].axes[0].lines, strict=True):
        assert (line.get_xdata().tolist(), line.get_ydata().tolist()) == ([10, 30], result.by_rows[name].tolist())
    (plot,) = rssi_page._differences(run)
    assert plot.data["value_db"].is_monotonic_increasing
    for name, part in zip(run.metrics["receivers"], (slice(0, None, 2), slice(1, None, 2)), strict=True):
        found = run.metrics["receivers"][name]["knn"]["abs_error_db"]
        assert (found["median"], found["n"]) == (pytest.approx(np.median(OTHER[part])), 50)
        shown = plot.data[plot.data["receiver"] == name][["value_db", "low_db", "high_db"]]
        assert shown.to_numpy(float)[0].tolist() == difference_of(OWN, OTHER, part)
    plot, at = rssi_page._where(run), result.test.transmitter_position.numpy()
    where = plot.data
    running = where.sort_values("from_receiver_m")["abs_error_db"].rolling(20, center=True).median()
    assert plot.panels[1].axes[0].lines[-1].get_ydata() == pytest.approx(running.to_numpy(), nan_ok=True)
    receiver, known = result.test.receiver_position.numpy(), result.train.transmitter_position.numpy()
    for column, values in (
        ("from_receiver_m", cdist(at, receiver).ravel()),
        ("from_training_m", cdist(at, known).min(axis=1).repeat(2)),
        ("predicted_dbm", -60 + SIGN * OWN),
    ):
        assert where[column].to_numpy() == pytest.approx(values, abs=0.005)
    table = run.table("predictions")
    for column, away in (("low", -1), ("high", 1), ("predicted", 0)):
        assert table[column].to_numpy() == pytest.approx(-60 + SIGN * OWN + away * norm.ppf(0.9) * STD, abs=0.00501)
    assert np.array_equal(run.arrays("maps")["measured_position"], known)
    repeated = pd.DataFrame({"x": np.sqrt(N).astype(int), "y": 0, "z": 0, "receiver": "a", "measured": OWN})
    with mock.patch.dict(run._tables, predictions=repeated):
        squares = [(part - part.mean()) ** 2 for part in np.split(OWN, np.arange(1, 10) ** 2)]
        within = math.sqrt(np.concatenate(squares).sum() / (100 - 10))
        assert rssi_page.scatter_of_repeats(run) == pytest.approx(2 * norm.ppf(0.9) * within)


def test_locating(said):
    run, _ = said["locate"]
    errors, answer = ERRORS["locate"], locate_page.answer(run)
    found, sure, against = answer.conclusion
    median, low, high = median_of(OWN / 10)
    assert said_of(found) == [median, 90, round(np.quantile(OWN / 10, 0.9), 1)]
    shares = [round(100 * (radius >= OWN / 10).mean()) for radius in (1.05, 3.05, 9.05)]
    assert said_of(sure) == [95, low, high, shares[1], 80, 100, 40, 12]
    assert compared_in(against) == difference_of(OWN / 10, OTHER / 10)
    assert [80, shares[1]] in [said_of(step.text) for step in answer.next_steps]
    for one in answer.methods:
        plan, floor, difference = (said_of(cell) for cell in one.cells.values())
        error = errors[one.name]
        assert plan == [pytest.approx(0.6 * np.median(error), abs=0.00501)]
        assert floor == [pytest.approx(100 * (0.8 * error < 2.05).mean())]
        assert difference == (difference_of(OWN / 10, error) if one.name != "posterior" else [])
    shown = [number.value for number in locate_page._summary(run, answer).numbers]
    assert shown == [f"{np.median(OWN) / 10:.2f} m", f"{np.median(OTHER) / 10:.2f} m", f"{shares[1]}%"]
    lines, truth = locate_page._overview(run, "all").panels[0].axes[0].collections[0], run.table("errors")
    truth = truth[truth["method"] == "posterior"][["truth_x_m", "truth_y_m"]].to_numpy()
    ends = np.array(lines.get_segments())
    assert ends[:, 0] == pytest.approx(truth)
    assert np.linalg.norm(ends[:, 1] - truth, axis=1) == pytest.approx(0.06 * OWN[::-1], abs=1e-6)
    assert lines.get_array().tolist() == pytest.approx(OWN[::-1] / 10, abs=0.005)
    assert lines.get_clim() == pytest.approx((0, np.quantile(OWN / 10, 0.95)))
    table = locate_page._calibration(run).data
    for row, level, share in zip(table.to_numpy().tolist(), (0.5, 0.8, 0.95), shares, strict=True):
        interval = binomtest(round(share / 4), 25).proportion_ci(method="wilson")  # as of 25 places
        assert row == [level, share / 100, pytest.approx(interval.low), pytest.approx(interval.high)]


def test_credible_circles(said):
    run, result = said["locate"]
    maps = run.arrays("maps")
    assert maps["index"].tolist() == [99, 79, 59, 40, 20, 0]  # from the smallest error to the largest
    drawn = [panel.axes[0] for panel in locate_page.posteriors(maps | {"estimate": maps["estimate"] + 1})]
    assert [(ax.patches[0].get_radius(), tuple(ax.patches[0].center)) for ax in drawn] == [(4.0, (1, 1))] * 6
    away = np.linalg.norm(result.test.transmitter_position.numpy()[maps["index"]] - 1, axis=1)
    assert [said_of(ax.get_title())[1] for ax in drawn] == pytest.approx(away, abs=0.00501)
    posterior = Rings().locate([0])
    shown = Located.of(posterior, torch.tensor([3.0, 4.0, 0.0]))
    assert said_of(shown.describe())[3:] == [50, 2.5, 80, 4.0, 5.0]
    for path in (posterior.plot().get_lines()[-1].get_xydata(), charts.circle((3.0, 4.0, 0.0), 4.0) - [3, 4]):
        assert np.hypot(*path.T) == pytest.approx(4.0, abs=0.01)
    assert posterior.std[0].tolist() == pytest.approx([np.arange(-50, 51).std() / 10, 0, 0])
    localizer, mass = PosteriorLocalizer(), torch.tensor([[0.25, 0.75]]).double()
    storeys = Posterior(
        torch.tensor([[[0.0, 0, 0], [0, 0, 4]]]).double(), mass.log(), floors=Floors(("a", "b"), (0.0, 4.0))
    )
    localizer.locator = SimpleNamespace(locate=lambda rows: storeys, region=SimpleNamespace(floors=storeys.floors))
    assert localizer.locate(torch.zeros(1, 2)).floor_probability.tolist() == pytest.approx([0.75])
    wide = replace(posterior, inflation=1.5, resolution_m=0.8)
    assert wide.credible_radius(0.5).tolist() == pytest.approx([1.5 * (2.5 + 0.2)])
    assert wide.std[0, 1] == pytest.approx(0.8 / math.sqrt(12))


def test_directions(said):
    fraction, result = said["aoa"]
    errors, answer = ERRORS["aoa"], aoa_page.answer(fraction)
    turbo, alone = errors["network, measured + synthetic (gp)"], errors["network, measured"]
    found, sure, against = answer.conclusion
    median, low, high = median_of(turbo)
    assert (said_of(repr(result)), fraction.percent) == ([4, median], "40%")
    assert said_of(found) == [median, 90, round(np.quantile(turbo, 0.9), 1)]
    assert said_of(sure) == [95, low, high, 100, 24, 60]
    changes = [change_of(turbo, alone), change_of(turbo, errors["peak"])]
    assert said_of(against) == [*changes[0], *changes[1], 1.5]
    assert re.findall("a gain|a loss|not significant", against) == ["a gain", "not significant"]
    cells = {one.name: one.cells for one in answer.methods}
    assert [float(cells["peak"][name]) for name in ("azimuth [deg]", "elevation [deg]")] == pytest.approx([0, 1.5])
    assert said_of(cells["network, measured + synthetic (gp)"]["by synthetic spectra"]) == changes[0]
    table = result.summary().loc["network, measured + synthetic (gp)"]
    assert table[["change", "change_low", "change_high"]].tolist() == changes[0]
    with mock.patch.object(FractionRecords, "chosen", "matched_field, measured"):
        assert said_of(aoa_page.conclusion(fraction)[0])[1] == round(np.median(OWN) / 10, 1)
    section = aoa_room.locating_section(fraction)
    (row,), calibration = section.tables[0].rows, section.plots[-1].panels[0].axes[0].lines[1]
    assert calibration.get_ydata() == pytest.approx([(level > N / 120).mean() for level in np.linspace(0, 1, 21)])
    assert said_of(row[1]) == median_of(OWN / 10, 0.05)
    assert [float(cell.rstrip("%")) for cell in row[2:]] == [round(np.quantile(OWN / 10, 0.9), 1), 96, 7]
    assert result.positions["credible_radius_80_m"].tolist() == N.tolist()
    free = result.experiment.test.line_of_sight.numpy().mean()
    assert fraction.run.metrics["line_of_sight_share"] == pytest.approx(free)
    assert fraction.mix["seconds"] == {"fit": 1, "synthesize": 7, "train": 2}  # of gp, and of two networks
    row, other = synthesis.quality_table(fraction).rows
    assert (row[0], other[0]) == ("gp", "idw")  # the best first
    assert said_of(row[2]) == median_of(OWN / 4, 0.05)
    expected = [np.median(OWN) / 100, OWN.mean() / 100, 1.0]
    assert [float(cell) for cell in row[3:]] == [pytest.approx(each, abs=0.000501) for each in expected]


@pytest.mark.parametrize(("constant", "is_path"), [(0.7, True), (0.9, False)])
def test_why_a_method_is_chosen_and_whether_the_labels_are_a_path(said, constant, is_path):
    fraction, _ = said["aoa"]
    choice = {"name": "peak", "held_out_deg": {"peak": 7.0, "other": 7.5}, "n_held_out": 30}
    choice |= {"held_out_mean_deg": {"peak": 8.25, "other": 8.0}, "better": {"network, measured": "so"}}
    with (
        mock.patch.dict(fraction.mix, estimator_choice=choice),
        mock.patch.object(FractionRecords, "medians", fraction.medians | {"constant": constant, "peak": 1.6}),
    ):
        _, sure, against = aoa_page.conclusion(fraction)
        cells = {one.name: one.cells["held out, median and mean [deg]"] for one in aoa_page.answer(fraction).methods}
    assert said_of(sure)[-4:] == [7, 30, 8.25, pytest.approx(np.median(OTHER) / 10, abs=0.005)]
    assert ("fingerprinting" in against) == is_path
    assert said_of(against)[6:] == [0.7, 2] * is_path
    assert (cells["peak"], cells["network, measured"]) == ("7.00, 8.25", "")


def test_examples_of_spectra(said):
    fraction, result = said["aoa"]
    test, n_pixels = result.experiment.test, 8 * 32
    predicted = test.spectrum * torch.linspace(0.5, 0.99, 100)[:, None, None]
    away, std = (predicted - test.spectrum).numpy(), torch.full_like(predicted, 0.1)
    score = 10 * np.log10(n_pixels / (away**2).sum(axis=(1, 2)))
    save_examples(fraction.run.folder / "examples-mix0.4.npz", "gp", test, predicted, torch.from_numpy(score), std)
    shown, plot = synthesis.examples(fraction), synthesis.examples_plot(fraction)
    assert f"{(abs(away) <= norm.ppf(0.9) * 0.1).mean():.0%} of the pixels" in plot.caption
    for (images, title, truth), row in zip(shown, np.argsort(score)[[99, 50, 0]], strict=True):
        assert said_of(title) == [int(test.index[row]), pytest.approx(score[row], abs=0.0501)]
        assert images["difference"] == pytest.approx(away[row], abs=1.01 / 255)
        assert truth == pytest.approx(test.label[row].rad2deg().tolist(), abs=1e-3)
    drawn = synthesis.spectra(images, "a", truth).axes[0].lines
    peak = test.grid.peak_direction(torch.from_numpy(images["measured"])[None])[0].rad2deg()
    for mark, (azimuth, elevation) in ((drawn[0], peak.tolist()), (drawn[-1], truth)):
        turn, tilt = mark.get_xydata()[0]
        assert (np.rad2deg(turn), 90 - tilt) == pytest.approx((azimuth, elevation))
    assert (
        aoa_page.first_screen(fraction, aoa_page.answer(fraction)).numbers[-1].value == f"{np.median(OWN) / 4:.1f} dB"
    )


def test_the_room_and_posteriors_in_plan(said):
    fraction, result = said["aoa"]
    normal, offset = np.array([[-1.0, 0, 0], [0.8, 0.6, 0], [0.6, -0.8, 0]]), np.array([2.0, 3.0, 4.0])
    known = {"gain": -0.5, "std_mm": 1.75, "order": 2, "probability": 0.875}
    planes = [
        known
        | {"normal": list(n), "offset_m": at, "certain": at > 2}
        | {"dielectric": at == 2, "rival_m": 2.25 if at == 2 else None}
        for n, at in zip(normal, offset, strict=True)
    ]
    room = {"planes": planes, "order": 2, "unexplained": 0.1, "score_held_out": 0.25}
    at = result.experiment.train.position.numpy()
    points = {"measured": at, "fixed": at[0], "image": at[:3], "order": np.array([1, 2, 1])}
    located = points | {"index": np.array([3, 4]), "truth": np.zeros((2, 3)), "radius": np.array([0.01, 0.2])}
    located |= {"estimate": np.array([[0.03, 0, 0.04], [0, 0.1, 0]]), "candidate": np.zeros((2, 2, 3))}
    located |= {"weight": np.array([[0.8, 0.2]] * 2), "normal": normal, "offset": offset, "certain": offset > 2}
    write_json(fraction.run.folder / "geometry-mix0.4.json", room)
    fraction.run._arrays.update({"room-mix0.4": points, "located-mix0.4": located})
    section = aoa_room.room_section(fraction)
    (table,), (plot,) = section.tables, section.plots
    assert [row[0] for row in table.rows][:2] == ["x = -2.000 m", "(0.800, 0.600, 0.000) . x = 3.000 m"]
    assert table.rows[0][1:] == ["-0.50 (dielectric)", "1.8", "87.5%", "x = -2.250 m", "no"]
    assert table.rows[1][1:] == ["-0.50", "1.8", "87.5%", "none", "yes"]
    assert said_of(table.caption) == [2, 90, 0.75, 90]
    for figure in (plot.panels[0], aoa_room.located_plan(fraction)):
        for wall, n, distance in zip(figure.axes[0].lines, normal, offset, strict=False):
            assert wall.get_xydata() @ n[:2] == pytest.approx([distance] * 2)
            assert wall.get_linestyle() == ("-" if distance > 2 else "--")
    assert figure.axes[0].collections[0].get_array().tolist() == pytest.approx(OWN / 10, abs=0.05)  # [cm]
    assert plot.data.groupby("what").size().to_dict() == {"fixed end": 1, "image of first order": 2, "measured": 60}
    first, second = (panel.axes[0] for panel in aoa_room._posteriors(fraction).panels)
    assert [said_of(ax.get_title()) for ax in (first, second)] == [[3, 5.0], [4, 10.0]]
    sizes = first.collections[0].get_sizes()
    assert sizes[1] / sizes[0] == pytest.approx(0.25)  # areas
    assert second.get_ylim() == pytest.approx((0.1 - 1.3 * 0.4, 0.1 + 1.3 * 0.4))


def test_whether_synthetic_spectra_help(said):
    fraction, _ = said["aoa"]
    for change, words in ({}, "helps here"), ({"low": 0.02}, "harms"), ({"low": -0.1}, "not significant"):
        more = {"helps": not change, "rule": RULE | change}
        with mock.patch.dict(fraction.mix["cross_validation"]["gp"], more):
            (text,) = aoa_room.cross_validation_sentences(fraction)
        assert said_of(text)[:7] == [30, -20, 100 * more["rule"]["low"], -5, 2.0, 1.6, 300]
        assert words in text
    worse = {"gains": [gain | {"change": 0.1} for gain in VALIDATION["gains"]]}
    with mock.patch.dict(fraction.mix["cross_validation"]["gp"], worse):
        assert "No number reduces it." in aoa_room.cross_validation_sentences(fraction)[0]
    plot = aoa_room._gain(fraction, "gp", VALIDATION)
    assert plot.panels[0].axes[0].lines[0].get_xydata().tolist() == [[0, 0], [300, -25], [1000, -25]]


def test_examples_of_positions_are_from_the_smallest_error_to_the_largest(said, tmp_path):
    (_, result), locator = said["aoa"], Rings()
    wall = SimpleNamespace(normal=(1.0, 0.0, 0.0), offset_m=2.0, certain=True)
    locator.room = SimpleNamespace(planes=[wall], fixed_position=torch.zeros(3))
    test = result.experiment.test
    save_located(tmp_path / "a.npz", locator, test, test, test.position + torch.from_numpy(OWN[:, None]) * ALONG)
    found, rows = read_npz(tmp_path / "a.npz"), [0, 20, 40, 59, 79, 99]
    assert found["index"].tolist() == test.index[rows].tolist()
    assert found["truth"] == pytest.approx(test.position[rows].numpy())
    assert (found["radius"].tolist(), found["offset"].tolist()) == ([4.0] * 6, [2.0])


@pytest.mark.parametrize(
    ("differences", "words"),
    [
        (np.full(30, -0.5), "is lower than that of b"),
        (np.full(30, 0.5), "b has the lower mean error"),
        (np.tile([-3.0, 3.1], 15), "do not differ significantly"),
        (np.tile([-3.1, 3.0], 15), "do not differ significantly"),
        (np.tile([-0.1, 0.11], 15), "are equal in practice"),
        (np.full(9, -0.5), "9 test places are too few"),
        (np.tile([-0.1, 0.5], 15), "b has the lower mean error"),  # the upper end alone is relevant
    ],
)
def test_a_difference_is_said_as_it_is(differences, words):
    index = pd.MultiIndex.from_arrays([np.arange(2 * len(differences)), np.arange(2 * len(differences)) // 2])
    other = np.full(2 * len(differences), 10.0)
    errors = pd.DataFrame({"a": other + differences.repeat(2), "b": other}, index=index.set_names(["index", "place"]))
    sentence = comparison_sentence(errors, "a", "b", name="a", unit="dB", rows="rows")
    assert words in sentence
    if "few" not in words:
        assert said_of(sentence)[0] == pytest.approx(differences.mean(), abs=0.00501)


@pytest.mark.parametrize(("nominal", "n"), [(0.8, 20), (0.8, 400), (0.5, 100), (0.95, 50)])
def test_coverage_is_warned_of_beyond_chance_and_five_points(nominal, n):
    margin = max(0.05, 2 * math.sqrt(nominal * (1 - nominal) / n))
    for sign, size in ((-1, "narrow"), (1, "wide")):
        assert coverage_warning("regions", nominal + sign * (margin - 0.001), nominal, n) == ""
        warned = coverage_warning("regions", beyond := nominal + sign * (margin + 0.001), nominal, n)
        assert size in warned
        assert said_of(warned) == [100 * nominal, round(100 * beyond)]
    assert [number(value, 1) for value in (-1.25, 0.06, None)] == ["-1.2", "0.1", "-"]


# ---------------------------------------------------------------------------- levels, innovations, units, geometry


@given(st.floats(0.02, 0.999))
def test_an_interval_contains_its_share_of_draws(level):
    draws = torch.from_numpy(norm.ppf((np.arange(10_000) + 0.5) / 10_000) * 3 - 60)
    low, high = Prediction(torch.tensor([-60.0]), torch.tensor([3.0])).interval(level)
    assert float(((draws >= low) & (draws <= high)).double().mean()) == pytest.approx(level, abs=0.002)


def test_a_lone_place_has_the_range_of_its_errors():
    found = summary([1.0, 2.0, 5.0], [0, 0, 0])
    assert (found["low"], found["high"]) == (1, 5)


@pytest.mark.parametrize(("shared", "expected"), [(0, [40, 15]), (4, [40])])
def test_rows_at_one_position_are_noted(shared, expected):
    """Thirty training rows are at ten positions, ten test rows at five others, or some of them at a training position."""
    room = rssi_room(n=40)
    place = torch.cat([torch.arange(30) // 3, 10 + torch.arange(10) // 2])
    place[30 : 30 + shared] = 0
    data = room.derived(transmitter_position=room.transmitter_position[place])
    (note,) = split_notes(data.subset(torch.arange(30)), data.subset(torch.arange(30, 40)), "random")
    assert said_of(note) == expected


class Known(RssiPredictor):
    """-60 dBm with a standard deviation of 4 dB."""

    name = "known"

    def _fit(self, train, **_):
        self.n = len(train.receiver_names)

    def _predict(self, position):
        return torch.full((len(position), self.n), -60.0).double(), torch.full((len(position), self.n), 4.0).double()


def test_innovations_have_the_deviation_that_their_false_alarms_assume():
    draws = -60 + 4 * torch.randn(4000, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    data = Rssi(draws, torch.rand(4000, 3))
    found = score(Known().fit(data), data)
    assert float(found.innovation.std()) == pytest.approx(1, abs=0.03)
    assert float((found.innovation.abs() > 1.96).double().mean()) == pytest.approx(0.05, abs=0.006)
    assert float(found.covered.mean()) == pytest.approx(0.8, abs=0.01)
    assert torch.equal(found.error, (draws + 60).abs().mean(dim=1))


def test_the_error_of_a_spectrum_is_a_root_mean_square_and_its_interval_a_part_of_0_to_1():
    room = simulated_room(n=20, grid=AngularGrid.hemisphere(8, 32))
    model = make_model("gp").fit(room.subset(torch.arange(12)))
    found, new = model.predict(room.position[12:]), room.subset(torch.arange(12, 20))
    expected = np.sqrt(((found.mean - new.spectrum).numpy() ** 2).mean(axis=(1, 2)))
    assert score(model, new).error.numpy() == pytest.approx(expected, rel=1e-5)
    low, high = replace(found, std=10 * torch.ones_like(found.mean)).interval()
    assert (low.unique().tolist(), high.unique().tolist()) == ([0], [1])


@pytest.mark.parametrize("mass", [0.09, 0.11, 0.3, 0.5])
def test_a_second_mode_of_a_tenth_is_ambiguous(mass):
    at = torch.tensor([[[0.0, 0, 0], [0.1, 0, 0], [9.0, 0, 0]]], dtype=torch.float64)
    weight = torch.tensor([[(1 - mass) * 0.6, (1 - mass) * 0.4, mass]], dtype=torch.float64)
    assert Posterior(at, weight.log(), 0.1, mode_width_m=0.5).ambiguous.tolist() == [mass > 0.1]


def test_a_calibration_turns_labels_the_right_way():
    data, *_ = spoilt(snapshots(n=150))
    right, found = snapshots(n=150).direction, calibrate(data).apply(data).direction
    off = torch.linalg.cross(found, right, dim=1).norm(dim=1).asin().rad2deg()
    assert float(off.max()) < 2 < float((found * right).sum(dim=1).acos().rad2deg().min() + 2)


@pytest.mark.parametrize(
    ("name", "values", "expected"),
    [
        *((f"time_{unit}", [5.0 * factor, 7.0 * factor], 2.0) for unit, factor in (("s", 1), ("ms", 1e3), ("us", 1e6))),
        ("time_ns", [5e9, 7e9], 2.0),
        ("time_min", [5.0, 7.0], 120.0),
        *(("time", [(1.7e9 + s) * f for s in (0, 2)], 2.0) for f in (1, 1e3, 1e6, 1e9)),
    ],
)
def test_times_are_seconds(name, values, expected):
    assert seconds(pd.Series(values, name=name))[0].tolist() == [0, pytest.approx(expected)]


def test_an_offset_of_one_row_is_drawn_to_zero_by_a_deviation_of_ten_decibels():
    """Rows far apart, at a receiver of unknown position: level of three rows, offset of the fourth."""
    corner = torch.tensor([[0.0, 0, 0], [100, 0, 0], [0, 100, 0], [100, 100, 0]])
    data = Rssi(
        torch.tensor([[-60.0], [-60], [-60], [-52]]), corner, groups=pd.Series(["a", "a", "a", "b"], name="phone")
    )
    found = estimate_offsets(data, "a").offset_db["b"]
    prior, one, level = (
        20,
        2,
        2 / 3,
    )  # variances: 10 dB in units of a row's, a row's (shadowing and fading), and of the level
    assert found == pytest.approx(8 * prior / (prior + one + level), rel=0.03)


def test_synthetic_positions_are_as_near_as_the_positions_lie():
    """On a ring of growing steps, whose inside stays empty."""
    angle = 2 * math.pi * (torch.arange(10.0, 110.0, dtype=torch.float64) / 110) ** 2
    known = torch.stack([10 * angle.cos(), 10 * angle.sin(), torch.zeros(100)], dim=1)
    away = cdist(known, known)
    spacing = np.quantile(np.sort(away, axis=1)[:, 8], 0.95)
    reached = cdist(sample_positions(known, 3000, 0).numpy(), known).min(axis=1).max()
    assert 0.9 * spacing < reached <= spacing


def test_the_near_field_begins_at_30_centimetres():
    at = torch.tensor([[0.1, 0, 0], [0.3, 0, 0], [0.5, 0, 0], [2.0, 0, 0]])
    assert log_distance(at, torch.zeros(1, 3))[:, 0].tolist() == pytest.approx(np.log10([0.3, 0.3, 0.5, 2.0]).tolist())


def test_degrees_are_metres_of_the_ellipsoid():
    """A step of 1e-4 degrees north and 2e-4 east, by the radii of curvature of WGS84."""
    for latitude, longitude in ((48.0, 11.0), (-33.9, -70.2)):
        flat = 1 - 0.00669437999014 * math.sin(math.radians(latitude)) ** 2
        north = math.radians(1e-4) * 6378137 * (1 - 0.00669437999014) / flat**1.5
        east = math.radians(2e-4) * 6378137 / math.sqrt(flat) * math.cos(math.radians(latitude))
        origin, degrees = GeodeticOrigin(latitude, longitude), np.array([[latitude + 1e-4, longitude + 2e-4]])
        assert origin.to_metres(degrees)[0] == pytest.approx([east, north], abs=1e-3)
        assert origin.to_degrees(np.array([[east, north]])) == pytest.approx(degrees, abs=1e-8)
