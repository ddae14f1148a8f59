"""The angle-of-arrival task: estimators, one whole run, its refusals, its resumption."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from unittest import mock

import numpy as np
import pandas as pd
import pytest
import torch
from sklearn.model_selection import KFold

import augment
from augment import SYNTHESIZERS, Mixed, Synthesizer, Trial, choose, lacks, make_synthesizer
from swiftwrf import AngularGrid, FitConfig, InputError, ModelConfig, load, simulated_room
from swiftwrf.array.angles import to_angles
from swiftwrf.data.store import Store
from swiftwrf.data.writing import write_spectra
from swiftwrf.metrics import angle_errors
from tasks.aoa import advice, arms, experiment, steps
from tasks.aoa.config import AoaConfig
from tasks.aoa.estimators import ESTIMATORS, Settings, radial
from tasks.aoa.estimators.aann import AANN, AANNConfig
from tasks.aoa.estimators.baselines import Constant, NearestSpectrum, Peak
from tasks.page.palette import Palette
from tasks.report import merge
from tasks.run import command_line

TINY_FIT = FitConfig(model=ModelConfig(n_primitives=8), steps=20, check_every=10)


@pytest.fixture
def small(monkeypatch):
    """The task on a toy: few spectra, few steps."""
    room = simulated_room(n=50, grid=AngularGrid.hemisphere(10, 40))
    monkeypatch.setattr(experiment, "simulated_room", lambda **_: room)
    monkeypatch.setattr("augment.synthesizers.swiftwrf.FitConfig", lambda: TINY_FIT)
    for place in (steps, choose):  # finding a room has tests of its own
        monkeypatch.setattr(
            place, "candidates", lambda data: [n for n in ("idw", "gp", "coarray") if not lacks(n, data)]
        )
    monkeypatch.setattr(AANNConfig, "quick", lambda spectra: AANNConfig(steps=2, batch=4))
    return room


def run(*arguments):
    if arguments[:1] == ("--mix",) and "--extra" not in arguments:
        arguments = (*arguments, "--extra", 0)
    return command_line("tasks.aoa", AoaConfig, experiment.run, [str(a) for a in arguments], arms.meaning)


def test_peak_of_a_known_spectrum():
    grid = AngularGrid.hemisphere(10, 40)
    spectrum = torch.zeros(1, 10, 40)
    spectrum[0, 3, 10] = 1
    assert Peak(Settings(grid)).estimate(spectrum).rad2deg()[0].tolist() == pytest.approx([90, 36])


def test_constant_is_the_mean_direction_over_the_seam():
    train = Mixed(
        (Store(torch.zeros(2, 1, 1)),),
        torch.tensor([[350.0, 10], [10, 10]]).deg2rad(),
        torch.arange(2),
        torch.zeros(2).bool(),
    )
    constant = Constant(Settings(AngularGrid.hemisphere(10, 40)))
    constant.fit(train)
    azimuth = constant.estimate(torch.zeros(3, 1, 1))[:, 0]
    assert (1 - torch.cos(azimuth)).max() < 1e-9


def test_nearest_spectrum_returns_the_label_of_a_copy(room):
    nearest = NearestSpectrum(Settings(room.grid))
    nearest.fit(Mixed.measured(room))
    torch.testing.assert_close(nearest.estimate(room.spectrum[5:8]), room.label[5:8])


@pytest.mark.parametrize("circular", [False, True])
def test_aann_learns_a_toy(circular):
    """Four directions, four patterns: a network that cannot tell them apart stays at the constant's error."""
    label = torch.tensor([[0.0, 30], [90, 30], [180, 30], [270, 60]]).deg2rad().repeat(4, 1).double()
    spectrum = torch.zeros(16, 16, 64)
    for i in range(16):
        spectrum[i, 4:10, 16 * (i % 4) : 16 * (i % 4) + 8] = 1
    train = Mixed((Store(spectrum),), label, torch.arange(16), torch.zeros(16).bool())
    settings = Settings(AngularGrid.hemisphere(16, 64))
    network = AANN(settings, AANNConfig(steps=60, batch=8, rate=1e-3, max_azimuths=0, circular=circular))
    network.fit(train)
    constant = Constant(settings)
    constant.fit(train)
    errors = [angle_errors(e.estimate(spectrum), label)["great_circle"].mean() for e in (network, constant)]
    assert errors[0] < 0.5 * errors[1]


