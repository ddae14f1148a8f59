"""Constant, empty, collinear and badly scaled data: finite predictions with a standard deviation, or one sentence."""

from dataclasses import replace
from functools import cache

import pytest
import torch
from small import COARSEST, GLANCE

from swiftwrf import (
    AngularGrid,
    FitError,
    InputError,
    MatchedField,
    PairModel,
    RssiLocator,
    RssiModel,
    make_model,
    rssi_room,
    simulated_room,
)
from swiftwrf.data.store import Store
from swiftwrf.models import FIELD_MODELS
from swiftwrf.models.geometry import search
from swiftwrf.models.geometry.fit import observe
from swiftwrf.rssi.pairs import PairPathLoss
from swiftwrf.rssi.training import rounding_std

SHORT = {"config": replace(GLANCE, max_extra_planes=1)}  # search for a room
OPTIONS = {"swiftwrf": {"n_primitives": 4}, "geometry": SHORT, "hybrid": SHORT}
MODELS = [name for name, model in FIELD_MODELS.items() if not model.slow]
SCALES = (1e-3, 1e3, 1e6)


def on_a_line(position):
    """Return positions (n, 3) on a line through the room, and the first coordinate of all of them as a number."""
    return position[:1] + (position[:, :1] - position[:1, :1]) * torch.tensor([1.0, 0.5, 0.0], dtype=torch.float64)


def hot(values):
    """Return values that are all 0 but one."""
    return torch.zeros_like(values).index_fill_(-1, torch.tensor([3]), 1.0)


PLACES = {
    "one position": lambda position: position[:1].expand(len(position), -1),
    "collinear": on_a_line,
    **{f"scale {k:g}": lambda position, k=k: position * k for k in SCALES},
}
SPECTRA = {
    "constant": lambda values: torch.full_like(values, 0.5),
    "zero": torch.zeros_like,
    "one": torch.ones_like,
    "identical": lambda values: values[:1].expand_as(values),
    "hot pixel": hot,
}
RSSI = {
    "constant": lambda values: torch.full_like(values, -60.0),
    "zero": torch.zeros_like,
    "identical rows": lambda values: values[:1].expand_as(values),
    "one receiver heard": lambda values: torch.full_like(values, torch.nan).index_copy_(
        1, torch.tensor([0]), values[:, :1]
    ),
}
ALL = (*PLACES, *SPECTRA)
CASES = {"geometry": (*PLACES, "constant"), "hybrid": ("one position", "scale 1000")}  # searches take seconds


@cache
def spectra(case):
    """Return few small spectra of the built-in room, with one property of the case."""
    room = simulated_room(n=18, grid=AngularGrid.hemisphere(6, 24))
    if case in SPECTRA:
        return replace(room, store=Store(SPECTRA[case](room.store[:]).contiguous()))
    change = PLACES[case]
    fixed = room.fixed_position * float(case.split()[1]) if case.startswith("scale") else room.fixed_position
    return replace(room, position=change(room.position), fixed_position=fixed)


@cache
def rssi(case):
    """Return few rows of the built-in floor at four receivers, with one property of the case."""
    floor = rssi_room(n=24).receivers(["1", "2", "3", "4"])
    if case in RSSI:
        return replace(floor, rssi_dbm=RSSI[case](floor.rssi_dbm))
    receiver = floor.receiver_position
    if case == "on a receiver":
        return replace(floor, transmitter_position=receiver[:1].expand(len(floor), -1))
    if case.startswith("scale"):
        receiver = PLACES[case](receiver)
    return replace(floor, transmitter_position=PLACES[case](floor.transmitter_position), receiver_position=receiver)


def check(fit, position, bounds):
    """Check predictions at positions and far beyond them."""
    try:
        model = fit()
        found = model.predict(torch.cat([position[:3], position[:1] + 1e3]))
    except (InputError, FitError):
        return
    assert found.mean.isfinite().all()
    if found.std is not None:
        assert found.std.isfinite().all()
        assert (found.std > 0).all()
        low, high = found.interval(0.8)
        assert (low < high).all()
        assert bounds[0] <= low.min()
        assert high.max() <= bounds[1]


@pytest.mark.usefixtures("short_searches", "short_fits")
@pytest.mark.parametrize(("name", "case"), [(name, case) for name in MODELS for case in CASES.get(name, ALL)])
def test_field_models_of_hard_data(name, case):
    data = spectra(case)
    check(lambda: make_model(name, **OPTIONS.get(name, {})).fit(data), data.position, (0, 1))


@pytest.mark.usefixtures("short_fits")
@pytest.mark.parametrize("case", [*PLACES, *RSSI, "on a receiver"])
@pytest.mark.parametrize("model", [RssiModel, PairModel])
def test_rssi_models_of_hard_data(model, case):
    data = rssi(case)
    check(lambda: model().fit(data), data.transmitter_position, (-torch.inf, torch.inf))


