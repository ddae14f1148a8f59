"""One answer in whatever frame data come: about another origin, with offsets, other floors, receivers in another order.

Every public function that takes data is in a table below.
"""

import importlib
import inspect
import pkgutil
import re
from dataclasses import replace
from functools import cache
from pathlib import Path
from unittest import mock

import numpy as np
import pandas as pd
import pytest
import torch
from rooms import floor_channels
from small import COARSE, FLOOR

import augment
import swiftwrf
from augment.estimators import Estimator, make_estimator
from augment.estimators.subspace import Music
from augment.suggest import suggest_scans
from augment.testing import check_estimator
from swiftwrf import (
    FieldModel,
    GeometryModel,
    InputError,
    MatchedField,
    PairModel,
    Rssi,
    RssiLocator,
    RssiModel,
    Snapshots,
    locate,
    make_model,
    predict,
    rssi,
)
from swiftwrf.contrib.comparison import rssi as comparison
from swiftwrf.contrib.comparison.predictors import make_predictor
from swiftwrf.contrib.online import Follower, Monitor, adapted, prequential, score
from swiftwrf.contrib.survey.plan import CoveragePlan, plan_coverage
from swiftwrf.data.coordinates import Floors, GeodeticOrigin
from swiftwrf.rssi import FloorAttenuation, estimate_floor_attenuation, estimate_offsets
from swiftwrf.rssi.base import RssiPredictor
from swiftwrf.rssi.coverage import Coverage
from swiftwrf.rssi.maps import RssiMap
from swiftwrf.rssi.pairs import PairPredictor
from swiftwrf.testing import check_field_model, check_predictor

HERE = GeodeticOrigin(48.0, 11.0)
RECEIVERS = {"hall": (2.0, 2.0, 1.0), "office": (18.0, 9.0, 1.0), "attic": (10.0, 3.0, 4.0), "lab": (4.0, 10.0, 1.0)}
PHONE_DB = {"new": 0.0, "old": -8.0}
N_TRAIN, N = 70, 90
pytestmark = pytest.mark.usefixtures("without_furniture")


@cache
def survey():
    """RSSI of two phones on two floors, about an origin in degrees."""
    draw = np.random.default_rng(0)
    floor, phone = draw.integers(0, 2, N), draw.choice(list(PHONE_DB), N)
    at = np.column_stack([draw.uniform((0, 0), (20, 12), (N, 2)), 3.0 * floor + 1])
    latitude, longitude = HERE.to_degrees(at[:, :2]).T
    table = pd.DataFrame({"latitude": latitude, "longitude": longitude, "z": at[:, 2], "floor": floor, "phone": phone})
    for name, place in RECEIVERS.items():
        loss = 22 * np.log10(np.linalg.norm(at - place, axis=1)) + 12 * np.abs(floor - (place[2] > 3))
        table[name] = -40 - loss + draw.normal(0, 2, N) + [PHONE_DB[name] for name in phone]
    data = Rssi.from_frame(table, offset_by="phone")
    place = Rssi(torch.zeros(4, 4), [*RECEIVERS.values()], origin=HERE).about(data.origin).transmitter_position
    return replace(data, receiver_position=place)


@cache
def offsets():
    return estimate_offsets(survey()[:N_TRAIN], "new")


def training_rows():
    return offsets().removed(survey()[:N_TRAIN])


def new_rows():
    return offsets().removed(survey()[N_TRAIN:])


def raised(floors):
    return Floors(floors.names, tuple(z + 0.4 for z in floors.height_m))


CHANGES = {
    "nothing": lambda data: data,
    "origin": lambda data: data.about(GeodeticOrigin(48.0002, 11.0003)),
    "offsets": lambda data: data.as_measured(),
    "no floors": lambda data: replace(data, floors=None),
    "heights of floors": lambda data: replace(data, floors=raised(data.floors)),
    "order": lambda data: data.columns([2, 0, 3, 1]),
}


