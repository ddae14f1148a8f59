"""What results say is what they are: printed numbers against plain NumPy, on results whose truth is known.

Errors are 0 to 99 in some unit, four at each of 25 places, so that quantiles are known by heart.
"""

import json
import math
import re
from pathlib import Path
from unittest import mock

import numpy as np
import pandas as pd
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from samples import snapshots
from scipy.spatial.distance import cdist
from scipy.stats import norm
from test_calibration import spoilt

from augment.positions import sample_positions
from augment.turbo.condition import Condition, MeasuredSubset
from augment.turbo.experiment import Experiment
from augment.turbo.results import TurboResult
from swiftwrf import AngularGrid, Rssi, RssiModel, calibrate, rssi_room, simulated_room
from swiftwrf.data.cells import seconds
from swiftwrf.data.coordinates import Floors
from swiftwrf.locate import Posterior
from swiftwrf.locate.comparison import LocateComparison, LocateSplit
from swiftwrf.metrics import summary
from swiftwrf.models.prediction import Prediction
from swiftwrf.online import score
from swiftwrf.rssi import RssiComparison, RssiPredictor, estimate_offsets, log_distance
from tasks.aoa import experiment as aoa
from tasks.aoa import page as aoa_page
from tasks.aoa.records import FractionRecords
from tasks.aoa.room import cross_validation_sentences, locating_section
from tasks.aoa.synthesis import quality_table
from tasks.locate import experiment as locate
from tasks.locate import page as locate_page
from tasks.page.shared import comparison_sentence, coverage_warning
from tasks.records import CONFIG, Records
from tasks.rssi import experiment as rssi
from tasks.rssi import page as rssi_page
from tasks.terminal import _table
from tasks.view.locating import Located

ERROR = np.arange(100.0)
PLACE = np.arange(100) // 4
OTHER = 0.8 * ERROR + np.random.default_rng(0).permutation(100) * 0.3  # of a second method
THIRD = np.full(100, 60.0)  # of a third one
SIGN = np.where(np.arange(100) % 3, 1.0, -1.0)


def bounds(statistic, place=PLACE):
    """Return the 95 % interval of a statistic of rows, (samples, rows), by samples of whole places."""
    rows = place.argsort(kind="stable").reshape(25, -1)
    drawn = np.random.default_rng(7).integers(25, size=(4000, 25))
    return np.percentile(statistic(rows[drawn].reshape(4000, -1)), (2.5, 97.5))


def near(expected, width):
    """Return an approximate value that an interval of 90 or 80 % has not."""
    return pytest.approx(expected, abs=0.06 * width)


def said_of(text):
    """Return the numbers in a text."""
    return [float(found) for found in re.findall(r"(?<![\w.])[-+]?\d+(?:\.\d+)?", text)]


def recorded(folder, record, result):
    """Return the records of a result."""
    metrics = json.loads(json.dumps(record(result, folder)))
    (folder / CONFIG).write_text(json.dumps({"command": "swiftwrf"}))
    return Records(folder, metrics)


def rows_of(answer):
    """Return the numbers in the rows of the terminal's table, by method, without the mark of the chosen one."""
    columns = [list(column.cells) for column in _table(answer).columns]
    return {name.lstrip("* "): [said_of(cell) for cell in cells] for name, *cells in zip(*columns, strict=True)}


# ------------------------------------------------------------------------------------------------------------- RSSI


@pytest.fixture(scope="module")
def of_rssi():
    """Fifty test rows at two receivers; the standard deviation is 60 dB for even and 10 dB for odd errors."""
    room = rssi_room(n=60).columns([0, 5])
    train, test = room.subset(torch.arange(30)), room.subset(torch.arange(10, 60))
    position = test.transmitter_position[:25].repeat_interleave(2, 0)
    test = test.derived(transmitter_position=position, rssi_dbm=torch.full((50, 2), -60.0))
    model = RssiModel(n_primitives=0).fit(train)

    def value(error, n, **more):
        known = {"predicted": (-60 + SIGN * error).tolist(), "std": None, "fit": n, "predict": n + 0.5}
        return known | {"median_db": 1.0, "mean_db": 2.0, "detection": None, "n_primitives": 0} | more

    std = np.where(ERROR % 2, 10.0, 60.0)
    values = {
        "swiftwrf": value(ERROR, 1.0, std=std, detection=(0.9, 0.6)),
        "knn": value(OTHER, 2.0),
        "mean": value(THIRD, 3.0),
    }
    options = {"split": "random", "preset": "quick", "seed": 0}
    return RssiComparison(train, test, values, {}, {"swiftwrf": model}, pd.DataFrame(), options)