def test_every_spectrum_counts_alike_in_the_batch_norms():
    """65: in parts of 64 the last one would be a single spectrum, which a network of one pixel cannot normalise."""
    spectrum = torch.rand(65, 8, 32, generator=torch.Generator().manual_seed(0))
    spectrum[-20:] *= 0.1
    label = torch.stack([torch.linspace(0, 3, 65), torch.full((65,), 0.5)], dim=1).double()
    network = AANN(Settings(AngularGrid.hemisphere(8, 32)), AANNConfig(steps=2, batch=4))
    network.fit(Mixed((Store(spectrum),), label, torch.arange(65), torch.zeros(65).bool()))
    first = network._network.conv1(network._prepare(spectrum))
    spread = first.std(dim=(0, 2, 3))
    torch.testing.assert_close(
        network._network.bn1.running_mean / spread, first.mean(dim=(0, 2, 3)) / spread, atol=0.02, rtol=0
    )


def test_circular_padding_makes_rolled_spectra_alike():
    from tasks.aoa.estimators.resnet import CircularConv

    convolution = CircularConv(torch.nn.Conv2d(1, 3, 5, padding=2))
    x = torch.rand(1, 1, 9, 12)
    torch.testing.assert_close(convolution(x).roll(4, dims=-1), convolution(x.roll(4, dims=-1)))


def test_the_headline_is_of_the_network_that_is_kept():
    """Named by what trained it, not by its error on test spectra."""
    names = [
        "measured_only",
        "turbo_gp",
        "kernel_ridge_turbo_gp_extra",
        "turbo_gp_extra",
        "turbo_idw_extra",
        "measured_all",
    ]
    assert arms.taken(names) == "turbo_gp_extra"
    assert arms.taken(["turbo_gp", "turbo_idw", "kernel_ridge_turbo_gp"]) == "turbo_gp"


def test_kernel_ridge_regression_is_what_its_definition_says():
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
        for width in radial.WIDTHS
        for alpha in radial.PENALTIES
    }
    best = min(errors, key=errors.get)
    assert radial.choose(apart, target, seed=3) == pytest.approx(best)
    rows, new = np.arange(50), np.arange(50, 60)
    gamma, alpha = radial.choose(apart[:50, :50], target[:50], seed=3)
    found = radial.RadialRegression.fit(feature[:50], target[:50], seed=3)(feature[50:])
    np.testing.assert_allclose(found, told(rows, new, gamma, alpha), rtol=1e-8)


def test_what_all_distances_have_in_common_does_not_move_an_estimate():
    """As noise does that a measured spectrum has and synthetic ones have not."""
    generator = np.random.default_rng(0)
    feature, new = generator.normal(size=(40, 3)), generator.normal(size=(5, 3))
    regression = radial.RadialRegression.fit(np.c_[feature, np.zeros(40)], feature, seed=0)
    clean, noisy = (regression(np.c_[new, np.full(5, beside)]) for beside in (0, 100))
    np.testing.assert_allclose(noisy, clean, rtol=1e-8)
    assert np.abs(clean - new).mean() < 0.5 * np.abs(new).mean()


@pytest.mark.parametrize("circular", [False, True])
def test_pointwise_convolutions_are_matrix_products(circular):
    """The same function with the same weights, in value and gradient."""
    from tasks.aoa.estimators.resnet import Pointwise, backbone

    spectrum = torch.rand(4, 1, 9, 40, dtype=torch.float64)
    found = {}
    for products in (False, True):
        torch.manual_seed(0)
        network = backbone(circular, products).double()
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
    from tasks.aoa.estimators.resnet import Neighbours

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
    network, seen, point = AANN(Settings(room.grid), AANNConfig(steps=3, batch=batch)), [], AANN._point
    monkeypatch.setattr(
        AANN, "_point", lambda self, prepared, *how: seen.append(prepared) or point(self, prepared, *how)
    )
    network.fit(Mixed.measured(room.subset(torch.arange(spectra))))
    assert [len(rows) for rows in seen] == sizes
    assert not torch.equal(seen[0], seen[1])


def test_regression_takes_the_place_of_the_head_that_a_short_training_leaves():
    """On spectra that neither has seen."""
    room = simulated_room(n=300, grid=AngularGrid.hemisphere(10, 40))
    train, test = room.split("random")
    network = AANN(Settings(room.grid), AANNConfig(steps=5))
    network.fit(Mixed.measured(train))
    with torch.no_grad():
        pointed = network._point(network._prepare(test.spectrum), network._network).double()
    head = torch.stack(to_angles(pointed), dim=-1)
    own, alone = (angle_errors(e, test.label)["great_circle"].median() for e in (network.estimate(test.spectrum), head))
    assert own < 0.5 * alone


