"""The angle-of-arrival task: estimators, one whole run, its refusals, its resumption."""

import json
from dataclasses import replace
from types import SimpleNamespace
from unittest import mock

import numpy as np
import pandas as pd
import pytest
import quick
import torch
from quick import sketched
from samples import install
from sklearn.model_selection import KFold
from small import FIT, with_defaults

from augment import Mixed, choose, cross_validation, turbo_learning
from augment.choices import fraction_key
from augment.estimators import ESTIMATORS, kernel_regression, make_estimator
from augment.estimators.aann import AANN, AANNConfig
from augment.estimators.aann_kernel import AANNKernel, AANNKernelConfig
from augment.estimators.baselines import Constant, NearestSpectrum, Peak
from augment.estimators.kernel_regression import KernelRegression
from augment.turbo import experiment as context
from augment.turbo.condition import Condition, conditions_of, headline
from augment.turbo.experiment import Experiment
from swiftwrf import AngularGrid, FitError, InputError, MatchedField, load, load_spectra, make_model, simulated_room
from swiftwrf.contrib.comparison.steps import Memo
from swiftwrf.data.store import Store
from swiftwrf.data.writing import write_spectra
from swiftwrf.metrics import angle_errors
from swiftwrf.models import FIELD_MODELS
from swiftwrf.models.geometry import model as geometry
from tasks.aoa import experiment
from tasks.aoa.records import palette
from tasks.labels import colour


@pytest.fixture
def small(monkeypatch):
    """The task on a toy: few spectra, few steps."""
    room = simulated_room(n=50, grid=AngularGrid.hemisphere(10, 40))
    monkeypatch.setattr(experiment, "simulated_room", lambda **_: room)
    monkeypatch.setattr(FIELD_MODELS["swiftwrf"], "config_type", with_defaults(FIT))
    for place in (context, choose):  # the search for a room has its own tests
        monkeypatch.setattr(
            place,
            "candidates",
            lambda data: [name for name in ("idw", "gp", "coarray") if not FIELD_MODELS[name].lacking(data)],
        )
    for config in (AANNConfig, AANNKernelConfig):
        monkeypatch.setattr(config, "quick", lambda n_spectra, **options: AANNKernelConfig(steps=2, batch=4, **options))
    with sketched():
        yield room


def run(*arguments):
    if arguments[:1] == ("--mix",) and "--extra" not in arguments:
        arguments = (*arguments, "--extra", 0)
    return quick.command("aoa", *arguments)


def labelled(spectrum, label, grid):
    """Return a training set of these spectra."""
    n = len(spectrum)
    return Mixed((Store(spectrum),), label, torch.arange(n), torch.zeros(n).bool(), grid)


def test_peak_of_a_known_spectrum():
    grid = AngularGrid.hemisphere(10, 40)
    spectrum = torch.zeros(1, 10, 40)
    spectrum[0, 3, 10] = 1
    peak = Peak().fit(labelled(spectrum, torch.zeros(1, 2), grid))
    assert peak.predict(spectrum).rad2deg()[0].tolist() == pytest.approx([90, 36])


def test_constant_is_the_mean_direction_over_the_seam():
    label = torch.tensor([[350.0, 10], [10, 10]]).deg2rad()
    constant = Constant().fit(labelled(torch.zeros(2, 10, 40), label, AngularGrid.hemisphere(10, 40)))
    azimuth = constant.predict(torch.zeros(3, 10, 40))[:, 0]
    assert (1 - torch.cos(azimuth)).max() < 1e-9


def test_nearest_spectrum_distinguishes_spectra_that_differ_in_their_last_digits(room):
    """Inner products of float32 spectra lose these digits."""
    generator = torch.Generator().manual_seed(0)
    base = torch.rand(15, 60, generator=generator)
    close = base + 1e-6 * torch.randn(30, 15, 60, generator=generator)
    train = labelled(close, room.label[:30], room.grid)
    query = close[torch.randperm(30, generator=generator)] + 1e-8
    distance = (query.double()[:, None] - close.double()).square().sum(dim=(2, 3))
    assert torch.equal(NearestSpectrum().fit(train).predict(query), room.label[distance.argmin(dim=1)])


