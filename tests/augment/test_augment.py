"""Field models as synthesizers, and the promise that no withheld spectrum leaks into a training set."""

from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from unittest import mock

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from rooms import built_in_walls
from small import PUBLISHED, known_planes, only, small

from augment import choose_model, mix, sample_positions, synthetic_positions, withhold
from augment.choose import candidates
from swiftwrf import AngularGrid, InputError, simulated_room
from swiftwrf.data.store import Store
from swiftwrf.metrics import psnr
from swiftwrf.models import FIELD_MODELS, FieldModel, make_model
from swiftwrf.models.geometry import model as geometry
from swiftwrf.models.neighbours import weights

ROOM = simulated_room(n=60, seed=3, grid=AngularGrid.hemisphere(15, 60))
TRAIN, TEST = ROOM.split("random", 0)
OPTIONS = {"swiftwrf": {"n_primitives": 32}}  # the search for a size has its own tests
# So few positions are too far apart for a copy. Materials follow from gains, and a glance misses those of weak walls.
MARGIN_DB = {"nearest": -1.0, "raytrace": 0.3}


class Recorder(FieldModel):
    """A field model that stores the spectra of its fit."""

    name = "recorder"
    kind = "recorder"
    saved = ""

    def _fit(self, train, like=None, **_):
        self.train = train

    def _predict(self, position, grid, with_std):
        return torch.full((len(position), *grid.shape), 2.0), None


@settings(max_examples=6, deadline=None)
@given(st.floats(0.22, 1.0), st.integers(0, 2**31))
def test_nothing_withheld_and_no_test_spectrum_leaks(share, seed):
    measured, withheld = withhold(TRAIN, share, seed)
    recorder = Recorder().fit(measured)
    mixed = mix(measured, withheld, recorder.synthesize(withheld.position))

    assert len(measured) == round(share * len(TRAIN))
    shown, hidden, test = (set(x.tolist()) for x in (recorder.train.index, withheld.index, TEST.index))
    assert shown | hidden == set(TRAIN.index.tolist())
    assert not shown & hidden
    assert not (shown | hidden) & test
    spectra = ROOM.spectrum
    # each spectrum has its origin: the measured spectrum of its index, or the prediction
    for spectrum, index, synthetic in zip(mixed.spectrum, mixed.index.tolist(), mixed.synthetic.tolist(), strict=True):
        assert synthetic == (index in hidden)
        assert torch.equal(spectrum, torch.ones_like(spectrum) if synthetic else spectra[index])
    torch.testing.assert_close(mixed.label, ROOM.label[mixed.index])


def test_rows_of_a_training_set_are_selected_in_any_order():
    measured, withheld = withhold(TRAIN, 0.5, 0)
    mixed = mix(measured, withheld, torch.rand(len(withheld), 15, 60))
    rows = torch.randperm(len(mixed), generator=torch.Generator().manual_seed(0))[:30]
    assert torch.equal(mixed.select(rows), mixed.spectrum[rows])


@cache
def fitted(name):
    """A field model of the training spectra; the search for a room takes most of the time of the two that have one."""
    like = fitted("geometry") if name == "hybrid" else None
    return make_model(name, **OPTIONS.get(name, {})).fit(TRAIN, like=like)


@pytest.mark.parametrize("name", [name for name in FIELD_MODELS if not FIELD_MODELS[name].slow])  # they have their own
def test_field_models_predict_unseen_spectra_better_than_the_mean_spectrum(name):
    """The search for the walls has its own tests."""
    with known_planes(*built_in_walls()), small("path gains"):
        predicted = fitted(name).synthesize(TEST.position)
    mean = psnr(TRAIN.spectrum.mean(dim=0), TEST.spectrum).median()
    assert psnr(predicted, TEST.spectrum).median() > mean + MARGIN_DB.get(name, 0.5)


@pytest.mark.parametrize("name", ["nearest", "idw"])
def test_look_ups_return_measured_spectra_at_measured_positions(name):
    model = make_model(name).fit(TRAIN)
    torch.testing.assert_close(model.synthesize(TRAIN.position), TRAIN.spectrum, atol=1e-5, rtol=0)


