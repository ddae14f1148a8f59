"""Models and estimators of a user: valid spectra and directions count in every form, others are refused with the class."""

import math
from functools import cache

import numpy as np
import pandas as pd
import pytest
import torch
from outside_mean import Mean

from augment import Mixed, SyntheticPositions, choose_model, mix, synthetic_positions, turbo_learning, withhold
from augment.estimators import Estimator, make_estimator
from swiftwrf import AngularGrid, FieldModel, InputError, Spectra, simulated_room
from swiftwrf.metrics import angle_errors
from swiftwrf.models.neighbours import IDWModel

ROOM = simulated_room(n=40, grid=AngularGrid.hemisphere(8, 32))
OPTIONS = {"measured": 0.5, "estimators": ["peak"], "extra": 0}
SYNTHESIZE = IDWModel.synthesize


def own(**methods):
    """A field model with other methods."""
    return type("Mine", (IDWModel,), {"name": "mine"} | methods)()


def of_spectra(change):
    """A field model whose spectra are changed."""
    return own(synthesize=lambda self, position: change(SYNTHESIZE(self, position)))


@cache
def expected():
    """Median errors with the field model as it is."""
    return turbo_learning(ROOM, models=[own()], **OPTIONS).summary()["median"]


SAME = {
    "as it is": lambda spectra: spectra,
    "numpy": lambda spectra: spectra.numpy(),
    "double": lambda spectra: spectra.double(),
    "gradient": lambda spectra: spectra.requires_grad_(True),
    "list": lambda spectra: spectra.tolist(),
    "bytes": lambda spectra: (255 * spectra).round().to(torch.uint8),
    "bytes of numpy": lambda spectra: (255 * spectra).round().numpy().astype(np.uint8),
}


@pytest.mark.parametrize("form", SAME)
def test_spectra_of_ones_own_model_count_in_every_form_that_spectra_have(form):
    found = turbo_learning(ROOM, models=[of_spectra(SAME[form])], **OPTIONS).summary()["median"]
    pd.testing.assert_series_equal(found, expected(), rtol=0.02)


WRONG = {
    "nan": (lambda spectra: spectra * math.nan, "finite; row 0"),
    "some nan": (lambda spectra: spectra.index_fill(0, torch.tensor([1]), math.nan), "finite; row 1"),
    "infinite": (lambda spectra: spectra * math.inf, "finite"),
    "negative": (lambda spectra: -spectra, r"magnitudes in \[0, 1\], got -"),
    "above 1": (lambda spectra: 5 * spectra, r"magnitudes in \[0, 1\]"),
    "as bytes in float": (lambda spectra: 255 * spectra, r"magnitudes in \[0, 1\]"),
    "one": (lambda spectra: spectra[:1], r"shape \(\d+, 8, 32\), got \(1, 8, 32\)"),
    "another grid": (lambda spectra: spectra[:, :5], r"shape \(\d+, 8, 32\), got \(\d+, 5, 32\)"),
    "transposed": (lambda spectra: spectra.mT, r"got \(\d+, 32, 8\)"),
    "nothing": (lambda spectra: None, "numbers of equal rows, got NoneType"),
    "complex": (lambda spectra: spectra.to(torch.complex64), "must be real"),
    "true and false": (lambda spectra: spectra > 0.5, "must be float32 numbers, got torch.bool"),
}


@pytest.mark.parametrize("wrong", WRONG)
def test_what_is_no_spectra_on_the_grid_is_refused_with_the_class(wrong):
    change, words = WRONG[wrong]
    with pytest.raises(InputError, match=f"spectra of Mine .*{words}"):
        turbo_learning(ROOM, models=[of_spectra(change)], **OPTIONS)
    left_out = choose_model(ROOM, [of_spectra(change), "nearest"]).left_out
    assert left_out["mine"].startswith("spectra of Mine ")
    measured, withheld = withhold(ROOM, 0.5, 0)
    with pytest.raises(InputError, match=f"synthetic spectra .*{words}"):
        mix(measured, withheld, change(measured.spectrum[: len(withheld)]))