@pytest.fixture(scope="module")
def rssi_said(of_rssi, tmp_path_factory):
    with mock.patch("swiftwrf.rssi.maps.CELLS", 6):
        return recorded(tmp_path_factory.mktemp("rssi"), rssi.record, of_rssi)


# --------------------------------------------------------------------------------------------------------- locating


class Rings:
    """A locator whose posteriors have equal masses on 101 candidates, at 0 to 5 m along x either way."""

    def locate(self, rssi):
        step = torch.arange(-50, 51, dtype=torch.float64) / 10
        at = torch.nn.functional.pad(step[:, None], (0, 2))
        return Posterior(at.expand(len(rssi), -1, -1), torch.full((len(rssi), 101), 1 / 101).double().log())


@pytest.fixture(scope="module")
def of_locating():
    """A hundred test rows, the first of which have the largest errors, 0 to 9.9 m along (0.6, 0, 0.8)."""
    room = rssi_room(n=100)
    at = room.transmitter_position[:25].repeat_interleave(4, 0) * torch.tensor([1.0, 1.0, 0.0])
    floors = Floors(("ground", "first"), (0.0, 4.1))
    test = room.derived(transmitter_position=at, floors=floors)
    split = LocateSplit(test.subset(torch.arange(40)), test, "random", 300, 0, 3)

    def value(error, **more):
        estimate = at + torch.from_numpy(error[::-1, None] / 10) * torch.tensor([0.6, 0.0, 0.8])
        seconds = {"fit": 1.0, "predict": 2.0}
        return {"seconds": seconds, "index": test.index, "truth": at, "estimate": estimate, "median_m": 0.0} | more

    radius = torch.tensor([[2.05, 5.05, 9.05]]).expand(100, 3)
    own = value(ERROR, radius=radius, ambiguous=torch.arange(100) < 10, weights={"values": 0.5})
    values = {"posterior": own, "knn": value(OTHER), "knn_difference": value(2 * OTHER), "mean": value(THIRD)}
    return LocateComparison(split, values, Rings())


@pytest.fixture(scope="module")
def locate_said(of_locating, tmp_path_factory):
    return recorded(tmp_path_factory.mktemp("locate"), locate.record, of_locating)


# ------------------------------------------------------------------------------------------------------- directions

MEASURED = Condition("aann_kernel", "measured", measured_fraction=0.5)
TURBO = Condition("aann_kernel", "measured + synthetic", "gp", measured_fraction=0.5)
LOCATED = Condition("matched_field", "measured", measured_fraction=0.5)
METHODS = {"network, measured": OTHER / 10, "network, measured + synthetic (gp)": ERROR / 20}


