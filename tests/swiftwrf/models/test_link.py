"""A model is applied to measurements of the link that it was fitted to, and to no other."""

from dataclasses import replace

import pytest
import torch
from rooms import floor_channels
from small import COARSE, COARSEST, small
from small import FLOOR as FLOOR_PLANE

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
    predict,
    rssi_room,
)
from swiftwrf.array.planar import PlanarArray
from swiftwrf.contrib.online import Follower, score
from swiftwrf.models.geometry import HybridModel

pytestmark = pytest.mark.usefixtures("without_furniture")
FLOOR = rssi_room(n=100)
QUARTER = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]], dtype=torch.float64)
OTHER_LINKS = {
    r"another moving end \(receiver, not transmitter\); give": {"moving": "receiver"},
    "another position of the fixed end; give": {"fixed_position": torch.tensor([1.0, 2, 3]).double()},
    "another orientation of the array; give": {"rotation": QUARTER},
    "another arrangement of the elements, carrier; give": {"array": PlanarArray.square(4, 5.2e9)},
}
other_links = pytest.mark.parametrize(("says", "change"), OTHER_LINKS.items(), ids=["end", "place", "pose", "array"])


OTHER_BANDS = {
    "40 MHz higher": lambda frequency: frequency + 40e6,
    "half the bandwidth": lambda frequency: frequency[0] + (frequency - frequency[0]) / 2,
    "one subcarrier moved": lambda frequency: torch.cat([frequency[:-1], frequency[-1:] + 1e5]),
}


def given_room(data):
    return GeometryModel.of_planes(data, [FLOOR_PLANE])


@pytest.fixture(scope="module")
def models(room):
    known = given_room(room)
    with small("path gains", "kernels"):
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


@pytest.fixture(scope="module")
def channels():
    return floor_channels()


@pytest.fixture(scope="module")
def locator(channels):
    return MatchedField(**COARSE).fit(channels.subset(range(30)), room=given_room(channels))


@pytest.fixture
def descending(channels):
    return replace(channels, channel=channels.channel.flip(1), frequency_hz=channels.frequency_hz.flip(0))


def test_subcarriers_in_another_order_are_the_same_channels(channels, descending, locator, tmp_path):
    new, other = channels.subset(range(30, 40)), descending.subset(range(30, 40))
    locator.save(tmp_path / "locator")
    for same in (locator, load(tmp_path / "locator")):
        expected = same.locate(new.channel).median
        torch.testing.assert_close(same.locate(other).median, expected)
        torch.testing.assert_close(torch.tensor(predict(same, other)[["x_m", "y_m", "z_m"]].to_numpy()), expected)
    refitted = MatchedField(locator.config).fit(descending.subset(range(30)), room=given_room(channels))
    torch.testing.assert_close(refitted.locate(other).median, locator.locate(new).median)
    room = given_room(channels)
    found = [room.update(data).planes[0].offset_m for data in (channels, descending)]
    assert found[0] == found[1]


@pytest.mark.parametrize("band", OTHER_BANDS.values(), ids=OTHER_BANDS)
def test_channels_of_another_band_are_refused(channels, locator, band):
    other = replace(channels, frequency_hz=band(channels.frequency_hz))
    room, gp = given_room(channels), make_model("gp").fit(channels)
    for use in (
        locator.locate,
        locator.predict,
        lambda new: predict(locator, new),
        lambda new: MatchedField(locator.config).fit(new, room=room),
        lambda new: GeometryModel().fit(new, like=room),
        room.update,
        gp.update,
        lambda new: score(gp, new),
    ):
        with pytest.raises(
            InputError, match="another link than the training spectra, with another set of frequencies;"
        ):
            use(other)


@other_links
def test_a_locator_refuses_measurements_of_another_link(channels, locator, says, change):
    other = replace(channels, **{"frequency_hz": None} | change)  # frequencies fit one carrier alone
    for use in (locator.locate, locator.predict, lambda new: predict(locator, new)):
        with pytest.raises(InputError, match=says):
            use(other)


def test_what_spectra_do_not_describe_is_not_compared(room, models):
    bare = replace(room, rotation=None, fixed_position=None, index=torch.arange(40, 80))
    assert len(models[0].update(bare).process.known) == 2 * len(room)
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
        (replace(FLOOR, receiver_names=(*FLOOR.receiver_names[:-1], "other")), "give these"),
        (FLOOR.columns([0, 1, 2]), "give these"),
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
    assert not model.path_loss.slope.any()
    assert not model.posterior.feature[..., 2:].any()  # nor directivity
    model.save(tmp_path / "model")
    again = load(tmp_path / "model")
    assert again.receiver_position.isnan().all()
    new = replace(FLOOR.subset(torch.arange(5)), index=torch.arange(100, 105))
    torch.testing.assert_close(again.update(new).path_loss.level, model.update(new).path_loss.level)


@pytest.mark.parametrize(
    ("model", "last_step"),
    [
        (make_model("coarray"), "_fit_spread"),
        (RssiModel(), "_calibrate"),
        (RssiLocator(n_cells=50), "_calibrate"),
        (MatchedField(**COARSEST), "_calibrate"),
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