@pytest.mark.parametrize("result", [None, 3])
def test_a_fit_that_returns_another_value_counts_by_what_it_has_learnt(result):
    def fit(self, *arguments, **options):
        IDWModel.fit(self, *arguments, **options)
        return result

    found = turbo_learning(ROOM, models=[own(fit=fit)], **OPTIONS).summary()["median"]
    pd.testing.assert_series_equal(found, expected())
    with pytest.raises(InputError, match="this Mine is not fitted; call fit first"):
        turbo_learning(ROOM, models=[own(fit=lambda self, *arguments, **options: result)], **OPTIONS)


def of_two_methods(mean, std=None):
    """A field model of `_fit` and `_predict`, fitted."""

    class Two(FieldModel):
        def _fit(self, train, **_):
            pass

        def _predict(self, position, grid, with_std):
            return mean(torch.full((len(position), *grid.shape), 0.5)), std

    return Two().fit(ROOM)


@pytest.mark.parametrize(
    ("mean", "words"),
    [
        (lambda x: x * math.nan, "not finite"),
        (lambda x: x / 0, "not finite"),
        (lambda x: x[:1], r"of shape \(3, 8, 32\), got torch.float32 \(1, 8, 32\)"),
        (lambda x: x[:, 0], r"of shape \(3, 8, 32\)"),
        (lambda x: (255 * x).to(torch.uint8), "floating-point tensor .*, got torch.uint8"),
        (lambda x: x.numpy(), "floating-point tensor .*, got ndarray"),
        (lambda x: None, "floating-point tensor .*, got NoneType"),
    ],
)
def test_what_a_model_of_two_methods_predicts_is_checked_before_it_is_clipped(mean, words):
    with pytest.raises(InputError, match=f"^Two .*{words}"):
        of_two_methods(mean).predict(ROOM.position[:3])
    with pytest.raises(InputError, match=r"^Two .*not finite"):
        of_two_methods(lambda x: x, torch.full((3, 8, 32), math.nan)).predict(ROOM.position[:3])


class Zero(Estimator):
    """Estimates one direction."""

    def _fit(self, train, device):
        pass

    def predict(self, spectra):
        return torch.zeros(len(spectra), 2)


DIRECTIONS = {
    "nan": (lambda found: found * math.nan, "finite"),
    "degrees": (lambda found: found + 90, r"\[rad\], got \[90.0, 90.0\]; convert degrees by deg2rad"),
    "one": (lambda found: found[:1], r"shape \(\d+, 2\), got \(1, 2\)"),
    "vectors": (lambda found: torch.zeros(len(found), 3), r"shape \(\d+, 2\), got \(\d+, 3\)"),
    "azimuth alone": (lambda found: found[:, 0], r"shape \(\d+, 2\)"),
    "nothing": (lambda found: None, "numbers of equal rows, got NoneType"),
    "numpy": (lambda found: found.numpy(), ""),
    "list": (lambda found: found.tolist(), ""),
    "gradient": (lambda found: found.requires_grad_(True), ""),
}


@pytest.mark.parametrize("through", ["predict", "estimate"])
@pytest.mark.parametrize("form", DIRECTIONS)
def test_directions_of_ones_own_estimator_count_or_are_refused_with_its_class(form, through):
    change, words = DIRECTIONS[form]
    one = type("Mine", (Zero,), {through: lambda self, given: change(torch.zeros(len(given), 2))})()
    if words:
        with pytest.raises(InputError, match=f"directions of Mine must .*{words}"):
            turbo_learning(ROOM, **OPTIONS | {"models": ["idw"], "estimators": [one]})
        return
    found = turbo_learning(ROOM, **OPTIONS | {"models": ["idw"], "estimators": [one]}).errors
    own = found[found.method == "Mine, measured"]
    # from the direction 0, 0, the angle is that between its label and the x axis
    azimuth, elevation = ROOM.label[torch.tensor(own["index"].tolist())].numpy().T
    angle = np.degrees(np.arccos(np.cos(elevation) * np.cos(azimuth)))
    np.testing.assert_allclose(own["great_circle_deg"], angle, atol=1e-3)