def test_nearest_spectrum_comes_back_from_its_file_with_half_the_digits(room, tmp_path):
    train, test = room.split("random", 0)
    estimator = NearestSpectrum().fit(Mixed.measured(train))
    estimator.save(tmp_path / "nearest.safetensors")
    again = load(tmp_path / "nearest.safetensors")
    assert torch.equal(again.predict(train.spectrum), train.label)
    distance = (test.spectrum[:, None] - train.spectrum.half().float()).square().sum(dim=(2, 3))
    assert torch.equal(again.predict(test.spectrum), train.label[distance.argmin(dim=1)])


def test_kernel_regression_reads_only_the_spectra_that_it_keeps(room, monkeypatch):
    monkeypatch.setattr(kernel_regression, "MAX_ROWS", 12)
    train, read = Mixed.measured(room), []
    select = Mixed.select
    monkeypatch.setattr(Mixed, "batches", lambda self: pytest.fail("all spectra were read"))
    monkeypatch.setattr(Mixed, "select", lambda self, rows: read.append(len(rows)) or select(self, rows))
    KernelRegression(seed=3).fit(train)
    assert sum(read) == 12


@pytest.mark.long
def test_aann_learns_a_toy():
    """Four directions, four patterns: a network that cannot distinguish them keeps the error of a constant."""
    label = torch.tensor([[0.0, 30], [90, 30], [180, 30], [270, 60]]).deg2rad().repeat(4, 1).double()
    spectrum = torch.zeros(16, 16, 64)
    for i in range(16):
        spectrum[i, 4:10, 16 * (i % 4) : 16 * (i % 4) + 8] = 1
    train = labelled(spectrum, label, AngularGrid.hemisphere(16, 64))
    network = AANN(steps=20, batch=8, rate=1e-3, max_azimuths=0).fit(train)
    constant = Constant().fit(train)
    errors = [angle_errors(e.predict(spectrum), label)["great_circle"].mean() for e in (network, constant)]
    assert errors[0] < 0.5 * errors[1]


def test_every_spectrum_counts_alike_in_the_batch_norms():
    """65: in parts of 64 the last one would be a single spectrum, which a network of one pixel cannot normalise."""
    spectrum = torch.rand(65, 8, 32, generator=torch.Generator().manual_seed(0))
    spectrum[-20:] *= 0.1
    label = torch.stack([torch.linspace(0, 3, 65), torch.full((65,), 0.5)], dim=1).double()
    network = AANN(steps=2, batch=4).fit(labelled(spectrum, label, AngularGrid.hemisphere(8, 32)))
    first = network._network.conv1(network._prepare(spectrum))
    spread = first.std(dim=(0, 2, 3))
    found, expected = network._network.bn1.running_mean / spread, first.mean(dim=(0, 2, 3)) / spread
    torch.testing.assert_close(found, expected, atol=0.02, rtol=0)


def test_the_headline_is_of_the_network_that_is_kept():
    """Named by its training set, not by its error on test spectra."""
    conditions = [
        Condition("aann_kernel", "measured"),
        Condition("aann_kernel", "measured + synthetic", "gp"),
        Condition("kernel_regression", "measured + synthetic + extra", "gp"),
        Condition("aann_kernel", "measured + synthetic + extra", "gp"),
        Condition("aann_kernel", "measured + synthetic + extra", "idw"),
        Condition("aann_kernel", "all measured"),
    ]
    assert headline(conditions).method == "network, measured + synthetic + extra (gp)"
    assert (
        headline([conditions[1], Condition("aann_kernel", "measured + synthetic", "idw"), conditions[2]]).method
        == "network, measured + synthetic (gp)"
    )


@pytest.mark.parametrize(
    ("condition", "method"),
    [
        (Condition("aann_kernel", "measured"), "network, measured"),
        (Condition("aann_kernel", "measured + synthetic", "auto"), "network, measured + synthetic (auto)"),
        (Condition("peak", "measured"), "peak"),
        (
            Condition("kernel_regression", "measured + synthetic + extra", "gp"),
            "kernel_regression, measured + synthetic + extra (gp)",
        ),
    ],
)
def test_names_of_conditions_are_those_of_metrics_json(condition, method):
    assert condition.method == method
    assert conditions_of({method: condition.description}) == {method: condition}