@cache
def model():
    return RssiModel().fit(training_rows())


@cache
def pairs():
    return PairModel(new_places=False).fit(training_rows())


@cache
def knn():
    return make_predictor("knn").fit(training_rows())


@cache
def locator():
    return RssiLocator(n_cells=300).fit(training_rows(), model=model())


def by_name(prediction):
    """Return the means and deviations with the receivers in one order."""
    names = prediction.receiver_names or tuple(RECEIVERS)
    return torch.cat([x for x in (prediction.mean, prediction.std) if x is not None])[
        :, [names.index(name) for name in RECEIVERS]
    ]


def at_places(predictor):
    return by_name(predictor.predict(new_rows().about(predictor.origin).transmitter_position))


def followed(data):
    follower = Follower(model())
    steps = [follower.step(data[[row]]) for row in range(5)]
    return torch.cat([torch.cat([step.scores.innovation for step in steps]), at_places(follower.model)])


def learnt_in_parts(data):
    scores, updated = prequential(model(), data, batch=8)
    return torch.cat([scores.innovation, at_places(updated)])


def numbers(table):
    return torch.tensor(table.select_dtypes("number").to_numpy(dtype=float))


def errors_of_two_methods(data):
    with mock.patch.object(comparison, "compared", return_value=(["swiftwrf", "mean"], {})):
        return numbers(rssi.compare(data, reference="new").summary().loc[["swiftwrf", "mean"], ["median", "mean"]])


def located(data):
    names = ["posterior", "mean"]
    return numbers(locate.compare(data, n_cells=200, reference="new").summary().loc[names, ["median", "mean"]])


def located_by_new(data):
    """Return where a locator of these rows locates rows of the reference phone."""
    own = RssiLocator(n_cells=300).fit(data, model=model())
    return own.locate(new_rows().columns([list(RECEIVERS).index(name) for name in own.receiver_names]).rssi_dbm).median


def covered(data):
    """Return the fraction of cells that rows of a map determine, and of rows above a threshold."""
    upper = data[data.transmitter_position[:, 2] > 3]
    chart = RssiMap.predict(model(), detected=True, height=4.0)
    values = Coverage.of(chart, upper, (-75.0, 0.9, 1), 3.0).values
    return torch.tensor([values["not_measured"], values["scans_above"]])


def positions_of_hidden(data):
    """Return estimated positions of receivers that the data do not state, less the mean of the rows, and their radii."""
    hidden = data.derived(receiver_position=torch.full_like(data.receiver_position, torch.nan))
    found = rssi.locate_receivers(hidden)
    at = found.position - data.transmitter_position.mean(dim=0)
    return torch.cat([at[:, :2], found.radius_m[:, None]], dim=1)


def middle(data):
    return data.transmitter_position.mean(dim=0, keepdim=True)


