"""Synthesizers, and the promise that nothing withheld leaks into a training set."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from small import GLANCE, PUBLISHED

from augment import (
    SYNTHESIZERS,
    Settings,
    Synthesizer,
    choose_synthesizer,
    draw_places,
    make_synthesizer,
    mix,
    withhold,
)
from augment.choose import candidates
from augment.places import draw_positions
from augment.synthesizers.idw import weights
from swiftwrf import AngularGrid, FitConfig, InputError, ModelConfig, simulated_room
from swiftwrf.data.store import Store
from swiftwrf.metrics import psnr
from swiftwrf.runtime.registry import Entry

ROOM = simulated_room(n=60, seed=3, grid=AngularGrid.hemisphere(15, 60))
TRAIN, TEST = ROOM.split("random", 0)
SHORT = FitConfig(model=ModelConfig(n_primitives=32))  # the search for a size has its own tests
MARGIN_DB = {"nearest": -1.0}  # so few positions are too far apart for a copy


class Recorder(Synthesizer):
    """A synthesizer that remembers what it was shown."""

    def fit(self, train):
        self.shown = train

    def synthesize(self, position):
        return torch.full((len(position), *self.shown.grid.shape), -1.0)


@settings(max_examples=40, deadline=None)
@given(st.floats(0.22, 1.0), st.integers(0, 2**31))
def test_nothing_withheld_and_no_test_spectrum_leaks(share, seed):
    measured, withheld = withhold(TRAIN, share, seed)
    recorder = Recorder(Settings())
    recorder.fit(measured)
    mixed = mix(measured, withheld, recorder.synthesize(withheld.position))

    assert len(measured) == round(share * len(TRAIN))
    shown, hidden, test = (set(x.tolist()) for x in (recorder.shown.index, withheld.index, TEST.index))
    assert shown | hidden == set(TRAIN.index.tolist())
    assert not shown & hidden
    assert not (shown | hidden) & test
    # each sample is what its origin says: the measured spectrum of its index, or the synthesizer's
    for spectrum, index, synthetic in zip(mixed.spectrum, mixed.index.tolist(), mixed.synthetic.tolist(), strict=True):
        assert synthetic == (index in hidden)
        assert torch.equal(spectrum, torch.full_like(spectrum, -1.0) if synthetic else ROOM.spectrum[index])
    torch.testing.assert_close(mixed.label, ROOM.label[mixed.index])


def test_places_have_no_spectrum_to_leak():
    _, withheld = withhold(TRAIN, 0.5, 0)
    assert tuple(vars(withheld)) == ("position", "label", "index")


@pytest.mark.parametrize(("share", "says"), [(0.0, "in \\(0, 1\\]"), (1.1, "in \\(0, 1\\]"), (0.1, "leaves 5 of 48")])
def test_withhold_refuses(share, says):
    with pytest.raises(InputError, match=says):
        withhold(TRAIN, share, 0)


def test_mix_refuses_a_wrong_number_of_spectra():
    measured, withheld = withhold(TRAIN, 0.5, 0)
    with pytest.raises(InputError, match="one synthetic spectrum for each of 24"):
        mix(measured, withheld, TRAIN.spectrum[:3])


@pytest.mark.parametrize("name", [name for name in SYNTHESIZERS if name not in PUBLISHED])  # they have their own
def test_synthesizers_draw_unseen_spectra_better_than_the_mean_spectrum(name, glances, monkeypatch):
    monkeypatch.setattr("augment.synthesizers.swiftwrf.FitConfig", lambda: SHORT)
    monkeypatch.setattr("small.GLANCE", replace(GLANCE, reach=2.5, positions=24))  # a glance as far as the walls
    synthesizer = make_synthesizer(name)
    synthesizer.fit(TRAIN)
    drawn = synthesizer.synthesize(TEST.position)
    assert drawn.shape == TEST.spectrum.shape
    assert drawn.dtype == torch.float32
    assert drawn.min() >= 0
    assert drawn.max() <= 1
    mean = psnr(TRAIN.spectrum.mean(dim=0), TEST.spectrum).median()
    assert psnr(drawn, TEST.spectrum).median() > mean + MARGIN_DB.get(name, 0.5)


@pytest.mark.parametrize("name", ["nearest", "idw"])
def test_look_ups_return_measured_spectra_at_measured_positions(name):
    synthesizer = make_synthesizer(name)
    synthesizer.fit(TRAIN)
    torch.testing.assert_close(synthesizer.synthesize(TRAIN.position), TRAIN.spectrum, atol=1e-5, rtol=0)


def test_idw_of_two_neighbours_is_their_weighted_mean():
    known = torch.tensor([[0.0, 0, 0], [9, 0, 0], [3, 0, 0]]).double()
    number, weight = weights(torch.tensor([[1.0, 0, 0]]), known, 2)
    assert number[0].tolist() == [0, 2]
    assert weight[0].tolist() == pytest.approx([2 / 3, 1 / 3])


def test_unknown_synthesizer():
    with pytest.raises(InputError, match="choose from coarray, dcgan, geometry, gp"):
        make_synthesizer("forest")


@pytest.mark.parametrize("flat", [0, 1, 2])
def test_drawn_places_lie_in_the_region_with_the_right_directions(flat):
    """In the hull, also of positions in a plane or on a line, and near measured positions."""
    data = simulated_room(n=40, seed=1, grid=AngularGrid.hemisphere(15, 60))
    position = data.position.clone()
    position[:, :flat] = 3.0
    data = replace(data, position=position, label=data.direction_at(position))
    places = draw_places(data, 200, seed=0)
    assert len(places) == 200
    assert (places.index == -1).all()
    low, high = position.min(dim=0).values, position.max(dim=0).values
    assert ((places.position >= low - 1e-9) & (places.position <= high + 1e-9)).all()
    torch.testing.assert_close(places.label, data.direction_at(places.position))
    assert torch.equal(places.position, draw_places(data, 200, seed=0).position)


def test_places_are_not_drawn_inside_a_ring():
    angle = torch.linspace(0, 2 * torch.pi, 61, dtype=torch.float64)[:-1]
    ring = torch.stack([3 + angle.cos(), 2.5 + angle.sin(), torch.full_like(angle, 1.0)], dim=1)
    data = replace(simulated_room(n=60, grid=AngularGrid.hemisphere(15, 60)), position=ring)
    places = draw_places(data, 100, seed=0)
    assert (places.position[:, :2] - torch.tensor([3.0, 2.5])).norm(dim=1).min() > 0.4


@pytest.mark.parametrize("jitter", [0.0, 1e-3])
def test_places_are_drawn_between_spots_that_were_measured_again_and_again(jitter):
    generator = torch.Generator().manual_seed(0)
    spot = 10 * torch.rand(30, 2, dtype=torch.float64, generator=generator).repeat_interleave(12, 0)
    spot = spot + jitter * torch.randn(360, 2, dtype=torch.float64, generator=generator)
    known = torch.cat([spot, torch.full((360, 1), 1.5, dtype=torch.float64)], dim=1)
    drawn = draw_positions(known, 100, seed=0)
    assert len(drawn) == 100
    assert torch.cdist(drawn, known).amin(dim=1).max() > 10 * jitter


def test_direction_needs_to_know_the_fixed_end():
    with pytest.raises(InputError, match="where the fixed end stands"):
        draw_places(replace(ROOM, fixed_position=None), 10, seed=0)


@pytest.mark.parametrize("name", ["gp", "coarray"])
def test_samples_scatter_about_the_mean_and_are_as_varied_as_measured_spectra(name):
    synthesizer = make_synthesizer(name)
    synthesizer.fit(TRAIN)
    assert synthesizer.samples
    mean = synthesizer.synthesize(TEST.position)
    draws = torch.stack(
        [synthesizer.synthesize(TEST.position, torch.Generator().manual_seed(seed)) for seed in range(40)]
    )
    assert not torch.equal(draws[0], draws[1])
    assert (draws.mean(dim=0) - mean).abs().mean() < 0.3 * draws.std(dim=0).mean()
    spread = [spectra.std(dim=0).mean() for spectra in (TEST.spectrum, mean, draws[0])]
    assert spread[1] < spread[2] < 1.3 * spread[0]


def test_counts_say_where_spectra_come_from():
    measured, withheld = withhold(TRAIN, 0.5, 0)
    further = draw_places(measured, 7, seed=0)
    mixed = mix(measured, withheld, torch.zeros(len(withheld), 15, 60)).add(further, torch.zeros(7, 15, 60))
    assert mixed.counts == {"measured": len(measured), "withheld": len(withheld), "further": 7}


def test_choice_takes_the_best_on_held_out_spectra_and_sees_nothing_else():
    chosen = choose_synthesizer(TRAIN, Settings(), ("nearest", "idw", "gp"))
    assert set(chosen.psnr_db) == {"nearest", "idw", "gp"}
    assert chosen.psnr_db[chosen.name] == max(chosen.psnr_db.values())
    assert "geometry" in candidates(TRAIN)
    assert not set(PUBLISHED) & set(candidates(TRAIN))  # they take minutes
    assert not {"geometry", "hybrid", "coarray"} & set(candidates(replace(TRAIN, array=None)))
    spectrum = TRAIN.spectrum.clone()
    spectrum[5, 2, 3] = torch.nan
    with pytest.raises(InputError, match="spectrum of training spectrum 5 is not finite"):
        choose_synthesizer(replace(TRAIN, store=Store(spectrum)), Settings(), ("nearest", "gp"))


@settings(max_examples=15, deadline=None)
@given(st.floats(0.3, 0.9), st.integers(0, 2**31))
def test_choice_advice_and_further_places_see_the_measured_share_alone(share, seed):
    """Every spectrum that any fit is shown is measured; places are drawn from measured positions alone."""
    measured, withheld = withhold(TRAIN, share, seed)
    shown = []

    class Spy(Recorder):
        def fit(self, train):
            super().fit(train)
            shown.append(train)

    entries = dict(SYNTHESIZERS._entries)
    SYNTHESIZERS._entries = {"spy": Entry("spy", Spy, "watches")}
    try:
        choice = choose_synthesizer(measured, Settings(seed=seed % 1000), ("spy",))
    finally:
        SYNTHESIZERS._entries = entries
    own = set(measured.index.tolist())
    assert len(shown) == len(choice.trials) == 5
    for trial, train in zip(choice.trials, shown, strict=True):
        kept, out = (set(part.index.tolist()) for part in (train, trial.out))
        assert not kept & out
        assert kept | out == own
        assert torch.equal(train.spectrum, ROOM.spectrum[train.index])
    assert not own & (set(withheld.index.tolist()) | set(TEST.index.tolist()))
    blank = replace(measured, store=Store(torch.full_like(measured.spectrum, torch.nan)))
    assert torch.equal(draw_places(blank, 9, 0).position, draw_places(measured, 9, 0).position)