def test_idw_of_two_neighbours_is_their_weighted_mean():
    known = torch.tensor([[0.0, 0, 0], [9, 0, 0], [3, 0, 0]]).double()
    number, weight = weights(torch.tensor([[1.0, 0, 0]]), known, 2)
    assert number[0].tolist() == [0, 2]
    assert weight[0].tolist() == pytest.approx([2 / 3, 1 / 3])


@pytest.mark.parametrize("flat", [0, 1, 2])
def test_drawn_positions_lie_in_the_region_with_the_right_directions(flat):
    """In the hull, also of positions in a plane or on a line, and near measured positions."""
    data = simulated_room(n=40, seed=1, grid=AngularGrid.hemisphere(15, 60))
    position = data.position.clone()
    position[:, :flat] = 3.0
    data = replace(data, position=position, label=data.direction_at(position))
    positions = synthetic_positions(data, 200, seed=0)
    assert len(positions) == 200
    assert (positions.index == -1).all()
    low, high = position.min(dim=0).values, position.max(dim=0).values
    assert ((positions.position >= low - 1e-9) & (positions.position <= high + 1e-9)).all()
    torch.testing.assert_close(positions.label, data.direction_at(positions.position))
    assert torch.equal(positions.position, synthetic_positions(data, 200, seed=0).position)


def test_positions_are_not_drawn_inside_a_ring():
    angle = torch.linspace(0, 2 * torch.pi, 61, dtype=torch.float64)[:-1]
    ring = torch.stack([3 + angle.cos(), 2.5 + angle.sin(), torch.full_like(angle, 1.0)], dim=1)
    data = replace(simulated_room(n=60, grid=AngularGrid.hemisphere(15, 60)), position=ring)
    positions = synthetic_positions(data, 100, seed=0)
    assert (positions.position[:, :2] - torch.tensor([3.0, 2.5])).norm(dim=1).min() > 0.4


@pytest.mark.parametrize("jitter", [0.0, 1e-3])
def test_positions_are_drawn_between_spots_that_were_measured_again_and_again(jitter):
    generator = torch.Generator().manual_seed(0)
    spot = 10 * torch.rand(30, 2, dtype=torch.float64, generator=generator).repeat_interleave(12, 0)
    spot = spot + jitter * torch.randn(360, 2, dtype=torch.float64, generator=generator)
    known = torch.cat([spot, torch.full((360, 1), 1.5, dtype=torch.float64)], dim=1)
    drawn = sample_positions(known, 100, seed=0)
    assert len(drawn) == 100
    assert torch.cdist(drawn, known).amin(dim=1).max() > 10 * jitter


def test_choice_takes_the_best_on_held_out_spectra():
    chosen = choose_model(TRAIN, ("nearest", "idw", "gp"))
    assert set(chosen.psnr_db) == {"nearest", "idw", "gp"}
    assert chosen.psnr_db[chosen.name] == max(chosen.psnr_db.values())
    assert "geometry" in candidates(TRAIN)
    assert not set(PUBLISHED) & set(candidates(TRAIN))  # they take minutes
    assert not {"geometry", "hybrid", "coarray"} & set(candidates(replace(TRAIN, array=None)))


@contextmanager
def spied():
    """Register a field model and yield its fits: the training spectra, and those of the structure that it reuses."""
    fits = []

    class Spy(Recorder):
        searches = True

        def _fit(self, train, like=None, **_):
            super()._fit(train)
            structure = like.structure if like else train
            self.structure = structure
            fits.append((train, structure))

    with only(FIELD_MODELS, *FIELD_MODELS, spy=Spy):
        yield fits


def rows_of(spectra):
    return set(spectra.index.tolist())