@pytest.mark.usefixtures("short_fits")
@pytest.mark.parametrize("case", [*PLACES, *RSSI, "on a receiver"])
def test_rssi_locators_of_hard_data(case):
    data = rssi(case)
    try:
        posterior = RssiLocator(n_cells=50).fit(data).locate(data.rssi_dbm[:3])
    except InputError:
        return
    assert posterior.median.isfinite().all()


@pytest.mark.usefixtures("short_searches", "short_fits")
@pytest.mark.parametrize("case", ["scale 1000", "constant"])
def test_matched_field_locators_of_hard_data(case):
    data = spectra(case)
    try:
        room = make_model("geometry", **SHORT).fit(data)
        posterior = MatchedField(**COARSEST).fit(data, room=room).locate(data.spectrum[:3])
    except InputError:
        return
    assert posterior.median.isfinite().all()


def test_aliases_keep_the_plane_of_each_side():
    """Refinement may move a plane between the positions, where no alias is."""
    scene, _ = observe(spectra("scale 1000"))
    searched = search.Search(scene, reach=1.0, signs=search.SIGNS[0])
    room = search.PlaneSet.on_sides({side: (near - 5.0, 0.5) for side, near in enumerate(searched.near)})
    aliases = searched.aliases(room)
    assert [alias[0] for alias in aliases] == [room.by_side()[side] for side in range(6)]
    assert float(searched.improve(room).score) <= 1


def test_a_search_without_reach_finds_no_plane():
    """The wavelength may exceed the search distance many times over."""
    scene, _ = observe(spectra("scale 0.001"))
    (_, found), *_ = search.find_rooms(scene, reach=1e-4, width=1, tick=bool)
    assert not found.by_side()
    assert search.oblique_planes(scene, scene.direct, 1e-4, 3) == []


def test_rssi_falls_with_the_distance_beyond_the_data_and_grows_uncertain():
    """Receivers whose measurements rise with the distance have a constant trend."""
    floor = rssi_room(n=40).receivers(["1", "2", "3"])
    apart = (floor.transmitter_position[:, None] - floor.receiver_position).norm(dim=2)
    rising = replace(floor, rssi_dbm=-60 + 2 * apart)
    at = floor.receiver_position[:1] + torch.tensor([[1.0], [1e2], [1e4], [1e6]]).double()
    for data in (floor, rising):
        model = RssiModel().fit(data)
        found = model.predict(at)
        assert (model.path_loss.slope <= 0).all()
        # the field has a part of a rising trend, and decays over its length: 0.11 dB here
        assert (found.mean[1:] <= found.mean[1] + 0.2).all()
        assert (found.std[1:].diff(dim=0) > 0.1).all()
        updated = model.update(data.subset(torch.arange(3)))
        assert (updated.path_loss.slope[model.path_loss.slope == 0] == 0).all()


def test_path_loss_models_of_pairs_fall_with_the_distance_at_every_place():
    receiver = torch.zeros(20, 3).index_fill_(0, torch.arange(10, 20), 5.0)
    apart = torch.linspace(1, 30, 20)[:, None] * torch.tensor([1.0, 0.0, 0.0])
    rssi = torch.cat([-40 - 20 * apart[:10, 0], -400 + 20 * apart[10:, 0]])
    model = PairPathLoss.fit(torch.cat([receiver + apart, receiver], dim=1), rssi, by_place=True)
    assert (model.shared[1] + model.correction[:, 1] <= 1e-9).all()


@pytest.mark.parametrize(
    ("rssi_dbm", "step"), [([-60.0, -60.0], 1.0), ([-60.0, -40.0], 1.0), ([-60.0, -59.5, torch.nan], 0.5)]
)
def test_standard_deviations_are_at_least_that_of_rounding(rssi_dbm, step):
    assert rounding_std(torch.tensor(rssi_dbm)) == pytest.approx(step / 12**0.5)


@pytest.mark.parametrize("name", ["idw", "nearest"])
def test_interpolation_does_not_depend_on_the_order_of_rows(name):
    room = simulated_room(n=40, grid=AngularGrid.hemisphere(6, 24))
    room = replace(room, position=(room.position * 2).round() / 2)  # a grid: ties and repeated positions
    order = torch.randperm(len(room), generator=torch.Generator().manual_seed(0))
    at = torch.cat([room.position[:10], room.position[:10] + 0.25])
    first, second = (make_model(name).fit(data).predict(at).mean for data in (room, room.subset(order)))
    torch.testing.assert_close(first, second, atol=1e-6, rtol=0)