def test_keys_of_fractions_are_exact():
    fractions = [0.3, 1.0, 0.1, 0.6666667, 0.66666671, 1 / 3, 0.33333334, 1e-5, 0.30000001]
    keys = [fraction_key(fraction) for fraction in fractions]
    assert [float(key) for key in keys] == fractions
    assert len(set(keys)) == len(keys)
    assert keys[:3] == ["0.3", "1", "0.1"]


def test_kernel_regression_is_what_its_definition_says():
    """The chosen width and penalty have the least error on held-out rows, each row's value found by plain inversion."""
    generator = np.random.default_rng(0)
    feature, target = generator.normal(size=(60, 2)), generator.normal(size=(60, 3))
    target[:, 0] += 5 * feature[:, 0]
    apart = np.square(feature[:, None] - feature[None]).sum(axis=-1)

    def normalised(squared, gamma):
        kernel = np.exp(-gamma * squared)
        return kernel / kernel.sum(axis=1, keepdims=True)

    def told(kept, out, gamma, alpha):
        own = normalised(apart[np.ix_(kept, kept)], gamma) + alpha * np.eye(len(kept))
        return normalised(apart[np.ix_(out, kept)], gamma) @ np.linalg.inv(own) @ target[kept] * (1 + alpha)

    median = np.median(apart[~np.eye(60, dtype=bool)])
    folds = list(KFold(5, shuffle=True, random_state=3).split(feature))
    errors = {
        (width / median, alpha): sum(
            np.abs(told(*fold, width / median, alpha) - target[fold[1]]).mean() for fold in folds
        )
        for width in kernel_regression.WIDTH_CANDIDATES
        for alpha in kernel_regression.PENALTY_CANDIDATES
    }
    best = min(errors, key=errors.get)
    assert kernel_regression.choose(apart, target, seed=3) == pytest.approx(best)
    rows, new = np.arange(50), np.arange(50, 60)
    gamma, alpha = kernel_regression.choose(apart[:50, :50], target[:50], seed=3)
    found = kernel_regression.NadarayaWatson.fit(feature[:50], target[:50], seed=3)(feature[50:])
    np.testing.assert_allclose(found, told(rows, new, gamma, alpha), rtol=1e-8)


def test_what_all_distances_have_in_common_does_not_move_an_estimate():
    """Noise adds a constant to all distances of a measured spectrum; synthetic ones have none."""
    generator = np.random.default_rng(0)
    feature, new = generator.normal(size=(40, 3)), generator.normal(size=(5, 3))
    regression = kernel_regression.NadarayaWatson.fit(np.c_[feature, np.zeros(40)], feature, seed=0)
    clean, noisy = (regression(np.c_[new, np.full(5, beside)]) for beside in (0, 100))
    np.testing.assert_allclose(noisy, clean, rtol=1e-8)
    assert np.abs(clean - new).mean() < 0.5 * np.abs(new).mean()


def test_pointwise_convolutions_are_matrix_products():
    """Both agree in value and gradient for equal weights."""
    from augment.estimators.resnet import Pointwise, backbone

    spectrum = torch.rand(4, 1, 9, 40, dtype=torch.float64)
    found = {}
    for products in (False, True):
        torch.manual_seed(0)
        network = backbone(products).double()
        torch.nn.init.normal_(network.fc[2].weight)
        x = spectrum.clone().requires_grad_()
        value = network(x)
        gradient = torch.autograd.grad(value.square().sum(), [x, *network.parameters()])
        found[products] = network, value, gradient
    (definition, *expected), (network, *actual) = found[False], found[True]
    assert sum(isinstance(m, Pointwise) for m in network.modules()) == 36
    torch.testing.assert_close(actual, expected, rtol=1e-5, atol=1e-7)
    assert list(network.state_dict()) == list(definition.state_dict())


@pytest.mark.parametrize("stride", [1, 2])
@pytest.mark.parametrize("size", [(1, 1), (1, 4), (2, 2), (2, 8), (3, 5), (4, 1)])
def test_convolutions_over_few_pixels_are_matrix_products(size, stride):
    """The convolution, in value and gradient, whatever rows of the kernel meet nothing but padding."""
    from augment.estimators.resnet import Neighbours

    definition = torch.nn.Conv2d(64, 64, 3, stride, padding=1, bias=False).double()
    product = Neighbours(definition)
    x = torch.rand(2, 64, *size, dtype=torch.float64, requires_grad=True)
    with mock.patch.object(torch.nn.functional, "conv2d") as convolution:
        actual = product(x)
    convolution.assert_not_called()
    expected = definition(x)
    wanted = [torch.autograd.grad(value.square().sum(), [x, definition.weight]) for value in (actual, expected)]
    torch.testing.assert_close([actual, *wanted[0]], [expected, *wanted[1]])