@pytest.fixture(scope="module")
def of_angles():
    """A hundred test spectra with errors of 0 to 9.9 degrees, half of that with synthetic spectra, and of 0 to 99 mm."""
    grid = AngularGrid.hemisphere(8, 32)
    room, train = simulated_room(n=25, grid=grid), simulated_room(n=60, seed=1, grid=grid)
    test = room.subset(torch.arange(25).repeat_interleave(4)).derived(index=torch.arange(100).flip(0))
    found = TurboResult(Experiment(train, test, (0.5,), ["gp"], estimators=[]), 0.5, Path())
    times = {"train": 1.0, "estimate": 2.0}
    error = dict(zip((MEASURED, TURBO), METHODS.values(), strict=True))
    error |= {Condition("peak", "measured", measured_fraction=0.5): THIRD / 20, LOCATED: ERROR / 10}
    for condition, degrees in error.items():
        off = torch.from_numpy(np.stack([np.zeros(100), degrees], axis=1)).deg2rad()
        value = {"estimate": (test.label - off).tolist(), "seconds": times, "history": [], "counts": {}}
        if condition is LOCATED:
            place = test.position + torch.from_numpy(ERROR[:, None] / 1000) * torch.tensor([0.6, 0.0, 0.8])
            known = {"position": place.tolist(), "radius": [0.05] * 100, "level": (ERROR / 120).tolist()}
            spent = {"room": 1.0, "fit": 2.0, "locate": 3.0}
            value["located"] = known | {"ambiguous": (ERROR < 7).tolist(), "weights": {"fields": 1.0}, "seconds": spent}
        found.add(condition, value)
    scores = {"psnr_db": ERROR / 4, "ssim": (ERROR / 100) ** 2, "l1": (ERROR / 100) ** 2}
    spent = {"fit": 5.0, "synthesize": 6.0, "draw": 7.0}
    found.add_synthesis(MeasuredSubset(0.5), "gp", True, {"scores": scores, "seconds": spent, "history": []})
    found.compared = {"cross_validation": {"gp": VALIDATION}}
    return found


GAIN = {"n_synthetic": 300, "median_deg": 1.5, "change": -0.25, "low": -0.4, "high": -0.1}
RULE = {"median_deg": 1.6, "change": -0.2, "low": -0.35, "high": -0.05}
VALIDATION = {"stand_in": "kernel_regression", "n_held_out": 30, "measured_only_deg": 2.0, "rule": RULE}
VALIDATION |= {"gains": [GAIN | {"n_synthetic": 1000, "median_deg": 1.7}, GAIN], "helps": True}
VALIDATION |= {"recommended_n_synthetic": 300}


@pytest.fixture(scope="module")
def angles_said(of_angles, tmp_path_factory):
    run = recorded(tmp_path_factory.mktemp("aoa"), lambda result, folder: aoa.record([result], folder), of_angles)
    return FractionRecords.of(run)[0]


# --------------------------------------------------------------------------------- medians, quantiles and intervals


def errors_in(what, request):
    """Return answer, errors of each method by row, and the place of each row."""
    match what:
        case "rssi":
            return rssi_page.answer(request.getfixturevalue("rssi_said")), RSSI_ERRORS
        case "locate":
            return locate_page.answer(request.getfixturevalue("locate_said")), LOCATE_ERRORS
    return aoa_page.answer(request.getfixturevalue("angles_said")), METHODS | {"peak": THIRD / 20}


RSSI_ERRORS = {"swiftwrf": ERROR, "knn": OTHER, "mean": THIRD}
LOCATE_ERRORS = {"posterior": ERROR / 10, "knn": OTHER / 10, "knn_difference": OTHER / 5, "mean": THIRD / 10}


@pytest.mark.parametrize("what", ["rssi", "locate", "aoa"])
def test_tables_have_medians_90_percent_and_intervals_over_places(what, request):
    answer, errors = errors_in(what, request)
    rows, plain = rows_of(answer), {row["method"]: row for row in answer.values()["rows"]}
    for name, error in errors.items():
        low, high = bounds(lambda rows, error=error: np.median(error[rows], axis=-1))
        width = high - low
        (median,), ends, (p90,) = rows[name]
        assert median == pytest.approx(np.median(error), abs=0.00501)
        assert p90 == pytest.approx(np.sort(error)[89] + 0.1 * np.diff(np.sort(error)[89:91])[0], abs=0.00501)
        assert ends == [near(low, width + 0.1), near(high, width + 0.1)]
        unit = answer.unit.lower()
        found = plain[name]
        assert (found["n"], found[f"mean_{unit}"]) == (100, pytest.approx(error.mean()))
        assert [found[f"{key}_{unit}"] for key in ("median", "p90")] == pytest.approx([median, p90], abs=0.00501)
        assert [round(found[f"{key}_{unit}"], 2) for key in ("low", "high")] == ends
    medians = [rows[name][0][0] for name in rows if name in errors and name != "mean" and name != "peak"]
    assert medians == sorted(medians)
    assert [name for name, row in plain.items() if row["chosen"]] == [answer.chosen]