@settings(max_examples=4, deadline=None)
@given(st.floats(0.3, 0.9), st.integers(0, 2**31))
def test_choice_cross_validation_and_synthetic_positions_use_the_measured_fraction_alone(fraction, seed):
    """Every spectrum of every fit is measured; synthetic positions depend on measured positions alone."""
    measured, withheld = withhold(TRAIN, fraction, seed)
    with spied() as fits:
        choice = choose_model(measured, ("spy",), seed=seed % 1000)
    own = rows_of(measured)
    for train, _ in fits:
        assert rows_of(train) <= own
        assert torch.equal(train.spectrum, ROOM.spectrum[train.index])
    for fold in choice.folds["spy"]:
        train, test = rows_of(fold.train), rows_of(fold.test)
        assert not train & test
        assert train | test == own
    assert not own & (rows_of(withheld) | rows_of(TEST))
    blank = replace(measured, store=Store(torch.full_like(measured.spectrum, torch.nan)))
    assert torch.equal(synthetic_positions(blank, 9, 0).position, synthetic_positions(measured, 9, 0).position)


@pytest.mark.parametrize("n", [11, 12, 13, 17, 18, 48])
def test_held_out_spectra_take_no_part_in_the_structure_search(n):
    measured = TRAIN.subset(torch.arange(n))
    with spied():
        scored = choose_model(measured, ("spy",)).folds["spy"]
    held_out = [rows_of(fold.test) for fold in scored]
    assert sum(map(len, held_out)) == len(set().union(*held_out))  # each spectrum is scored once at most
    for fold in scored:
        assert not rows_of(fold.model.structure) & rows_of(fold.test)
        assert rows_of(fold.train) | rows_of(fold.test) == rows_of(measured)
    searches = {frozenset(rows_of(fold.model.structure)) for fold in scored}
    assert len(searches) == (2 if n >= 18 else len(scored))


def test_models_with_a_room_share_its_search(floor_alone, short_fits, monkeypatch):
    searched, search = [], geometry.search_room
    monkeypatch.setattr(geometry, "search_room", lambda *given: searched.append(1) or search(*given))
    choice = choose_model(TRAIN, ("geometry", "hybrid"))
    assert set(choice.psnr_db) == {"geometry", "hybrid"}
    assert len(searched) == 2  # one for each pair of folds
    held_out = {name: [rows_of(fold.test) for fold in scored] for name, scored in choice.folds.items()}
    assert held_out["hybrid"] == held_out["geometry"]


def test_candidates_that_cannot_be_fitted_are_returned_with_the_reason():
    bare = replace(TRAIN, array=None)
    chosen = choose_model(bare, ("gp", "coarray"))
    assert chosen.left_out == {"coarray": "coarray needs the array, which simulated-room does not describe"}
    assert "without coarray: coarray needs the array" in repr(chosen)
    assert len(repr(chosen)) < 200
    with pytest.raises(InputError, match=r"no field model can be fitted .*coarray needs the array"):
        choose_model(bare, ("coarray",))


def test_models_without_a_structure_are_fitted_once_for_each_scored_fold():
    with spied() as fits, mock.patch.object(FIELD_MODELS["spy"], "searches", new=False):
        choose_model(TRAIN, ("spy",))
    assert len(fits) == 4


class Mean(FieldModel):
    """Two methods are a field model."""

    def _fit(self, train, **_):
        self.mean = train.store.mean()

    def _predict(self, position, grid, with_std):
        return self.mean.expand(len(position), -1, -1), None


def test_classes_and_models_are_candidates_like_names():
    alone = choose_model(TRAIN, ("idw",), seed=3)
    model = make_model("idw", seed=3)
    chosen = choose_model(TRAIN, (model, Mean), seed=3)
    assert chosen.name == "idw"
    assert chosen.psnr_db["idw"] == alone.psnr_db["idw"] > chosen.psnr_db["Mean"]
    assert not model.is_fitted


def test_a_model_of_two_methods_is_registered_fitted_and_refuses_to_be_saved(tmp_path):
    with only(FIELD_MODELS):
        FIELD_MODELS.register("mine")(Mean)
        model = make_model("mine").fit(TRAIN)
    assert "Mean" in model._repr_html_()
    with pytest.raises(InputError, match="Mean cannot be saved; its class must name what `_fit` sets in `saved`"):
        model.save(tmp_path / "model")
    with pytest.raises(InputError, match="Mean: cannot be updated"):
        model.update(TEST)