@pytest.mark.parametrize("value", [0.0, 0.5])
def test_spectra_that_are_all_alike_are_in_the_mean_direction(value):
    label = torch.tensor([[0.0, 30], [90, 30]]).deg2rad().repeat(6, 1).double()
    alike = torch.full((12, 8, 32), value)
    settings = Settings(AngularGrid.hemisphere(8, 32))
    network, constant = AANN(settings, AANNConfig(steps=2, batch=4)), Constant(settings)
    estimates = []
    for estimator in (network, constant):
        estimator.fit(Mixed((Store(alike),), label, torch.arange(12), torch.zeros(12).bool()))
        estimates.append(estimator.estimate(alike[:1]))
    torch.testing.assert_close(*estimates, atol=0.05, rtol=0)


def test_aann_is_seeded_and_leaves_the_global_generator_alone(room):
    state = torch.get_rng_state()
    estimates = []
    for _ in range(2):
        network = AANN(Settings(room.grid, seed=7), AANNConfig(steps=2, batch=4))
        network.fit(Mixed.measured(room))
        estimates.append(network.estimate(room.spectrum))
    assert torch.equal(*estimates)
    assert torch.equal(torch.get_rng_state(), state)


@pytest.mark.parametrize(("right", "sampled"), [("means", False), ("draws", True), ("both", False)])
def test_draws_train_only_where_they_are_better_than_means_beyond_doubt(room, right, sampled):
    fold = torch.arange(len(room)) % 4 == 0
    kept, out = room.subset((~fold).nonzero()[:, 0]), room.subset(fold.nonzero()[:, 0])

    class Told(Synthesizer):
        """Knows all spectra; what it draws in the wrong way are those of other places."""

        samples = True

        def fit(self, train):
            self.known = make_synthesizer("gp")
            self.known.fit(room)

        def synthesize(self, position, generator=None):
            right_way = right in ("both", "means" if generator is None else "draws")
            return self.known.synthesize(position if right_way else position.roll(1, dims=0))

    synthesizer = Told(augment.Settings())
    synthesizer.fit(kept)
    given = advice.advise([Trial(synthesizer, kept, out)], Settings(room.grid), extra=100)
    assert given["sampled"] is sampled
    assert [gain["sampled"] for gain in given["gains"]] == [False, True]


@pytest.mark.parametrize(
    ("factors", "recommended"),
    [((0.9, 0.8, 0.5), 3000), ((0.9, 1.1, 0.5), 0), ((0.9, 0.5, 0.8), 1000), ((1.2, 1.1, 1.3), 0)],
)
def test_further_positions_are_recommended_where_each_number_of_them_gains(monkeypatch, room, factors, recommended):
    """With few held-out spectra one number alone gains by chance."""
    factor = dict(zip((0, *advice.NUMBERS), (1, *factors), strict=True))
    monkeypatch.setattr(advice, "_errors", lambda trial, extra, *_: factor[extra] * np.linspace(1, 1.01, 20))
    given = advice.advise([Trial(make_synthesizer("idw"), room, room)], Settings(room.grid), extra=3000)
    assert given["recommended_extra"] == recommended
    assert given["helps"] == (recommended > 0)


def test_a_training_is_as_long_as_the_scene_needs():
    quick = [AANNConfig.quick(n) for n in (0, 240, 780, 1525, 100_000)]
    assert [(config.steps, config.batch) for config in quick] == [
        (125, 64),
        (125, 64),
        (366, 64),
        (715, 64),
        (1000, 64),
    ]