# a fit estimates neither offsets nor, without their names, floors: there these are other data
FIT = ("nothing", "origin", "heights of floors", "order")
OF_RSSI = {
    RssiPredictor.aligned: (new_rows, lambda data: model().aligned(data).rssi_dbm, tuple(CHANGES)),
    RssiPredictor.update: (new_rows, lambda data: at_places(model().update(data)), tuple(CHANGES)),
    RssiModel.predict_detected: (new_rows, lambda data: by_name(model().predict_detected(data)), tuple(CHANGES)),
    RssiPredictor.predict_detected: (new_rows, lambda data: by_name(knn().predict_detected(data)), tuple(CHANGES)),
    RssiPredictor.predict_detection: (new_rows, lambda data: model().predict_detection(data), tuple(CHANGES)),
    PairPredictor.predict_detected: (new_rows, lambda data: by_name(pairs().predict_detected(data)), tuple(CHANGES)),
    RssiPredictor.fit: (training_rows, lambda data: at_places(PairModel(new_places=False).fit(data)), FIT),
    swiftwrf.fit_rssi: (training_rows, lambda data: at_places(swiftwrf.fit_rssi(data)), FIT),
    RssiLocator.fit: (training_rows, located_by_new, tuple(CHANGES)),
    predict: (new_rows, lambda data: numbers(predict(locator(), data)), tuple(CHANGES)),
    score: (new_rows, lambda data: score(model(), data).innovation, tuple(CHANGES)),
    prequential: (new_rows, learnt_in_parts, tuple(CHANGES)),
    Follower.step: (new_rows, followed, tuple(CHANGES)),
    Follower: (training_rows, lambda data: Follower(model(), data).monitor.centre, tuple(CHANGES)),
    Monitor.of: (training_rows, lambda data: Monitor.of(model(), data).centre, tuple(CHANGES)),
    rssi.compare: (lambda: offsets().removed(survey()), errors_of_two_methods, ("nothing", "offsets", "order")),
    locate.compare: (lambda: offsets().removed(survey()), located, ("nothing", "offsets", "order")),
    estimate_offsets: (
        training_rows,
        lambda data: torch.tensor([*estimate_offsets(data, "new").offset_db.values()]),
        tuple(CHANGES),
    ),
    Coverage.of: (new_rows, covered, (*FIT, "no floors")),
    estimate_floor_attenuation: (
        training_rows,
        lambda data: torch.tensor([estimate_floor_attenuation(data).db]),
        FIT,
    ),
    rssi.locate_receivers: (training_rows, positions_of_hidden, ("nothing", "origin", "heights of floors")),
    plan_coverage: (
        new_rows,
        lambda data: plan_coverage(model(), data, above_dbm=-70.0, candidates=middle(data)).after.mean(dim=1),
        ("nothing", "order"),
    ),
    suggest_scans: (
        new_rows,
        lambda data: suggest_scans(model(), data, 2, -70.0).variance,
        ("nothing", "origin", "order"),
    ),
    swiftwrf.inspect: (
        survey,
        lambda data: torch.tensor(
            [swiftwrf.inspect(data).numbers[f"law_{name}"] for name in ("explained", "exponent")]
        ),
        FIT,
    ),
}
NAMES = [(function, change) for function, (_, _, changes) in OF_RSSI.items() for change in changes[1:]]


@cache
def expected(function):
    data, answer, _ = OF_RSSI[function]
    return answer(data())


@pytest.mark.parametrize(("function", "change"), NAMES, ids=lambda x: getattr(x, "__qualname__", x))
def test_rssi_in_any_frame_has_one_answer(short_fits, function, change):
    data, answer, _ = OF_RSSI[function]
    found = answer(CHANGES[change](data()))
    assert len(found)
    torch.testing.assert_close(found, expected(function), rtol=1e-3, atol=2e-2, equal_nan=True)


def other_floors(**values):
    return replace(new_rows(), floors=replace(new_rows().floors, **values))


OTHER_FRAMES = {
    "other floors": (
        lambda: other_floors(names=("5", "6")),
        r"rows on floor .*6 at heights of other floors .* \(0, 1\)",
    ),
    "other heights": (lambda: other_floors(height_m=(4.0, 7.0)), "rows on floor 0 at heights of other floors"),
    "metres": (
        lambda: replace(new_rows(), origin=None),
        "has positions in metres, but the predictor was fitted to degrees",
    ),
    "far away": (
        lambda: new_rows().derived(transmitter_position=new_rows().transmitter_position + torch.tensor([0.0, 0, 400])),
        r"has a position (397|400) m away from those that the model was fitted to, which extend over 23 m",
    ),
}


@pytest.mark.parametrize(("data", "says"), OTHER_FRAMES.values(), ids=OTHER_FRAMES)
def test_rssi_in_an_unknown_frame_is_refused(short_fits, data, says):
    highest = int(data().transmitter_position[:, 2].argmax())
    uses = (model().update, lambda rows: score(model(), rows), lambda rows: Follower(model()).step(rows[[highest]]))
    for use in (*uses, model().predict_detected, lambda rows: predict(locator(), rows)):
        with pytest.raises(InputError, match=says):
            use(data().derived(floors=None) if "away" in says else data())
    assert len(predict(locator(), data(), truth=False)) == len(data())


