"""The contract of every registered field model, and of one from another package."""

import json
import shutil
import subprocess
import sys
import tomllib
from contextlib import ExitStack, suppress
from dataclasses import fields, replace
from functools import cache
from pathlib import Path

import numpy as np
import outside_mean
import pytest
import small
import torch
from samples import install

import swiftwrf
from augment import Mixed
from augment.estimators.kernel_regression import KernelRegression
from swiftwrf import AngularGrid, FieldModel, InputError, RssiModel, Spectra, load, make_model
from swiftwrf.errors import NotFitted
from swiftwrf.locate import MatchedField, RssiLocator
from swiftwrf.models import FIELD_MODELS
from swiftwrf.models.base import ARRAY, FIXED_END
from swiftwrf.models.base import model_type as model_type_of
from swiftwrf.runtime.checkpoint import Saved

OPTIONS = {"swiftwrf": {"n_primitives": 24}}
NOT_DIFFERENTIABLE = {
    "nearest": "piecewise constant",
    "raytrace": "its paths come from a ray tracer that gives no gradients",
}
STEP_M = 1e-3  # of finite differences
ON_GPU = {"swiftwrf", "swiftwrf_paper", "nerf2", "wrfgs", "vae", "dcgan"}  # the other models stay on the CPU
every = pytest.mark.parametrize("name", list(FIELD_MODELS))


@pytest.fixture(scope="module", params=["cpu", pytest.param("cuda", marks=pytest.mark.cuda)])
def device(request):
    return request.param


@pytest.fixture(scope="module")
def fitted(room, device):
    """Fitted models by name, each fitted once, in their smallest size."""
    with ExitStack() as patches:
        patches.enter_context(small.small_published())
        patches.enter_context(small.known_planes(small.FLOOR))
        yield cache(lambda name: make_model(name, **OPTIONS.get(name, {})).fit(room, device=device))


@pytest.fixture
def position(room):
    """Positions between those of the room."""
    return room.position[:3] + torch.tensor([0.05, -0.03, 0.02], dtype=torch.float64)


@every
def test_a_model_describes_itself(name):
    model_type = FIELD_MODELS[name]
    assert issubclass(model_type, FieldModel)
    assert model_type.name == name
    assert FIELD_MODELS.summary(name)
    assert set(model_type.requires) <= {ARRAY, FIXED_END}


@every
def test_fit_returns_the_model(fitted, device, name):
    model = fitted(name)
    assert type(model) is FIELD_MODELS[name]
    assert repr(model) == f"{type(model).__name__}(fitted, 15 x 60 directions)"
    assert model.device.type == (device if name in ON_GPU else "cpu")
    assert model.region().device.type == "cpu"
    assert model.fixed_end is None or model.fixed_end[0].device.type == "cpu"
    assert not any(parameter.requires_grad for parameter in model.parameters())


@every
def test_predictions_are_spectra(fitted, room, position, name):
    model = fitted(name)
    found = model.predict(position)
    assert found.mean.shape == (3, *room.grid.shape)
    assert found.mean.dtype == torch.float32
    assert found.mean.device == model.device
    assert not found.mean.requires_grad
    assert ((found.mean >= 0) & (found.mean <= 1)).all()
    if found.std is not None:
        assert found.std.shape == found.mean.shape
        assert (found.std >= 0).all()
    else:
        with pytest.raises(InputError, match="no standard deviation"):
            found.interval()
    assert torch.equal(model.predict(position).mean, found.mean)
    assert torch.equal(model.synthesize(position), found.mean)
    alone = torch.cat([model.predict(one[None]).mean for one in position])
    torch.testing.assert_close(alone, found.mean, atol=2e-5, rtol=0)
    nothing = model.predict(position[:0])
    assert nothing.mean.shape == (0, *room.grid.shape)
    assert (nothing.std is None) == (found.std is None)
    model.predict(position.float())
    assert model.synthesize(torch.tensor([[1e7] * 3, [1e9] * 3], dtype=torch.float64)).isfinite().all()


@every
def test_a_saved_model_predicts_the_same(fitted, position, tmp_path, name):
    model = fitted(name)
    model.save(tmp_path / "model")
    again = load(tmp_path / "model")
    assert type(again) is type(model)
    assert again.config == model.config
    found, expected = again.predict(position), model.predict(position)
    tolerance = 1e-6 if model.device.type == "cpu" else 1e-4  # a file is loaded to the CPU
    torch.testing.assert_close(found.mean, expected.mean.cpu(), atol=tolerance, rtol=0)
    assert (found.std is None) == (expected.std is None)
    if found.std is not None:
        torch.testing.assert_close(found.std, expected.std.cpu())


@every
def test_gradients_are_those_of_finite_differences_in_metres(fitted, room, position, name):
    model = fitted(name)
    position = position.requires_grad_()
    weight = torch.rand(room.grid.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)

    def total(at):
        return (model.predict(at).mean.double().cpu() * weight).sum(dim=(1, 2))

    if name in NOT_DIFFERENTIABLE:
        assert not model.predict(position).mean.requires_grad
        return
    (gradient,) = torch.autograd.grad(total(position).sum(), position)
    steps = STEP_M * torch.eye(3, dtype=torch.float64)
    with torch.no_grad(), torch.backends.cudnn.flags(allow_tf32=False):  # whose 10 bits drown differences on a GPU
        differences = [total(position + step) - total(position - step) for step in steps]
        expected = torch.stack(differences, dim=1) / (2 * STEP_M)
    assert gradient.norm() > 0
    torch.testing.assert_close(gradient, expected, rtol=0, atol=0.03 * float(expected.abs().max()))