def test_whole_run(small, tmp_path):
    out = tmp_path / "run"
    more = ("--repeats", 2, "--extra", 20, "--suggest", 4)
    assert run("--mix", 0.5, 1.0, "--synthesizer", "swiftwrf", "idw", *more, "--out", out) == 0
    metrics = json.loads((out / "metrics.json").read_text(), parse_constant=lambda name: pytest.fail(name))
    assert (metrics["task"], metrics["data"], metrics["split"], metrics["seed"]) == (
        "aoa",
        "simulated-room",
        "random",
        0,
    )
    methods = metrics["mixes"]["0.5"]["methods"]
    trainings = ["measured_all", *(f"turbo_{name}{more}" for name in ("swiftwrf", "idw") for more in ("", "_extra"))]
    others = ("nearest_spectrum", "kernel_ridge")
    expected = {"measured_only", "constant", "peak", *others, *trainings}
    expected |= {f"{estimator}_{training}" for estimator in others for training in trainings}
    assert set(methods) == expected
    drawn = {"swiftwrf", "idw", "gp", "gp sample", "coarray", "coarray sample"}
    assert set(metrics["mixes"]["0.5"]["synthesis"]) == drawn
    assert metrics["mixes"]["0.5"]["counts"]["turbo_idw_extra"] == {"measured": 20, "withheld": 20, "further": 20}
    assert metrics["mixes"]["0.5"]["advice"]["n_held_out"] == 20
    assert set(metrics["mixes"]["1"]["seconds"]) == {"fit", "synthesize", "train"}

    errors = pd.read_csv(out / "errors.csv")
    assert len(errors) == 2 * 2 * 20 * 10  # shares, repeats, methods, test spectra
    own = errors[(errors.mix == 0.5) & (errors.method == "turbo_swiftwrf")]
    median = own.groupby("index").great_circle_deg.mean().median()
    assert methods["turbo_swiftwrf"]["great_circle_deg"]["median"] == pytest.approx(median)
    assert methods["turbo_swiftwrf"]["great_circle_deg"]["low"] <= median
    truth = np.degrees(small.label[own["index"].tolist()].numpy())
    np.testing.assert_allclose(own[["truth_azimuth_deg", "truth_elevation_deg"]], truth, rtol=1e-9)

    assert list((out / "figures").glob("turbo-mix0.5*.svg"))
    suggested = pd.read_csv(out / "suggested-mix0.5.csv")
    assert suggested.columns.tolist() == ["x_m", "y_m", "z_m", "variance_left"]
    assert len(suggested) == 4
    assert suggested["variance_left"].is_monotonic_decreasing

    html = (out / "report.html").read_text()
    assert "Where to measure next" in html
    assert "What to do next" in html
    field = pd.read_csv(next((out / "figures").glob("field-swiftwrf-mix0.5*.csv")))
    for place, known in zip((field["x_m"], field["y_m"]), small.position.T.tolist(), strict=False):
        assert place.between(min(known) - 1e-9, max(known) + 1e-9).all()
    assert field["azimuth_deg"].between(0, 360).all()
    assert field["elevation_deg"].between(0, 90).all()
    motion = pd.read_csv(next((out / "figures").glob("motion-mix0.5*.csv")))
    assert motion["strength"].ge(0).all()
    assert motion["walked_m"].iloc[-1] > motion["walked_m"].iloc[0]
    assert "What this does not show" in html
    assert "<svg" in html
    assert not [line for line in html.splitlines() if 'src="http' in line or 'href="http' in line]
    assert load(out / "model-mix0.5.safetensors").synthesize(small.position[:2]).shape == (2, 10, 40)
    assert not list(tmp_path.glob("*.partial"))

    merge([out, out], tmp_path / "both")
    assert (tmp_path / "both" / "report.html").stat().st_size > 10_000


@pytest.fixture
def registered(monkeypatch):
    """One more estimator, for the time of a test."""
    monkeypatch.setattr(ESTIMATORS, "_entries", dict(ESTIMATORS._entries))

    @ESTIMATORS.register("northern", meaning="always due north", colour="#123456")
    class Northern(Constant):
        def estimate(self, spectrum):
            return torch.zeros(len(spectrum), 2, dtype=torch.float64)


def test_a_new_estimator_is_in_help_metrics_report_and_colours(small, registered, tmp_path, capsys):
    with pytest.raises(SystemExit):
        run("--help")
    shown = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert "northern: always due north" in shown
    assert "nearest: the spectrum of the nearest" in shown
    assert arms.palette().colour("northern") == "#123456"
    assert arms.palette().line("northern") == "--"
    assert run("--mix", 0.5, "--synthesizer", "nearest", "--extra", 0, "--out", tmp_path / "run") == 0
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert metrics["mixes"]["0.5"]["methods"]["northern"]["elevation_deg"]["median"] > 0
    html = (tmp_path / "run" / "report.html").read_text()
    assert "<dt>northern</dt><dd>always due north</dd>" in html
    assert "#123456" in html


def test_a_new_synthesizer_is_in_help_report_and_colours(monkeypatch, capsys):
    monkeypatch.setattr(SYNTHESIZERS, "_entries", dict(SYNTHESIZERS._entries))
    SYNTHESIZERS.register("dark", meaning="nothing anywhere", colour="#123456")(object)
    with pytest.raises(SystemExit):
        run("--help")
    assert "dark: nothing anywhere" in " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert arms.synthesizers(["dark", "gone"]) == {"dark": "nothing anywhere"}
    assert arms.palette().colour("dark") == arms.palette().colour("turbo_dark") == "#123456"