def test_rssi_in_degrees_or_on_floors_is_refused_by_a_model_in_metres_without_floors(short_fits):
    plain = replace(training_rows(), origin=None, floors=None)
    metric = RssiModel().fit(plain)
    with pytest.raises(
        InputError, match="has positions in degrees, but the predictor was fitted to metres; give metres"
    ):
        metric.update(new_rows())
    with pytest.raises(InputError, match=r"rows on floor 0, 1 at heights of other floors .* \(none\)"):
        metric.update(replace(new_rows(), origin=None))


def test_spectra_far_away_are_refused():
    far = replace(new_channels(), position=new_channels().position + 300.0, label=None)
    with pytest.raises(InputError, match=r"has a position 5\d\d m away from those that the model was fitted to"):
        gp().update(far)


@cache
def channels():
    return replace(floor_channels(), label=None)


def new_channels():
    return channels()[30:]


def snapshots():
    data = channels()
    same = {name: getattr(data, name) for name in ("array", "fixed_position", "rotation", "frequency_hz")}
    direct = GeometryModel.of_planes(data, []).channel(data.position, data.frequency_hz)
    return Snapshots(direct, data.position, **same)


def falling(data):
    """Return the data with their subcarriers in the other order."""
    return replace(data, channel=data.channel.flip(1), frequency_hz=data.frequency_hz.flip(0))


@cache
def room():
    return GeometryModel.of_planes(channels(), [FLOOR])


@cache
def gp():
    return make_model("gp").fit(channels()[:30])


@cache
def matched_field():
    return MatchedField(**COARSE).fit(channels()[:30], room=room())


def located_by_channels(data):
    """Return where a locator of these channels locates others."""
    return MatchedField(matched_field().config).fit(data[:30], room=room()).locate(new_channels()).median


def at_new(model):
    return model.synthesize(new_channels().position)


OF_CHANNELS = {
    FieldModel.aligned: (new_channels, lambda data: gp().aligned(data).channel.abs()),
    FieldModel.fit: (channels, lambda data: at_new(GeometryModel().fit(data, like=room()))),
    FieldModel.update: (channels, lambda data: at_new(room().update(data))),
    GeometryModel.channels: (channels, lambda data: room().channels(data).value.abs()),
    GeometryModel.decided_on: (channels, lambda data: at_new(room().decided_on(data))),
    GeometryModel.furnished_on: (channels, lambda data: at_new(room().furnished_on(data))),
    GeometryModel.of_planes: (channels, lambda data: at_new(GeometryModel.of_planes(data, [FLOOR]).update(channels()))),
    MatchedField.fit: (channels, located_by_channels),
    MatchedField.locate: (new_channels, lambda data: matched_field().locate(data).median),
    MatchedField.predict: (new_channels, lambda data: matched_field().predict(data)),
    swiftwrf.fit: (channels, lambda data: at_new(swiftwrf.fit(data))),
    swiftwrf.inspect: (channels, lambda data: torch.tensor(swiftwrf.inspect(data).numbers["nearest_m"])[None]),
    swiftwrf.calibrate: (snapshots, lambda data: swiftwrf.calibrate(data).phase),
    predict: (new_channels, lambda data: numbers(predict(matched_field(), data))),
    score: (new_channels, lambda data: score(gp(), data).innovation),
    prequential: (new_channels, lambda data: prequential(gp(), data)[0].innovation),
    adapted: (new_channels, lambda data: at_new(adapted(gp(), data)[0])),
    Follower: (channels, lambda data: Follower(gp(), data[:30]).monitor.reference),
    Follower.step: (new_channels, lambda data: Follower(gp()).step(data[:1]).scores.innovation),
    Monitor.of: (channels, lambda data: Monitor.of(gp(), data[:30]).reference),
    Estimator.estimate: (
        channels,
        lambda data: make_estimator("peak").fit(augment.Mixed.measured(data)).estimate(data),
    ),
    Music.estimate: (channels, lambda data: make_estimator("music").estimate(data)),
    augment.choose_model: (channels, lambda data: torch.tensor([*augment.choose_model(data, ["gp"]).psnr_db.values()])),
    augment.turbo_learning: (
        channels,
        lambda data: numbers(augment.turbo_learning(data, models=["idw"], estimators=["music"], extra=0).summary()),
    ),
    augment.suggest: (channels, lambda data: augment.suggest(data, 3).position),
}
# they hold or return rows as these are given, positions, or whether data have what a model needs
OF_NO_FRAME = {
    CoveragePlan,
    swiftwrf.Stations,
    augment.choose.Fold,
    rssi.RssiComparison,
    locate.LocateComparison,
    locate.LocateComparison.of,
    FloorAttenuation.removed,
    augment.mix,
    augment.withhold,
    augment.synthetic_positions,
    augment.Mixed.measured,
    Rssi.validation_for,
    check_field_model,
    check_predictor,
    check_estimator,
    *(kind.lacking for kind in (FieldModel, RssiPredictor, PairPredictor, Estimator, Music)),
    *(kind.compared for kind in (RssiPredictor, PairPredictor)),
}