@pytest.mark.parametrize(("spectra", "batch", "sizes"), [(11, 64, [5, 5, 5]), (11, 4, [4, 4, 4]), (3, 64, [1, 1, 1])])
def test_batches_are_at_most_half_of_what_trains(room, monkeypatch, spectra, batch, sizes):
    found = []
    monkeypatch.setattr(AANN, "_train", lambda self, batches, *_: found.extend(batches) or [])
    AANN(steps=3, batch=batch).fit(Mixed.measured(room.subset(torch.arange(spectra))))
    assert [len(rows) for rows in found] == sizes
    assert not torch.equal(found[0], found[1])


@pytest.mark.long
def test_kernel_regression_on_the_features_is_better_than_the_head_after_a_short_training():
    """On spectra that neither has seen."""
    room = simulated_room(n=200, grid=AngularGrid.hemisphere(10, 40))
    train, test = room.split("random")
    network = AANNKernel(steps=5).fit(Mixed.measured(train))
    estimates = (network.predict(test.spectrum), AANN.predict(network, test.spectrum))
    kernel, head = (angle_errors(estimate, test.label)["great_circle"].median() for estimate in estimates)
    assert kernel < 0.5 * head


def test_the_estimate_of_the_network_is_that_of_its_head(room):
    """The direction of a changed head changes alike: no other regression stands between."""
    train = Mixed.measured(room)
    network = AANN(steps=2, batch=4).fit(train)
    head = network._network.fc[2]
    with torch.no_grad():
        head.weight.zero_()
        head.bias.copy_(torch.tensor([0.0, 0.0, 100.0]))
    upwards = network.predict(room.spectrum)[:, 1].rad2deg()
    assert (upwards > 85).all()


@pytest.mark.parametrize("value", [0.0, 0.5])
def test_spectra_that_are_all_alike_are_in_the_mean_direction(value):
    label = torch.tensor([[0.0, 30], [90, 30]]).deg2rad().repeat(6, 1).double()
    alike = torch.full((12, 8, 32), value)
    train = labelled(alike, label, AngularGrid.hemisphere(8, 32))
    estimators = (AANN(steps=2, batch=4), AANNKernel(steps=2, batch=4), Constant())
    *networks, constant = (estimator.fit(train).predict(alike[:1]) for estimator in estimators)
    for network in networks:
        torch.testing.assert_close(network, constant, atol=0.05, rtol=0)


@pytest.mark.parametrize("kind", [AANN, AANNKernel])
def test_networks_are_seeded_and_leave_the_global_generator_alone(room, kind):
    state = torch.get_rng_state()
    train = Mixed.measured(room)
    estimates = [kind(seed=7, steps=2, batch=4).fit(train).predict(room.spectrum) for _ in range(2)]
    assert torch.equal(*estimates)
    assert torch.equal(torch.get_rng_state(), state)


def pretended(monkeypatch, room, errors, repeats=1):
    """Return the cross-validation for four folds with these errors by fold and number of synthetic positions.

    `repeats` consecutive spectra of a fold are at one place.
    """
    monkeypatch.setattr(cross_validation, "held_out_errors", lambda fold, number, seed: errors(fold.number, number))
    model, folds = make_model("idw").fit(room), []
    for fold in range(4):
        position = torch.full((len(errors(fold, 0)), 3), float(fold))
        position[:, 0] = torch.arange(len(position)) // repeats
        folds.append(SimpleNamespace(model=model, number=fold, test=SimpleNamespace(position=position)))
    return cross_validation.cross_validate(folds, n_synthetic=3000, seed=0)


@pytest.mark.parametrize(
    ("factors", "recommended"),
    [((0.9, 0.8, 0.5), 3000), ((0.9, 1.1, 0.5), 0), ((0.9, 0.5, 0.8), 1000), ((1.2, 1.1, 1.3), 0)],
)
def test_further_positions_are_recommended_if_each_number_of_them_gains(monkeypatch, room, factors, recommended):
    """With few held-out spectra one number alone gains by chance."""
    factor = dict(zip((0, *cross_validation.N_SYNTHETIC_CANDIDATES), (1, *factors), strict=True))
    given = pretended(monkeypatch, room, lambda fold, number: factor[number] * np.linspace(1, 1.01, 20))
    assert given["recommended_n_synthetic"] == recommended
    assert given["helps"] == (recommended > 0)