def test_a_name_without_colour_has_one_that_depends_on_the_name_alone():
    assert Palette().colour("unknown") == Palette({"other": "#000000"}).colour("unknown")


def test_interrupted_run_goes_on_to_the_same_numbers(small, tmp_path, monkeypatch):
    arguments = ("--mix", 0.5, "--extra", 20, "--out")
    assert run(*arguments, tmp_path / "whole") == 0

    honest, calls = AANN.fit, []

    def interrupt(self, train):
        calls.append(len(train))
        if len(calls) == 2:
            raise KeyboardInterrupt
        honest(self, train)

    monkeypatch.setattr(AANN, "fit", interrupt)
    assert run(*arguments, tmp_path / "cut") == 130
    assert not (tmp_path / "cut").exists()
    monkeypatch.setattr(AANN, "fit", honest)
    assert run("--resume", tmp_path / "cut.partial") == 0
    whole, cut = (
        json.loads((tmp_path / name / "metrics.json").read_text())["mixes"]["0.5"] for name in ("whole", "cut")
    )
    for mix in (whole, cut):
        for entry in (*mix["methods"].values(), *mix["synthesis"].values()):
            assert all(seconds >= 0 for seconds in entry.pop("seconds").values())
    assert whole["methods"] == cut["methods"]
    assert whole["synthesis"] == cut["synthesis"]


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("--mix", 0), "in (0, 1]"),
        (("--mix", 1.5), "in (0, 1]"),
        (("--mix", 0.3, 0.3), "twice"),
        (("--mix", 0.1), "leaves 4 of 40"),
        (("--mix", 0.5, "--split", "nowhere"), "choose one of block, random"),
        (("--mix", 0.5, "--synthesizer", "oracle"), "unknown synthesizer"),
        (("--mix", 0.5, "--repeats", 0), "--repeats"),
        (("--mix", 0.5, "--suggest", -1), "--suggest"),
        (("--mix", 0.5, "--data", "/nowhere"), "is not a folder"),
        (("--resume", "nowhere"), "no interrupted run"),
    ],
)
def test_wrong_input_is_one_sentence_and_code_2(small, tmp_path, capsys, arguments, says):
    extra = () if arguments[0] == "--resume" else ("--out", tmp_path / "run")
    assert run(*arguments, *extra) == 2
    error = capsys.readouterr().err.strip()
    assert says in error
    assert error.count("\n") == 0
    assert not list(tmp_path.iterdir())


def test_coarray_needs_the_array_and_takes_it_from_the_command_line(small, tmp_path, capsys):
    (tmp_path / "data").mkdir()
    write_spectra(replace(small, array=None), tmp_path / "data")
    assert run("--mix", 0.5, "--array", 4, 0.164, 915e6, "--out", tmp_path / "run") == 2
    assert "give it with --data" in capsys.readouterr().err
    turbo = ("--mix", 0.5, "--synthesizer", "coarray", "--data", tmp_path / "data", "--out", tmp_path / "run")
    assert run(*turbo) == 2
    assert "give it with --array" in capsys.readouterr().err
    assert run(*turbo, "--array", 1, 0.16, 915e6) == 2
    assert "2 to 32 elements a side" in capsys.readouterr().err
    assert run(*turbo, "--array", 4, 0.164, 915e6) == 0
    model = load(tmp_path / "run" / "coarray-mix0.5.safetensors")
    assert model.synthesize(small.position[:2]).shape == (2, 10, 40)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_cuda_without_a_gpu(small, tmp_path, capsys):
    assert run("--mix", 0.5, "--device", "cuda", "--out", tmp_path / "run") == 2
    assert "NVIDIA GPU" in capsys.readouterr().err


def test_existing_directory_is_not_overwritten(small, tmp_path, capsys):
    (tmp_path / "run").mkdir()
    assert run("--mix", 0.5, "--out", tmp_path / "run") == 2
    assert "exists already" in capsys.readouterr().err
    assert not list((tmp_path / "run").iterdir())


def test_report_refuses_unfinished_runs(tmp_path):
    with pytest.raises(InputError, match="no finished run"):
        merge([tmp_path], tmp_path / "out")


def test_metrics_are_strict_json(tmp_path):
    from tasks.records import strict

    assert strict({"a": math.nan, "b": [math.inf, 1.0], "c": (1, 2)}) == {"a": None, "b": [None, 1.0], "c": [1, 2]}


def test_paper_preset_keeps_all_pixels():
    assert AANNConfig.paper().max_azimuths == 0
    assert AANNConfig.paper().steps > AANNConfig().steps