@pytest.mark.parametrize("function", OF_CHANNELS, ids=lambda function: function.__qualname__)
def test_channels_in_any_order_of_subcarriers_have_one_answer(short_fits, function):
    data, answer = OF_CHANNELS[function]
    expected = answer(data())
    assert len(expected)
    torch.testing.assert_close(answer(falling(data())), expected, rtol=1e-3, atol=1e-3, equal_nan=True)


def plain(function):
    return inspect.unwrap(getattr(function, "__func__", function))


def takes_data(function):
    """Return whether an argument is spectra, snapshots or RSSI, alone or among others."""
    called = plain(function.__init__ if inspect.isclass(function) else function)
    kinds = [str(hint) for name, hint in getattr(called, "__annotations__", {}).items() if name != "return"]
    return any(re.search(r"\b(Rssi|Spectra|Snapshots)\b", kind) for kind in kinds)


def public_functions():
    """Return functions, classes and methods of docs/api.md and of packages' __all__ that take data."""
    packages = (
        "swiftwrf",
        "swiftwrf.rssi",
        "swiftwrf.locate",
        "swiftwrf.contrib.online",
        "augment",
        "augment.estimators",
    )
    names = re.findall(r"^::: (\S+)", (Path(__file__).parents[2] / "docs" / "api.md").read_text(), re.MULTILINE)
    names += [f"{package}.{name}" for package in packages for name in importlib.import_module(package).__all__]
    values = [pkgutil.resolve_name(name) for name in names]
    classes = [value for value in values if inspect.isclass(value)]
    methods = [getattr(kind, name) for kind in classes for name in dir(kind) if not name.startswith("_")]
    functions = [value for value in (*values, *methods) if inspect.isroutine(value) or inspect.isclass(value)]
    return {plain(function) for function in functions if takes_data(function)}


def test_a_plan_about_another_origin_is_refused():
    other = CHANGES["origin"](new_rows())
    with pytest.raises(InputError, match=r"give survey.about\(model.origin\)"):
        plan_coverage(model(), other)
    plan_coverage(model(), other.about(model().origin), candidates=middle(new_rows()))


def test_every_public_function_that_takes_data_is_tested():
    tested = {plain(function) for function in (*OF_RSSI, *OF_CHANNELS, *OF_NO_FRAME)}
    missing = {f"{function.__module__}.{function.__qualname__}" for function in public_functions() - tested}
    assert not missing