@pytest.mark.parametrize(("n_better", "helps"), [(19, True), (11, False)])
def test_turbo_learning_helps_if_the_whole_interval_of_the_rule_is_below_zero(monkeypatch, room, n_better, helps):
    """The median falls in both cases. Where 9 of 20 spectra lose, the interval reaches from a gain to a loss."""
    generator = np.random.default_rng(0)
    alone = [generator.uniform(1, 1.1, 20) for _ in range(4)]
    factor = np.where(np.arange(20) < n_better, 0.6, 1.5)
    given = pretended(monkeypatch, room, lambda fold, number: alone[fold] * (factor if number else 1))
    before, after = np.concatenate(alone), np.concatenate([errors * factor for errors in alone])
    rows = np.random.default_rng(9).integers(80, size=(4000, 80))
    change = np.median(after[rows], axis=1) / np.median(before[rows], axis=1) - 1
    low, high = np.quantile(change, (0.025, 0.975))
    assert low < 0
    assert (high < 0) == helps
    assert given["rule"]["low"] == pytest.approx(low, abs=0.05)
    assert given["rule"]["high"] == pytest.approx(high, abs=0.05)
    assert given["helps"] == helps
    assert given["recommended_n_synthetic"] > 0  # every number gains


def test_the_interval_of_cross_validation_is_that_of_the_rule(monkeypatch, room):
    """Errors without any gain on average: the best number of each fold is chance, and other folds do not confirm it."""
    generator = np.random.default_rng(1)
    drawn = {(fold, number): generator.uniform(0.5, 1.5, 4) for fold in range(4) for number in (0, 300, 1000, 3000)}
    given = pretended(monkeypatch, room, lambda fold, number: drawn[fold, number])
    best = {}
    for fold in range(4):
        others = [other for other in range(4) if other != fold]
        best[fold] = min((300, 1000, 3000), key=lambda n: np.median([drawn[other, n] for other in others]))
    expected = np.median([drawn[fold, number] for fold, number in best.items()])
    assert given["rule"]["median_deg"] == pytest.approx(expected)
    assert given["rule"]["median_deg"] > min(gain["median_deg"] for gain in given["gains"])


def test_held_out_spectra_of_one_place_count_once_in_the_interval_of_a_gain(monkeypatch, room):
    generator = np.random.default_rng(2)
    drawn = {fold: generator.uniform(0.5, 1.5, 10).repeat(6) for fold in range(4)}

    def errors(fold, number):
        return drawn[fold][:: -1 if number else 1]

    alone, together = (pretended(monkeypatch, room, errors, repeats) for repeats in (1, 6))
    for found, other in zip([alone["rule"], *alone["gains"]], [together["rule"], *together["gains"]], strict=True):
        assert other["high"] - other["low"] > 1.8 * (found["high"] - found["low"])


def test_a_training_is_as_long_as_the_scene_needs():
    quick = [AANNConfig.quick(n) for n in (0, 240, 780, 1525, 100_000)]
    assert [config.steps for config in quick] == [125, 125, 366, 715, 1000]
    assert {config.batch for config in quick} == {64}
    assert make_estimator("aann_kernel", 780).config.steps == AANNKernelConfig().steps < AANNConfig().steps
    assert make_estimator("aann", 780, "paper").config.steps == AANNConfig.paper().steps


