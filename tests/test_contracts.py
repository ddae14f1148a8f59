"""The contracts of all registered implementations by the public checks, and the mistakes that these checks find."""

import json
import shutil
import subprocess
import sys
import tomllib
from dataclasses import fields, replace
from functools import partial
from itertools import count
from pathlib import Path

import numpy as np
import outside_mean
import pytest
import torch
from fuzz.kinds import DATA
from samples import FREQUENCY, install, snapshots, write_paths
from small import known_planes

import swiftwrf
from augment import Mixed
from augment.estimators import ESTIMATORS
from augment.estimators.kernel_regression import KernelRegression
from augment.estimators.subspace import SnapshotEstimator
from augment.testing import check_estimator
from swiftwrf import AngularGrid, InputError, Spectra, make_model, rssi_room, simulated_room
from swiftwrf.choices import RSSI_PREDICTORS
from swiftwrf.contrib.comparison.predictors import make_predictor
from swiftwrf.data.formats import RSSI_FORMATS, SNAPSHOT_FORMATS, SPECTRA_FORMATS
from swiftwrf.locate import MatchedField, RssiLocator
from swiftwrf.models import FIELD_MODELS
from swiftwrf.models.base import model_type as model_type_of
from swiftwrf.models.geometry import Plane
from swiftwrf.runtime.checkpoint import Saved
from swiftwrf.testing import check_field_model, check_not_fitted, check_predictor, check_reader

OPTIONS = {"swiftwrf": {"n_primitives": 24}}
NOT_DIFFERENTIABLE = {"nearest", "raytrace"}  # piecewise constant; its ray tracer gives no gradients
WITHOUT_GRADIENT = {"mean", "knn", "mri_residual", "gp", "knn_pairs"}
ON_GPU = {"swiftwrf", "swiftwrf_paper", "nerf2", "wrfgs", "vae", "dcgan"}  # the other models stay on the CPU
FORMATS = {f"{kind.kind} {name}": kind for kind in (SPECTRA_FORMATS, SNAPSHOT_FORMATS, RSSI_FORMATS) for name in kind}


@pytest.fixture(params=["cpu", pytest.param("cuda", marks=pytest.mark.cuda)])
def device(request):
    return request.param


@pytest.mark.parametrize("name", FIELD_MODELS)
def test_field_models(small_published, floor_alone, room, device, name):
    model = make_model(name, **OPTIONS.get(name, {}))
    assert repr(model) == f"{type(model).__name__}(not fitted)"
    with pytest.raises(InputError, match="call fit first"):
        model.state()
    check_field_model(model, room, device=device, is_differentiable=name not in NOT_DIFFERENTIABLE)
    assert type(model) is FIELD_MODELS[name]
    assert repr(model) == f"{type(model).__name__}(fitted, 15 x 60 directions)"
    assert model.name == name
    assert FIELD_MODELS.summary(name)
    assert model.device.type == (device if name in ON_GPU else "cpu")
    assert model.fixed_end is None or model.fixed_end[0].device.type == "cpu"
    if type(model).accepts_like(model):
        with pytest.raises(InputError, match="cannot reuse the structure"):
            type(model)(model.config).fit(room, like=outside_mean.Mean().fit(room))


@pytest.mark.parametrize("name", RSSI_PREDICTORS)
def test_predictors(small_published, short_fits, name):
    train, test = rssi_room(n=60).columns([0, 1, 2, 3]).split("random")
    predictor = make_predictor(name, validation="block")
    check_predictor(predictor, train, is_differentiable=name not in WITHOUT_GRADIENT)
    prediction = predictor.predict(test.transmitter_position)
    assert (prediction.std is not None) == (name in ("swiftwrf", "pairs"))
    assert (prediction.mean - test.rssi_dbm).abs().nanmedian() < (100 if name == "nerf2" else 9)  # in so few steps


@pytest.mark.parametrize("name", ESTIMATORS)
def test_estimators(name):
    kind, data = ESTIMATORS[name], None
    if issubclass(kind, SnapshotEstimator):
        of_carriers = replace(snapshots(n=20, count=4), frequency_hz=FREQUENCY + 1e7 * torch.arange(4).double())
        data = of_carriers.spectra((8, 32))
    check_estimator(kind(steps=2, batch=4) if name.startswith("aann") else kind(), data)