def change_of(after, before):
    """Return the change of a median and its 95 % interval in percent."""

    def change(rows):
        return 100 * (np.median(after[rows], axis=-1) / np.median(before[rows], axis=-1) - 1)

    low, high = bounds(change)
    return [pytest.approx(change(np.arange(100)), abs=0.501), near(low, high - low + 8), near(high, high - low + 8)]


def difference_of(own, other, rows=slice(None)):
    """Return the mean difference of two errors and its 95 % interval."""
    difference, place = (own - other)[rows], PLACE[rows]
    low, high = bounds(lambda rows: difference[rows].mean(axis=-1), place)
    return [pytest.approx(difference.mean(), abs=0.00501), near(low, high - low), near(high, high - low)]


def test_rssi_sentences(rssi_said):
    run, inside = rssi_said, norm.ppf(0.9) * np.where(ERROR % 2, 10, 60) >= ERROR
    (sure,) = [text for text in rssi_page.conclusion(run) if "% of the errors are below" in text]
    assert said_of(sure) == [90, pytest.approx(89.1), 100 * inside.mean(), 80, 100, 30]
    answer = rssi_page.answer(run)
    cells = {one.name: [said_of(cell) for cell in one.cells.values()] for one in answer.methods}
    assert cells == {"swiftwrf": [[], [0.75]]} | {
        name: [difference_of(ERROR, error), []] for name, error in (("knn", OTHER), ("mean", THIRD))
    }
    best = min((OTHER, THIRD), key=np.median)
    assert rssi_page.best_baseline(run) == ("knn" if best is OTHER else "mean")
    assert said_of(rssi_page.conclusion(run)[-1]) == difference_of(ERROR, best)
    assert [100 * inside.mean(), 80] in [said_of(step.text)[::-1] for step in answer.next_steps]
    assert [one.seconds for one in sorted(answer.methods, key=lambda one: one.seconds)] == [
        (1, 1.5),
        (2, 2.5),
        (3, 3.5),
    ]
    shown = [number.value for number in rssi_page._summary(run).numbers][-3:]
    assert shown == ["49.50 dB", f"{np.median(best):.2f} dB", f"{inside.mean():.0%}"]


def test_rssi_tables(of_rssi, rssi_said):
    first, second = rssi_said.metrics["receivers"]
    for name, even in ((first, 0), (second, 1)):
        found = rssi_said.metrics["receivers"][name]["knn"]["abs_error_db"]
        assert (found["median"], found["n"]) == (pytest.approx(np.median(OTHER[even::2])), 50)
    (plot,) = rssi_page._differences(rssi_said)
    best = {"knn": OTHER, "mean": THIRD}[rssi_page.best_baseline(rssi_said)]
    shown = plot.data.set_index("receiver")[["value_db", "low_db", "high_db"]].astype(float)
    assert shown["value_db"].is_monotonic_increasing
    for name, even in ((first, 0), (second, 1)):
        assert shown.loc[name].tolist() == difference_of(ERROR, best, slice(even, None, 2))
    where, test = rssi_page._where(rssi_said).data, of_rssi.test
    assert where["predicted_dbm"].tolist() == pytest.approx((-60 + SIGN * ERROR).tolist())
    at = test.transmitter_position.numpy()
    receiver = cdist(at, test.receiver_position.numpy()).ravel()
    assert where["from_receiver_m"].to_numpy() == pytest.approx(receiver, abs=0.000501)
    nearest = cdist(at, of_rssi.train.transmitter_position.numpy()).min(axis=1)
    assert where["from_training_m"].to_numpy() == pytest.approx(nearest.repeat(2), abs=0.000501)
    table, half = rssi_said.table("predictions"), norm.ppf(0.9) * np.where(ERROR % 2, 10, 60)
    for name, expected in (("low", -half), ("high", half), ("predicted", 0)):
        assert table[name].to_numpy() == pytest.approx(-60 + SIGN * ERROR + expected, abs=0.00501)
    assert table[["x", "y", "z"]].to_numpy() == pytest.approx(at.repeat(2, axis=0), abs=0.000501)