def test_an_estimator_that_changes_its_training_set_changes_no_other():
    class Careless(Zero):
        def _fit(self, train, device):
            train.label.zero_()

    options = OPTIONS | {"models": ["idw"]}
    alone = turbo_learning(ROOM, **options).summary()["median"]
    both = turbo_learning(ROOM, **options | {"estimators": ["peak", Careless()]}).summary()["median"]
    pd.testing.assert_series_equal(both[alone.index], alone)
    data = simulated_room(n=20, grid=ROOM.grid)
    Careless().fit(Mixed.measured(data))
    assert data.label.abs().sum() > 0


@pytest.mark.parametrize("name", ["kernel_regression", "aann_kernel"])  # which solve with a Gram matrix
@pytest.mark.parametrize("noise", [0.0, 1e-7])
def test_estimators_are_trained_on_one_spectrum_at_many_positions(name, noise):
    """The squared distances between the rows are rounding errors alone."""
    data = simulated_room(n=100, seed=1)
    train, test = data.subset(torch.arange(80)), data.subset(torch.arange(80, 100))
    estimator = make_estimator(name, **({"steps": 1, "batch": 4} if name == "aann_kernel" else {}))
    at = torch.arange(400) % 40
    measured, withheld = withhold(train, 0.5, 0)
    many = SyntheticPositions(*(values[at] for values in (withheld.position, withheld.label, withheld.index)))
    spectra = Mean().fit(measured).synthesize(many.position)
    spectra = (spectra + noise * torch.randn(spectra.shape, generator=torch.Generator().manual_seed(0))).clamp(0, 1)
    estimate = estimator.fit(mix(measured, many, spectra)).estimate(test)
    assert estimate.isfinite().all()
    if name == "kernel_regression":
        alone = make_estimator(name).fit(Mixed.measured(measured)).estimate(test)
        error = [angle_errors(one, test.label)["great_circle"].median() for one in (estimate, alone)]
        assert error[0] < 1.5 * error[1]


def test_turbo_learning_with_a_constant_synthesizer():
    result = turbo_learning(simulated_room(n=60), measured=0.5, models=[Mean()], estimators=["peak"], extra=300)
    assert np.isfinite(result.summary()["median"]).all()


@pytest.mark.parametrize(
    ("words", "call"),
    [
        ("models is empty; name at least one", lambda: turbo_learning(ROOM, **OPTIONS, models=[])),
        (
            "extra must be .* at most 1000000 or None, got 1000000000",
            lambda: turbo_learning(ROOM, **OPTIONS | {"extra": 10**9}),
        ),
        ("n must be .* at most 1000000, got 1000000000", lambda: synthetic_positions(ROOM, 10**9, 0)),
        (
            r"begins with a letter, without slashes, got '\.\./x'",
            lambda: turbo_learning(ROOM, models=[own(name="../x")]),
        ),
        ("begins with a letter, without slashes, got ''", lambda: turbo_learning(ROOM, models=[own(name="")])),
        (
            r"turbo_learning\(\) got an unexpected keyword argument 'modells'; it takes data, measured",
            lambda: turbo_learning(ROOM, modells=["idw"]),
        ),
        (
            "32 of 32 spectra have no direction; give label, or pose and moving end",
            lambda: turbo_learning(Spectra(ROOM.store[:], ROOM.position), **OPTIONS, models=["idw"]),
        ),
        (
            "label must be azimuth up to 2 pi",
            lambda: mix(ROOM, SyntheticPositions(ROOM.position, ROOM.label + 90, ROOM.index), ROOM.spectrum),
        ),
    ],
)
def test_what_cannot_be_computed_is_refused_before_anything_is(words, call):
    with pytest.raises(InputError, match=words):
        call()