@pytest.mark.parametrize("name", FORMATS)
def test_readers(tmp_path, name):
    DATA[name][0](tmp_path)
    check_reader(FORMATS[name][name.split()[-1]], tmp_path)


@pytest.mark.parametrize("kind", [RssiLocator, MatchedField])
def test_locators_before_their_fit(tmp_path, kind):
    locator = kind()
    check_not_fitted(locator)
    assert repr(locator) == f"{kind.__name__}(not fitted)"
    for use in (lambda: locator.locate(torch.zeros(1, 12)), lambda: locator.save(tmp_path / "locator")):
        with pytest.raises(InputError, match="call fit first"):
            use()
    with pytest.raises(AttributeError, match="no attribute 'predcit'"):
        locator.predcit  # noqa: B018


@pytest.mark.parametrize("name", ["geometry", "hybrid"])
def test_rooms_of_a_moving_receiver(short_fits, name):
    model, walls = make_model(name), [Plane((1.0, 0.0, 0.0), 6.0, -0.5), Plane((0.0, 0.0, -1.0), 0.0, -0.5)]
    with known_planes(*walls):
        check_field_model(model, simulated_room(n=40, moving="receiver", grid=AngularGrid.hemisphere(10, 40)))
    if name == "hybrid":
        assert model.mixing_weight > 0
        assert model.process.value.shape[1]


# mistakes


COUNT = count(1)
WITHOUT_GRADIENTS = partial(check_predictor, is_differentiable=False)
IDW, MEAN, NEAREST = FIELD_MODELS["idw"], RSSI_PREDICTORS["mean"], ESTIMATORS["nearest_spectrum"]


def predicts(base, change):
    """Return a method whose mean is changed."""

    def predict(self, given, *arguments):
        mean, std = base._predict(self, given, *arguments)
        return change(mean), std

    return {"_predict": predict}


def of_any_grid(self, position, grid, with_std):
    """Return the distance as each pixel's magnitude, which the number of pixels changes."""
    return (position.norm(dim=1)[:, None, None] / grid.shape[0]).expand(-1, *grid.shape), None


def of_damage(self, path, options):
    """Read paths.npz without a check."""
    with np.load(path / "paths.npz") as content:
        return Spectra(torch.zeros(12, 9, 36), content["receiver_position"])


MISTAKES = {
    "a second prediction differs": (IDW, predicts(IDW, lambda mean: mean / next(COUNT))),
    "single positions give other predictions": (IDW, predicts(IDW, lambda mean: mean / len(mean))),
    "not those of finite differences": (IDW, predicts(IDW, lambda mean: (mean + 3 * mean.detach()) / 4)),
    "is_differentiable=True is not so": (IDW, predicts(IDW, torch.Tensor.detach)),
    "a finer grid gives other values": (IDW, {"any_grid": True, "_predict": of_any_grid}),
    "a file gives other predictions": (IDW, {"_restored": lambda self: self.position.mul_(2)}),
    "requires names an unknown property": (IDW, {"requires": ("weather",)}),
    "fit does not return the": (MEAN, {"fit": lambda self, *rows, **_: MEAN.fit(self, *rows) and None}),
    "not finite at receivers that are rarely detected": (
        MEAN,
        {"_fit": lambda self, train, **_: setattr(self, "_mean", train.rssi_dbm.nanmean(dim=0))},
    ),
    "a prediction has shape": (MEAN, predicts(MEAN, lambda mean: mean[:, :1])),
    "the estimate depends on the labels": (NEAREST, {"estimate": lambda self, data: data.label}),
    "convert degrees": (NEAREST, {"predict": lambda self, spectra: NEAREST.predict(self, spectra) + 90}),
    "single spectra have other estimates": (NEAREST, {"predict": lambda self, x: torch.ones(len(x), 2) / len(x)}),
    "fit changes its training set": (NEAREST, {"_fit": lambda self, train, device: train.label.zero_()}),
    "an empty folder is recognised": (SPECTRA_FORMATS["paths"], {"recognises": lambda self, path: True}),
    "a damaged paths.npz raises": (SPECTRA_FORMATS["paths"], {"read": of_damage}),
}