def test_locating_sentences(of_locating, locate_said):
    run = locate_said
    found, sure, compared = locate_page.conclusion(run)
    assert said_of(found) == [4.95, 90, 8.9]
    low, high = bounds(lambda rows: np.median(ERROR[rows] / 10, axis=-1))
    assert said_of(sure) == [95, near(low, high - low), near(high, high - low), 51, 80, 100, 40, 12]
    best = min(("knn", "knn_difference", "mean"), key=lambda name: np.median(LOCATE_ERRORS[name]))
    assert said_of(compared) == difference_of(ERROR / 10, LOCATE_ERRORS[best])
    answer, names = locate_page.answer(run), ("knn", "knn_difference", "mean")
    cells = {one.name: [said_of(cell) for cell in one.cells.values()] for one in answer.methods}
    height = np.array([0.8 * LOCATE_ERRORS[name] for name in LOCATE_ERRORS])
    right = {name: 100 * (own < 2.05).mean() for name, own in zip(LOCATE_ERRORS, height, strict=True)}
    assert cells.pop("posterior") == [[2.97], [pytest.approx(right["posterior"])], []]
    for name in names:
        plan = pytest.approx(0.6 * np.median(LOCATE_ERRORS[name]), abs=0.00501)
        assert cells[name] == [[plan], [pytest.approx(right[name])], difference_of(ERROR / 10, LOCATE_ERRORS[name])]
    assert [80, 51] in [said_of(step.text) for step in answer.next_steps]
    overview = locate_page._summary(run)
    fewest = min(("knn", "knn_difference"), key=lambda name: np.median(LOCATE_ERRORS[name]))
    assert [one.value for one in overview.numbers] == ["4.95 m", f"{np.median(LOCATE_ERRORS[fewest]):.2f} m", "51%"]


def wilson(share, n):
    """Return the 95 % interval of a share of n independent values (E. B. Wilson, JASA 22, 1927)."""
    z = norm.ppf(0.975)
    half = z * math.sqrt(share * (1 - share) / n + z**2 / (4 * n**2))
    return [(share + z**2 / (2 * n) + sign * half) / (1 + z**2 / n) for sign in (-1, 1)]


def test_credible_regions(of_locating, locate_said):
    table = locate_page._calibration(locate_said).data
    assert table[["nominal", "measured"]].to_numpy().tolist() == [[0.5, 0.21], [0.8, 0.51], [0.95, 0.91]]
    for share, ends in zip(table["measured"], table[["low", "high"]].to_numpy().tolist(), strict=True):
        assert ends == pytest.approx(wilson(round(25 * share) / 25, 25))
    maps = locate_said.arrays("maps")
    assert maps["radius_80_m"].tolist() == [4.0] * 6
    assert maps["index"].tolist() == [99, 79, 59, 40, 20, 0]  # from the smallest error to the largest
    drawn = [panel.axes[0] for panel in locate_page.posteriors(maps)]
    assert [ax.patches[0].get_radius() for ax in drawn] == [4.0] * 6
    away = np.linalg.norm(of_locating.split.test.transmitter_position.numpy()[maps["index"]], axis=1)
    assert [said_of(ax.get_title())[1] for ax in drawn] == pytest.approx(away, abs=0.00501)  # estimates are at zero
    posterior = Rings().locate([0])
    shown = Located.of(posterior, torch.tensor([3.0, 4.0, 0.0]))
    assert said_of(shown.describe())[3:] == [50, 2.5, 80, 4.0, 5.0]
    circle = posterior.plot().get_lines()[-1].get_xydata()
    assert np.hypot(*circle.T) == pytest.approx(4.0, abs=0.01)
    assert posterior.std[0].tolist() == pytest.approx([np.arange(-50, 51).std() / 10, 0, 0])