def test_whole_run(small, registered, tmp_path):
    out = tmp_path / "run"
    more = ("--extra", 20, "--suggest", 4)
    assert run("--mix", 0.5, "--synthesizer", "coarray", "idw", *more, "--out", out) == 0
    metrics = json.loads((out / "metrics.json").read_text(), parse_constant=lambda name: pytest.fail(name))
    mix, turbo = metrics["mixes"]["0.5"], "network, measured + synthetic + extra (coarray)"
    methods = mix["methods"]
    synthetic = {f"measured + synthetic{more} ({name})" for name in ("coarray", "idw") for more in ("", " + extra")}
    every = {"measured", "all measured", *synthetic}
    expected = {"constant", "peak", "northern"}
    expected |= {f"network, {training}" for training in every if "synthetic (" not in training}
    expected |= {f"{name}, {training}" for name in ("nearest_spectrum", "kernel_regression") for training in every}
    assert set(methods) == expected
    assert set(mix["synthesis"]) == {"idw", "gp", "coarray"}
    assert mix["counts"]["measured + synthetic + extra (idw)"] == {"measured": 20, "withheld": 20, "extra": 20}
    assert mix["cross_validation"]["coarray"]["n_held_out"] == 16  # of 20: one fold is never scored
    assert set(mix["seconds"]) == {"fit", "synthesize", "train"}

    errors = pd.read_csv(out / "errors.csv")
    assert len(errors) == 19 * 10  # methods, test spectra
    own = errors[(errors.measured_fraction == 0.5) & (errors.method == turbo)]
    assert set(own.estimator) == {"aann_kernel"}
    assert set(own.training) == {"measured + synthetic + extra"}
    assert set(own.synthesizer) == {"coarray"}
    truth = np.degrees(small.label[own["index"].tolist()].numpy())
    np.testing.assert_allclose(own[["truth_azimuth_deg", "truth_elevation_deg"]], truth, rtol=1e-9)

    assert list((out / "figures").glob("errors-mix0.5*.svg"))
    suggested = pd.read_csv(out / "suggested-mix0.5.csv")
    assert suggested.columns.tolist() == ["x_m", "y_m", "z_m", "variance_left"]
    assert len(suggested) == 4
    assert suggested["variance_left"].is_monotonic_decreasing

    html = (out / "report.html").read_text()
    assert "Where to measure next" in html
    assert "<dt>northern</dt><dd>Always due north</dd>" in html
    assert colour(palette([Condition("northern", "measured")]), "northern") == colour({}, "northern")
    assert not [line for line in html.splitlines() if 'src="http' in line or 'href="http' in line]
    assert load(out / "coarray-mix0.5.safetensors").synthesize(small.position[:2]).shape == (2, 10, 40)
    assert not list(tmp_path.glob("*.partial"))


@pytest.fixture
def registered(monkeypatch, tmp_path):
    """An estimator of another package during a test, found by its entry point."""
    (tmp_path / "northern.py").write_text(NORTHERN)
    install(tmp_path, "swiftwrf.estimators", northern="northern:Northern")
    monkeypatch.setattr(ESTIMATORS, "_registered", dict(ESTIMATORS._registered))
    monkeypatch.syspath_prepend(tmp_path)


NORTHERN = """
import torch
from augment.estimators import Estimator


class Northern(Estimator):
    "Always due north."

    trainable = False

    def _fit(self, train, device):
        pass

    def predict(self, spectra):
        return torch.zeros(len(spectra), 2, dtype=torch.float64)
"""


def test_a_new_field_model_is_in_help_and_colours(monkeypatch, capsys):
    monkeypatch.setattr(FIELD_MODELS, "_registered", dict(FIELD_MODELS._registered))

    @FIELD_MODELS.register("dark")
    class Dark:
        """No power anywhere."""

    with pytest.raises(SystemExit):
        run("--help")
    assert "dark: No power anywhere" in " ".join(capsys.readouterr().out.replace("│", " ").split())
    colours = palette([Condition("aann_kernel", "measured + synthetic", "dark")])
    names = ("dark", "network, measured + synthetic (dark)")
    assert {colour(colours, name) for name in names} == {colour({}, "dark")}


def test_models_for_comparison_are_always_quick(small, monkeypatch):
    """A field model asked for by name brings no fits of the published size along, of others or of held-out spectra."""
    made, model_type = [], context.model_type
    monkeypatch.setattr(context, "model_type", lambda *given: made.append(given) or model_type(given[0]))
    monkeypatch.setattr(ESTIMATORS, "_registered", {"aann": Constant, "kernel_regression": KernelRegression})
    turbo_learning(small, measured=0.5, models=["idw"], preset="paper", extra=0)
    assert sorted(made) == [("coarray", "quick"), ("gp", "quick"), ("idw", "paper"), *[("idw", "quick")] * 2]