@pytest.mark.parametrize("words", MISTAKES)
def test_a_mistake_is_found(tmp_path, monkeypatch, words):
    monkeypatch.setattr(Saved, "kinds", dict(Saved.kinds))
    base, methods = MISTAKES[words]
    checks = {IDW: check_field_model, MEAN: WITHOUT_GRADIENTS, NEAREST: check_estimator}
    check = checks.get(base, lambda reader: check_reader(reader, write_paths(tmp_path)))
    with pytest.raises(AssertionError, match=f"Mistaken.*{words}"):
        check(type("Mistaken", (base,), {"kind": "mistaken", **methods})())


# what is particular to the models of this package


@pytest.mark.parametrize("name", FIELD_MODELS)
def test_wrong_options_are_refused(name):
    model_type = FIELD_MODELS[name]
    with pytest.raises(InputError, match="preset must be 'quick' or 'paper'"):
        make_model(name, preset="Paper")
    foreign = "further" if "further" not in {field.name for field in fields(model_type.config_type)} else "ssim_weight"
    with pytest.raises(InputError, match=f"has no option '{foreign}'; it has .*seed"):
        make_model(name, **{foreign: 3})
    if model_type_of(name, "paper") is model_type and not hasattr(model_type.config_type, "paper"):
        with pytest.raises(InputError, match="has no published settings; leave preset='paper' out"):
            make_model(name, preset="paper")
    known = {field.name for field in fields(model_type.config_type)}
    for option, value in {"seed": -1, "validation": "blok", "steps": -5, "batch": 0, "rate": -1.0}.items():
        if option in known:
            with pytest.raises(InputError, match=f"{option} must be"):
                model_type(**{option: value})


USE = """
import sys
sys.path.append(sys.argv[1])
import swiftwrf
from swiftwrf.runtime.checkpoint import Saved
for model in (*map(swiftwrf.load, sys.argv[2:]), swiftwrf.make_model("outside_mean", seed=1)):
    print(type(model).__name__)
print(*Saved.kinds, sep="\\n")
"""


def test_models_of_this_and_other_packages_are_opened_and_made_with_swiftwrf_alone(
    small_published, floor_alone, room, tmp_path
):
    """The entry points of pyproject.toml suffice for estimators, as in an installation."""
    shutil.copy(outside_mean.__file__, tmp_path)
    install(tmp_path, "swiftwrf.models", outside_mean="outside_mean:Mean")
    project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]
    install(tmp_path, "swiftwrf.estimators", **project["entry-points"]["swiftwrf.estimators"])
    regression = KernelRegression().fit(Mixed.measured(room))
    fitted = [make_model(name).fit(room) for name in ("gp", "hybrid", "vae")]
    models = [*fitted, outside_mean.Mean(seed=1).fit(room), regression]
    files = [tmp_path / str(number) for number in range(len(models))]
    for model, file in zip(models, files, strict=True):
        model.save(file)
    done = subprocess.run([sys.executable, "-c", USE, tmp_path, *files], capture_output=True, text=True, check=False)
    names = [*(type(model).__name__ for model in models), "Mean"]
    assert done.stdout.splitlines()[: len(names)] == names, done.stderr
    estimators = {kind for kind, made in Saved.kinds.items() if made.__module__.startswith("augment.estimators")}
    assert estimators <= {*done.stdout.splitlines()}


def test_predictions_of_each_device_are_drawn_tabulated_and_stored(room, device):
    model, position = make_model("swiftwrf", n_primitives=24).fit(room, device=device), room.position[:3] + 0.03
    found = model.predict(position)
    assert model.plot(position[0]).name == "polar"
    assert len(found.to_frame()) == 3
    peak = model.grid.peak_direction(found.mean)
    assert peak.device == found.mean.device
    stored = Spectra(found.mean, position, grid=model.grid)
    assert torch.equal(model.grid.peak_direction(stored.spectrum), peak.cpu())


def test_numbers_of_numpy_are_numbers():
    room = swiftwrf.simulated_room(n=np.int64(12), grid=AngularGrid.hemisphere(9, np.int32(36)))
    model = make_model("gp", seed=np.int64(3)).fit(room)
    assert json.dumps(model.state()[1]["config"]) == json.dumps(make_model("gp", seed=3).config.__dict__)
    assert len(model.predict(room.position).interval(np.float32(0.5))) == 2


def test_intervals_of_any_level_below_1_are_finite():
    low, high = swiftwrf.Prediction(torch.zeros(1), torch.ones(1)).interval(0.9999999999999999)
    assert 8 < float(high) == -float(low) < 9