@every
def test_other_grids_are_predicted_or_refused(fitted, position, name):
    """On a grid twice as fine every second pixel is the same."""
    model, fine = fitted(name), AngularGrid.hemisphere(30, 120)
    if model.any_grid:
        found = model.synthesize(position, fine)[:, 1::2, ::2]
        torch.testing.assert_close(found, model.synthesize(position), atol=1e-4, rtol=1e-4)
        assert model.synthesize(position, AngularGrid.hemisphere(7, 30)).shape == (3, 7, 30)
    else:
        with pytest.raises(InputError, match="grid of its training spectra only"):
            model.predict(position, fine)


@every
def test_wrong_positions_are_refused(fitted, name):
    model = fitted(name)
    with pytest.raises(InputError, match=r"shape \(n, 3\)"):
        model.predict(torch.zeros(4, 2))
    with pytest.raises(InputError, match="finite"):
        model.predict(torch.tensor([[0.0, float("nan"), 0.0]]))


@every
def test_wrong_training_spectra_are_refused(room, name):
    with pytest.raises(InputError, match="at least 10"):
        make_model(name).fit(room.subset(torch.arange(9)))
    bare = replace(room, array=None, rotation=None, fixed_position=None)
    for need in FIELD_MODELS[name].requires:
        with pytest.raises(InputError, match=f"needs the .*{need}"):
            make_model(name).fit(bare)


@every
def test_a_model_that_is_not_fitted_is_refused(room, name):
    model = make_model(name)
    assert repr(model) == f"{type(model).__name__}(not fitted)"
    with pytest.raises(InputError, match="call fit first"):
        model.predict(room.position)
    with pytest.raises(InputError, match="call fit first"):
        model.state()


@every
def test_wrong_options_are_refused(name):
    model_type = FIELD_MODELS[name]
    with pytest.raises(InputError, match="has no option 'sead'"):
        model_type(sead=1)
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


@every
def test_structure_is_reused_from_a_model_of_the_same_scene(fitted, room, name):
    first = fitted(name)
    if not type(first).accepts_like(first):
        pytest.skip("has no structure")
    again = type(first)(first.config).fit(room.subset(torch.arange(30)), like=first)
    assert again.predict(room.position).mean.isfinite().all()
    with pytest.raises(InputError, match="cannot reuse the structure"):
        type(first)(first.config).fit(room, like=outside_mean.Mean().fit(room))


USE = """
import sys
sys.path.append(sys.argv[1])
import swiftwrf
from swiftwrf.runtime.checkpoint import Saved
for model in (*map(swiftwrf.load, sys.argv[2:]), swiftwrf.make_model("outside_mean", seed=1)):
    print(type(model).__name__)
print(*Saved.kinds, sep="\\n")
"""


def test_models_of_this_and_other_packages_are_opened_and_made_with_swiftwrf_alone(fitted, room, tmp_path):
    """The entry points of pyproject.toml suffice for estimators, as in an installation."""
    shutil.copy(outside_mean.__file__, tmp_path)
    install(tmp_path, "swiftwrf.models", outside_mean="outside_mean:Mean")
    project = tomllib.loads((Path(__file__).parents[3] / "pyproject.toml").read_text())["project"]
    install(tmp_path, "swiftwrf.estimators", **project["entry-points"]["swiftwrf.estimators"])
    regression = KernelRegression().fit(Mixed.measured(room))
    models = [*map(fitted, ("gp", "hybrid", "vae")), outside_mean.Mean(seed=1).fit(room), regression]
    files = [tmp_path / str(number) for number in range(len(models))]
    for model, file in zip(models, files, strict=True):
        model.save(file)
    done = subprocess.run([sys.executable, "-c", USE, tmp_path, *files], capture_output=True, text=True, check=False)
    names = [*(type(model).__name__ for model in models), "Mean"]
    assert done.stdout.splitlines()[: len(names)] == names, done.stderr
    estimators = {kind for kind, made in Saved.kinds.items() if made.__module__.startswith("augment.estimators")}
    assert estimators <= {*done.stdout.splitlines()}


def test_predictions_of_each_device_are_drawn_tabulated_and_stored(fitted, position):
    model = fitted("swiftwrf")
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


@pytest.mark.parametrize("model", [*FIELD_MODELS.values(), RssiModel, RssiLocator, MatchedField])
def test_what_a_fit_determines_is_refused_before_it(model):
    unfitted = model()
    properties = {name for kind in model.__mro__ for name, own in vars(kind).items() if isinstance(own, property)}
    for name in properties - {"is_fitted"}:
        with suppress(NotFitted):  # a property that no fit determines has a value
            getattr(unfitted, name)
    assert not hasattr(unfitted, model.fitted_attribute)
    with pytest.raises(AttributeError, match="no attribute 'predcit'"):
        unfitted.predcit  # noqa: B018