def test_the_room_is_searched_once_for_all_models_with_one(room, floor_alone, short_fits, tmp_path, monkeypatch):
    """Its time counts as part of the fit of each of them. Spectra outside a pair of folds decide which planes predict it."""
    searched, search = [], geometry.search_room
    monkeypatch.setattr(geometry, "search_room", lambda *given: searched.append(1) or search(*given))
    monkeypatch.setattr(MatchedField, "fit", mock.Mock(side_effect=FitError("not now")))
    memo = Memo(tmp_path)
    options = {"models": ["hybrid"], "estimators": ["matched_field"], "extra": 0, "keep": memo}
    result = turbo_learning(room, measured=0.7, **options)
    fits = {name: entry["seconds"]["fit"] for name, entry in result.metrics["synthesis"].items()}
    assert set(fits) == {"hybrid", "geometry"}
    assert min(fits.values()) > memo.kept("room-mix0.7-r0")["seconds"]
    assert len(searched) == 1
    decided = [memo.kept(f"room-mix0.7-r0_{folds}") for folds in ("0_1", "2_3")]
    assert [room["planes"] for room in decided] == [1, 1]
    assert result.left_out == ["matched_field is left out with 70% measured: not now"]
    again = turbo_learning(room, measured=0.7, **options)
    assert len(searched) == 1
    assert again.summary().equals(result.summary())


def test_cross_validation_is_that_of_each_field_model(small):
    """A model without cross-validation adds no extra positions by default."""
    data = Experiment(*small.split("random", 0))
    numbers = {n: data.trainings({"recommended_n_synthetic": n})[-1][1] for n in (0, 300)}
    assert (numbers, data.trainings(None)[-1][1]) == ({0: 0, 300: 3000}, 0)


def test_coarray_takes_the_array_from_the_file_beside_the_data(small, tmp_path):
    (tmp_path / "data").mkdir()
    write_spectra(replace(small, array=None), tmp_path / "data")
    (tmp_path / "data" / "reading.yaml").write_text("array: [4, 0.164, 915e6]")
    turbo = ("--measured", 0.5, "--models", "coarray", "--data", tmp_path / "data", "--out", tmp_path / "run")
    assert quick.run("aoa", *turbo, "--extra", 0) == 0
    model = load(tmp_path / "run" / "coarray-mix0.5.safetensors")
    assert model.synthesize(small.position[:2]).shape == (2, 10, 40)


def test_only_the_named_estimators_are_compared_and_no_room_is_searched(small, tmp_path, capsys):
    (tmp_path / "data").mkdir()
    write_spectra(small, tmp_path / "data")
    turbo = ("--mix", 0.5, "--models", "coarray", "--data", tmp_path / "data", "--out", tmp_path / "run")
    assert quick.run("aoa", *turbo, "--extra", 0, "--only", "kernel_regression") == 0
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())["mixes"]["0.5"]
    assert {name.split(",")[0] for name in metrics["methods"]} == {"kernel_regression"}
    assert set(metrics["synthesis"]) == {"coarray"}
    said = "".join(capsys.readouterr())
    assert "training and testing kernel_regression" in said
    assert "finding the room" not in said


@pytest.mark.cuda
def test_whole_run_on_a_gpu(small, small_published, tmp_path):
    trained = ("swiftwrf", "swiftwrf_paper", "nerf2", "wrfgs", "vae", "dcgan")
    options = ("--mix", 0.5, "--extra", 10, "--device", "cuda", "--out", tmp_path / "run")
    assert run(*options, "--synthesizer", *trained) == 0
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())["mixes"]["0.5"]
    assert {f"network, measured + synthetic + extra ({name})" for name in trained} <= set(metrics["methods"])
    assert set(trained) <= set(metrics["synthesis"])
    assert load(tmp_path / "run" / "swiftwrf-mix0.5.safetensors").device.type == "cpu"


def test_a_ring_of_azimuths_is_a_grid(tmp_path):
    data = simulated_room(n=40, grid=AngularGrid.ring(48))
    assert data.grid.direction[0, :, 2].abs().max() == 0.0
    folder = tmp_path / "ring"
    folder.mkdir()
    write_spectra(data, folder)
    assert load_spectra(folder).spectrum.equal(data.spectrum)
    assert quick.run("aoa", "--mix", 0.5, "--data", folder, "--models", "gp", "--out", tmp_path / "run") == 0
    with pytest.raises(InputError, match="phases of the elements do not follow from a single row of azimuths"):
        make_model("geometry").fit(data)
