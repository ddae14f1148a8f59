"""A model is applied to measurements of the link that it was fitted to, and to no other."""

from dataclasses import replace

import pytest
import torch
from small import FLOOR as FLOOR_PLANE
from small import few_kernels, short_path_gains

from swiftwrf import (
    FieldModel,
    FitError,
    GeometryModel,
    InputError,
    MatchedField,
    PairModel,
    Rssi,
    RssiLocator,
    RssiModel,
    load,
    make_model,
    rssi_room,
)
from swiftwrf.array.planar import PlanarArray
from swiftwrf.models.geometry import HybridModel
from swiftwrf.online import Follower, score

FLOOR = rssi_room(n=100)
QUARTER = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]], dtype=torch.float64)
OTHER_LINKS = {
    r"another moving end \(receiver, not transmitter\); give": {"moving": "receiver"},
    "another position of the fixed end; give": {"fixed_position": torch.tensor([1.0, 2, 3]).double()},
    "another orientation of the array; give": {"rotation": QUARTER},
    "another arrangement of the elements, carrier; give": {"array": PlanarArray.square(4, 5.2e9)},
}
other_links = pytest.mark.parametrize(("says", "change"), OTHER_LINKS.items(), ids=["end", "place", "pose", "array"])


def given_room(data):
    return GeometryModel.of_planes(data, [FLOOR_PLANE])


@pytest.fixture(scope="module")
def models(room):
    known = given_room(room)
    with short_path_gains(), few_kernels():
        closed_form = [make_model(name).fit(room) for name in ("gp", "coarray")]
        return [*closed_form, known, HybridModel().fit(room, like=known)]


@other_links
def test_spectra_of_another_link_are_refused(room, models, tmp_path, says, change):
    """Updates, scores and followers refuse them, also those of a saved model."""
    other = replace(room, **change)
    for model in models:
        model.save(tmp_path / "model")
        for same in (model, load(tmp_path / "model")):
            for use in (same.update, lambda new, same=same: score(same, new)):
                with pytest.raises(InputError, match=says):
                    use(other)
        assert len(score(model, replace(room, rotation=room.rotation + 1e-6)))
    with pytest.raises(InputError, match=says):
        Follower(models[0], other)


@other_links
def test_a_structure_of_another_link_is_refused(room, says, change):
    other = given_room(replace(room, **change))
    for fit in (
        lambda: GeometryModel().fit(room, like=other),
        lambda: HybridModel().fit(room, like=other),
        lambda: MatchedField(spacing=0.5).fit(room, room=other),
    ):
        with pytest.raises(InputError, match="another link"):
            fit()


def test_what_spectra_do_not_describe_is_not_compared(room, models):
    bare = replace(room, rotation=None, fixed_position=None)
    assert len(models[0].update(bare).position) == 2 * len(room)
    with pytest.raises(InputError, match="geometry needs the fixed end"):
        models[2].update(bare)
    assert models[0].fixed_end is not None


@pytest.mark.parametrize("predictor", [RssiModel, PairModel])
def test_rows_at_other_receivers_are_refused(short_fits, tmp_path, predictor):
    model = predictor().fit(FLOOR)
    model.save(tmp_path / "model")
    model = load(tmp_path / "model")
    moved = replace(FLOOR, receiver_position=FLOOR.receiver_position.flip(0))
    for other, says in (
        (FLOOR.columns([*range(12)][::-1]), "give the same ones in this order"),
        (FLOOR.columns([0, 1, 2]), "give the same ones in this order"),
        (moved, "receiver01 .* m away from its position"),
    ):
        with pytest.raises(InputError, match=says):
            model.update(other)
        with pytest.raises(InputError, match=says):
            model.predict_detected(other)
        if predictor is RssiModel:
            with pytest.raises(InputError, match=says):
                RssiLocator(n_cells=500).fit(other, model=model)


def test_unknown_positions_of_receivers_are_not_compared(tmp_path):
    unlocated = Rssi(FLOOR.rssi_dbm, FLOOR.transmitter_position, receiver_names=FLOOR.receiver_names)
    model = RssiModel().fit(unlocated)
    assert not model.slope.any()
    assert not model.directivity.any()
    model.save(tmp_path / "model")
    again = load(tmp_path / "model")
    assert again.receiver_position.isnan().all()
    new = FLOOR.subset(torch.arange(5))
    torch.testing.assert_close(again.update(new).level, model.update(new).level)


@pytest.mark.parametrize(
    ("model", "last_step"),
    [
        (make_model("coarray"), "_set_spread"),
        (RssiModel(), "_set_posterior"),
        (RssiLocator(n_cells=50), "_calibrate"),
        (
            MatchedField(spacing=4.0, max_cells=100, n_best=10, n_background=5, n_split=2, n_calibration=10),
            "_calibrate",
        ),
    ],
    ids=lambda value: type(value).__name__,
)
def test_a_fit_that_fails_leaves_the_model_as_it_was(room, short_fits, model, last_step, monkeypatch):
    spectra = isinstance(model, MatchedField | FieldModel)
    data = room.subset(range(20)) if spectra else FLOOR.subset(range(30)).columns([0, 4, 8])
    options = {"room": given_room(room)} if isinstance(model, MatchedField) else {}
    model.fit(data, **options)
    before = dict(vars(model))

    def fail(*_):
        raise FitError("not now")

    monkeypatch.setattr(type(model), last_step, fail)
    with pytest.raises(FitError):
        model.fit(data, **options)
    assert vars(model).keys() == before.keys()
    assert all(vars(model)[name] is before[name] for name in before)


def test_a_checkpoint_in_no_folder_is_refused_before_the_fit(room, tmp_path, monkeypatch):
    model = make_model("coarray")
    monkeypatch.setattr(type(model), "_fit", lambda *_: pytest.fail("the fit was begun"))
    with pytest.raises(InputError, match=r"folder of the checkpoint .* does not exist; create it"):
        model.fit(room, checkpoint=tmp_path / "none" / "state")


@pytest.mark.parametrize("end", [RuntimeError, KeyboardInterrupt])
def test_an_interrupted_fit_leaves_the_model_as_it_was(room, end):
    model = make_model("swiftwrf", n_primitives=8).fit(room)
    expected = model.synthesize(room.position)

    def stop(record):
        raise end

    with pytest.raises(end):
        model.fit(room.subset(torch.arange(20)), on_record=stop)
    assert torch.equal(model.synthesize(room.position), expected)