def test_direction_sentences(of_angles, angles_said):
    own, alone = METHODS["network, measured + synthetic (gp)"], METHODS["network, measured"]
    found, sure, compared = aoa_page.conclusion(angles_said)
    assert said_of(found) == pytest.approx([np.median(own), 90, 4.5], abs=0.00501)
    low, high = bounds(lambda rows: np.median(own[rows], axis=-1))
    assert said_of(sure)[:6] == [95, near(low, high - low), near(high, high - low), 100, 30, 60]
    changes = [*change_of(own, alone), *change_of(own, THIRD / 20)]
    assert said_of(compared) == [*changes, 3.0]
    assert ("a gain" in compared, "a loss" in compared) == (True, False)
    cells = {one.name: one.cells for one in aoa_page.answer(angles_said).methods}
    assert [float(cells["peak"][name]) for name in ("azimuth [deg]", "elevation [deg]")] == pytest.approx([0, 3.0])
    assert said_of(cells["network, measured + synthetic (gp)"]["by synthetic spectra"]) == changes[:3]
    table = of_angles.summary().loc["network, measured + synthetic (gp)", ["change", "change_low", "change_high"]]
    assert table.tolist() == changes[:3]
    (rows,) = (table.rows for table in locating_section(angles_said).tables)
    low, high = bounds(lambda rows: np.median(ERROR[rows] / 10, axis=-1))
    inside = round(100 * (ERROR / 120 < 0.8).mean())
    expected = [[4.9], [near(low, high - low)], [near(high, high - low)], [8.9], [inside], [7]]
    assert [said_of(cell) for cell in rows[0][2:]] == expected[3:]
    assert said_of(rows[0][1]) == [pytest.approx(4.95, abs=0.0501), *(each[0] for each in expected[1:3])]
    (row,) = quality_table(angles_said).rows
    low, high = bounds(lambda rows: np.median(ERROR[rows] / 4, axis=-1))
    assert said_of(row[2]) == [pytest.approx(12.375, abs=0.0501), near(low, high - low), near(high, high - low)]
    squares = (ERROR / 100) ** 2
    assert [float(cell) for cell in row[3:]] == [
        pytest.approx(np.median(squares), abs=0.000501),
        pytest.approx(squares.mean(), abs=0.0000501),
        5.0,
    ]


def test_whether_synthetic_spectra_help(angles_said):
    (text,) = cross_validation_sentences(angles_said)
    assert said_of(text) == [30, -20, -35, -5, 2.0, 1.6, 300, 300]
    assert "helps here" in text
    for low, words in ((0.02, "harms"), (-0.1, "not significant")):
        rule = RULE | {"low": low, "high": 0.2}
        with mock.patch.dict(angles_said.mix["cross_validation"]["gp"], {"helps": False, "rule": rule}):
            assert words in cross_validation_sentences(angles_said)[0]


@pytest.mark.parametrize(
    ("differences", "words"),
    [
        (np.full(30, -0.5), "is lower than that of b"),
        (np.full(30, 0.5), "b has the lower mean error"),
        (np.tile([-3.0, 3.1], 15), "do not differ significantly"),
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


# ---------------------------------------------------------------------------- levels, innovations, units, geometry


@given(st.floats(0.02, 0.999))
def test_an_interval_contains_its_share_of_draws(level):
    draws = torch.from_numpy(norm.ppf((np.arange(10_000) + 0.5) / 10_000) * 3 - 60)
    low, high = Prediction(torch.tensor([-60.0]), torch.tensor([3.0])).interval(level)
    assert float(((draws >= low) & (draws <= high)).double().mean()) == pytest.approx(level, abs=0.002)


def test_a_lone_place_has_the_range_of_its_errors():
    found = summary([1.0, 2.0, 5.0], [0, 0, 0])
    assert (found["low"], found["high"]) == (1, 5)


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
    angle = 2 * math.pi * (torch.arange(100.0, dtype=torch.float64) / 100) ** 2
    known = torch.stack([10 * angle.cos(), 10 * angle.sin(), torch.zeros(100)], dim=1)
    away = cdist(known, known)
    spacing = np.quantile(np.sort(away, axis=1)[:, 8], 0.95)
    reached = cdist(sample_positions(known, 3000, 0).numpy(), known).min(axis=1).max()
    assert 0.9 * spacing < reached <= spacing


def test_the_near_field_begins_at_30_centimetres():
    at = torch.tensor([[0.1, 0, 0], [0.3, 0, 0], [0.5, 0, 0], [2.0, 0, 0]])
    assert log_distance(at, torch.zeros(1, 3))[:, 0].tolist() == pytest.approx(np.log10([0.3, 0.3, 0.5, 2.0]).tolist())
