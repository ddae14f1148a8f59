"""The methods of comparison: what is published of them, the physics that they draw, and that they fit as SwiftWRF does."""

import math
from dataclasses import replace
from itertools import pairwise
from unittest import mock

import pytest
import torch
from small import PAPER, PUBLISHED, PUBLISHED_RSSI
from torch.nn import functional

from swiftwrf import AngularGrid, FitError, InputError, Spectra, load, make_model, rssi_room, simulated_room
from swiftwrf.contrib.published import NeRF2Rssi, wrfgs
from swiftwrf.contrib.published.base import Training
from swiftwrf.contrib.published.generative import DcganConfig, VaeConfig, double, halve, stages
from swiftwrf.contrib.published.nerf2 import FIRST_PHASE, PATH_GAIN, Field, NeRF2Config, integrate, received
from swiftwrf.contrib.published.wrfgs import WrfGsConfig, on_sphere
from swiftwrf.data.store import Store
from swiftwrf.metrics import psnr
from swiftwrf.models import FIELD_MODELS
from swiftwrf.models.mlp import draw_parameters, encode
from swiftwrf.models.swiftwrf_paper import SwiftWRFPaperConfig
from swiftwrf.rasterize import rasterize_magnitude

GRID = AngularGrid.hemisphere(90, 360)
LEARNS = {
    "nerf2": NeRF2Config(width=48, bands=4, samples=12, steps=240, rate=5e-3),
    "wrfgs": WrfGsConfig(n_gaussians=100, width=32, depth=4, bands=4, steps=250, rate=5e-3),
    "vae": VaeConfig(latent=4, bands=2, hidden=64, steps=200),
    "dcgan": DcganConfig(noise=2, bands=2, hidden=64, steps=300),
    "swiftwrf_paper": SwiftWRFPaperConfig(n_primitives=24, steps=400, batch=16, coarse_fraction=0.3, check_every=200),
}


def blob(n=40) -> Spectra:
    """One source that goes round as the transmitter moves along a line."""
    grid = AngularGrid.hemisphere(15, 60)
    room = simulated_room(n=n, seed=0, grid=grid)
    along = torch.linspace(-0.5, 0.5, n, dtype=torch.float64)
    position = torch.stack([3 + along, torch.full_like(along, 2.5), torch.ones_like(along)], dim=1)
    mean = torch.stack([math.pi + 2 * along, torch.full_like(along, 0.7)], dim=1)[:, None].float()
    cholesky, weight = torch.tensor([[0.5, 0.0, 0.4]]), torch.tensor([[[0.9, 0.0]]]).repeat(n, 1, 1)
    return replace(room, position=position, store=Store(rasterize_magnitude(mean, cholesky, weight, grid, cutoff=None)))


def fit(train, name, config=None, **arguments):
    """A fitted model, of the small configuration if there is no other."""
    return FIELD_MODELS[name](config or PUBLISHED[name]).fit(train, **arguments)


def training(config, data):
    """The training of a model's network, and the model."""
    (name,) = (name for name in PUBLISHED if isinstance(config, FIELD_MODELS[name].config_type))
    found = []
    with mock.patch.object(Training, "run", lambda self, *_, **__: found.append(self) or self.result):
        model = FIELD_MODELS[name](config).fit(data)
    return found[0], model


def count(model):
    return sum(parameter.numel() for parameter in model.parameters())


def published(name):
    """The network of the publication for spectra of 90 x 360 pixels."""
    model = make_model(name, "paper")
    model.grid = GRID
    return model.blank()


def test_the_published_sizes_are_the_publications():
    assert count(published("nerf2")) == 690_564
    assert count(published("wrfgs")["features"]) == 126 * 128 + 6 * 128**2 + 254 * 128 + 8 * 128
    upwards = [m for m in published("dcgan")["generator"].modules() if isinstance(m, torch.nn.ConvTranspose2d)]
    assert [m.in_channels for m in upwards] == [1024, 512, 256, 128]
    paper = NeRF2Config.paper()
    assert (paper.batch * paper.rays, paper.rate, paper.weight_decay, paper.steps) == (8192, 8e-4, 5e-5, 30_000)
    paper = WrfGsConfig.paper()
    assert (paper.n_gaussians, paper.rate, paper.steps, paper.spread) == (20_000, 8e-4, 600_000, 10.0)


def test_published_rates(room):
    """NeRF2's rises again after 10,000 of its 30,000 steps; WRF-GS's stays low after 200,000."""
    rate = training(NeRF2Config.paper(width=8, batch=4), room)[0].rate
    assert [rate(step) for step in (0, 10_000, 20_000)] == pytest.approx([1, 1e-6 / 8e-4, 1])
    rate = training(WrfGsConfig.paper(n_gaussians=20), room)[0].rate
    assert [rate(step) for step in (0, 200_000, 400_000)] == pytest.approx([1, 0.02, 0.02])


# rays


def nothing(samples):
    """Absorption, phase change, amplitude and phase of a medium without any effect."""
    return torch.zeros(4, samples, dtype=torch.float64)


ABSORPTION, TURNING, AMPLITUDE, PHASE = range(4)


@pytest.mark.parametrize("at", [0, 3, 30])
def test_one_sample_that_emits_arrives_with_its_phase_and_path_loss(at):
    distance = torch.linspace(0, 5, 64, dtype=torch.float64)
    medium = nothing(64)
    medium[AMPLITUDE, at], medium[PHASE, at] = 2.0, 0.7
    medium[TURNING] = 0.3
    real, imaginary = integrate(tuple(medium), distance)
    size = 2.0 * PATH_GAIN / float(distance[at + 1])
    angle = 0.7 + FIRST_PHASE + 0.3 * float(distance[at])
    expected = torch.polar(torch.tensor(size).double(), torch.tensor(angle).double())
    torch.testing.assert_close(torch.complex(real, imaginary), expected)


def test_a_slab_absorbs_what_lies_behind_it_and_nothing_before_it():
    distance = torch.linspace(0, 5, 101, dtype=torch.float64)  # 0.05 m apart
    medium = nothing(101)
    medium[ABSORPTION, 20:40] = 1.5  # from 1 m to 2 m
    for at, through in ((10, 0.0), (20, 0.0), (30, 0.5), (60, 1.0)):
        medium[AMPLITUDE] = 0
        medium[AMPLITUDE, at] = 1
        arrived = torch.hypot(*integrate(tuple(medium), distance))
        torch.testing.assert_close(arrived, math.exp(-1.5 * through) * PATH_GAIN / distance[at + 1])


def test_the_last_sample_does_not_arrive():
    medium = nothing(5)
    medium[AMPLITUDE, -1] = 1
    assert integrate(tuple(medium), torch.linspace(0, 5, 5, dtype=torch.float64)).abs().max() == 0


def test_the_field_shared_by_transmitters_is_the_field_of_each(generator):
    field = Field(width=16, depth=8, bands=3)
    draw_parameters(field, generator)
    point, direction, transmitter = (torch.randn(n, 1, 3, generator=generator) for n in (7, 7, 4))
    absorption, _, amplitude, phase = field(point, direction, transmitter.transpose(0, 1))
    x, d, t = (encode(v.expand(7, 4, 3), 3, lowest=1.0) for v in (point, direction, transmitter.transpose(0, 1)))
    h = field.layers(x)
    parallel_map = field.emission(field.mixing(torch.cat([field.feature(h), d, t], dim=-1)))
    torch.testing.assert_close(amplitude, functional.leaky_relu(parallel_map[..., 0]).abs())
    torch.testing.assert_close(phase, 2 * math.pi * parallel_map[..., 1].sigmoid())
    assert absorption.shape == (7, 1)


# sphere


def drawn_point(direction, grid=GRID, width=0.02):
    """A small round Gaussian 3 m away."""
    mean = 3 * functional.normalize(torch.tensor([direction]), dim=-1)
    blur = torch.tensor([0.3 * grid.azimuth_step, 0.3 * grid.elevation_step])
    projected = on_sphere(mean, 3 * width * torch.eye(3)[None], blur)
    return rasterize_magnitude(*projected, torch.tensor([[1.0, 0.0]]), grid, cutoff=None), projected


@pytest.mark.parametrize(
    ("azimuth", "elevation"), [(30.0, 20.0), (359.0, 45.0), (0.0, 45.0), (0.5, 10.0), (200.0, 80.0), (200.0, -80.0)]
)
def test_a_point_lands_on_its_direction(azimuth, elevation):
    az, el = math.radians(azimuth), math.radians(elevation)
    spectrum, (_, cholesky) = drawn_point((math.cos(el) * math.cos(az), math.cos(el) * math.sin(az), math.sin(el)))
    row, column = divmod(int(spectrum.argmax()), 360)
    assert row == abs(elevation) - 1
    assert min(abs(column - azimuth), 360 - abs(column - azimuth)) <= 0.5
    assert spectrum.max() > 0.9
    # as wide in elevation as it is seen, and in azimuth by 1 / cos(elevation) wider
    blur = 0.3 * math.radians(1)
    assert float(cholesky[0, 2]) == pytest.approx(math.hypot(0.02, blur), rel=1e-3)
    assert float(cholesky[0, 0]) == pytest.approx(math.hypot(0.02 / math.cos(el), blur), rel=1e-2)


def test_a_point_at_the_pole_is_at_all_azimuths():
    for tilt in (0.0, 1e-4):
        spectrum, _ = drawn_point((tilt, 0.0, 1.0))
        assert spectrum[89].min() > 0.9
        assert spectrum[80].max() < 1e-3


def test_projection_is_the_derivative_of_the_direction(generator):
    """A Gaussian so small that its image is linear: covariances of drawn points and of the formula agree."""
    mean = torch.tensor([[1.0, 2.0, 1.5], [-2.0, 0.5, -1.0]], dtype=torch.float64)
    factor = 1e-4 * torch.randn(2, 3, 3, generator=generator, dtype=torch.float64)
    angles, cholesky = on_sphere(mean, factor, torch.zeros(2, dtype=torch.float64))
    points = mean[:, None] + torch.randn(2, 100_000, 3, generator=generator, dtype=torch.float64) @ factor.mT
    azimuth, elevation = (
        torch.atan2(points[..., 1], points[..., 0]),
        torch.asin(points[..., 2].abs() / points.norm(dim=-1)),
    )
    torch.testing.assert_close(angles[:, 1], elevation.mean(dim=1), atol=1e-5, rtol=0)
    for i in range(2):
        found = torch.cov(torch.stack([azimuth[i], elevation[i]]))
        l1, l2, l3 = cholesky[i]
        lower = torch.stack([torch.stack([l1, 0 * l1]), torch.stack([l2, l3])])
        torch.testing.assert_close(lower @ lower.T, found, rtol=0.03, atol=1e-10)


# convolutions


@pytest.mark.parametrize("shape", [(90, 360), (15, 60), (8, 32), (7, 9)])
def test_halvings_and_doublings_meet(shape):
    shapes = stages(AngularGrid.hemisphere(*shape))
    x = torch.rand(2, 1, *shape)
    for before, after in pairwise(shapes):
        x = halve(1, 1, before)(x)
        assert x.shape[-2:] == after
        assert double(1, 1, after, before)(x).shape[-2:] == before


def test_convolutions_are_periodic_in_azimuth():
    x = torch.rand(1, 1, 6, 16)
    halved, doubled = halve(1, 1, (6, 16)), double(1, 1, (6, 16), (12, 32))
    torch.testing.assert_close(halved(x.roll(4, -1)), halved(x).roll(2, -1))
    torch.testing.assert_close(doubled(x.roll(4, -1)), doubled(x).roll(8, -1))


def test_convolutions_refuse_specks(room):
    with pytest.raises(InputError, match="at least 4 x 4"):
        fit(room.coarsen(5), "vae")


# growing


def test_gaussians_that_are_pulled_at_are_doubled(room):
    config = replace(PUBLISHED["wrfgs"], grows=True)
    grown, _ = training(config, room)
    for _ in range(3):
        grown.advance()
    shape, old = grown.gaussians, grown.gaussians["log_scale"].detach().clone()
    state = grown.optimiser.state[shape["log_scale"]]["exp_avg"].clone()
    grown.pull[:] = 0
    grown.pull[[3, 5]] = 1
    with torch.no_grad():
        shape["log_scale"][5] = math.log(wrfgs.MAX_CLONED * config.spread) - 1  # small: cloned
        shape["opacity"][7] = -20  # hardly seen: removed
    grown._grow()
    # 20, 1 removed, 1 cloned, 1 split into two
    assert len(shape["mean"]) == len(shape["opacity"]) == 21
    assert len(grown.result["gaussians"]["mean"]) == 21
    torch.testing.assert_close(shape["mean"][18], shape["mean"][4])  # the clone, after 18 that stayed
    torch.testing.assert_close(shape["log_scale"][-2:], (old[3] - math.log(wrfgs.SPLIT_FACTOR)).expand(2, 3))
    assert (shape["mean"][-1] != shape["mean"][-2]).all()
    kept = grown.optimiser.state[shape["log_scale"]]["exp_avg"]
    torch.testing.assert_close(kept[:3], state[:3])
    assert (kept[18:] == 0).all()
    grown.advance()


def test_an_interrupted_fit_that_grew_goes_on_to_the_same_bits(room, tmp_path, monkeypatch):
    monkeypatch.setattr(wrfgs, "GROW_FROM", 2)
    monkeypatch.setattr(wrfgs, "GROW_EVERY", 3)
    monkeypatch.setattr(wrfgs, "MIN_PULL", 1e-9)
    config = replace(PUBLISHED["wrfgs"], grows=True)
    whole = fit(room, "wrfgs", config)
    assert len(whole.network["gaussians"]["mean"]) > 40
    with pytest.raises(KeyboardInterrupt):
        fit(room, "wrfgs", config, checkpoint=tmp_path / "state", on_record=interrupt)
    again = fit(room, "wrfgs", config, checkpoint=tmp_path / "state")
    assert torch.equal(again.synthesize(room.position), whole.synthesize(room.position))
    whole.save(tmp_path / "model")
    assert torch.equal(load(tmp_path / "model").synthesize(room.position), whole.synthesize(room.position))


# every method


def interrupt(record):
    raise KeyboardInterrupt


every = pytest.mark.parametrize("name", PUBLISHED)


@pytest.mark.parametrize("name", LEARNS)
def test_learns_a_source_that_moves(name):
    data = blob()
    rows = torch.arange(len(data))
    train, test = data.subset(rows[rows % 4 != 2]), data.subset(rows[rows % 4 == 2])
    predicted = fit(train, name, LEARNS[name]).synthesize(test.position)
    mean = psnr(train.spectrum.mean(dim=0), test.spectrum).median()
    assert psnr(predicted, test.spectrum).median() > mean + 4


@pytest.mark.parametrize(("name", "config"), {**PUBLISHED, "swiftwrf_paper": PAPER}.items())
def test_same_seed_same_model_and_interruptions_do_not_show(room, tmp_path, name, config):
    first, records = [], []
    whole = fit(room, name, config, on_record=first.append).synthesize(room.position)
    with pytest.raises(KeyboardInterrupt):
        fit(room, name, config, checkpoint=tmp_path / "state", on_record=interrupt)
    again = fit(room, name, config, checkpoint=tmp_path / "state", on_record=records.append)
    assert [record["step"] for record in records] == [*range(config.check_every, config.steps + 1, config.check_every)]
    for one, other in zip(first, records, strict=True):  # the history is whole
        assert {key: value for key, value in one.items() if key not in ("elapsed", "seconds")}.items() <= other.items()
    assert torch.equal(again.synthesize(room.position), whole)
    with pytest.raises(InputError, match="another fit"):
        fit(room, name, replace(config, seed=1), checkpoint=tmp_path / "state")


@every
def test_both_ends_may_move(name):
    data = simulated_room(n=12, moving="receiver", grid=AngularGrid.hemisphere(8, 32))
    begun, model = training(PUBLISHED[name], data)
    for _ in range(3):
        begun.advance()
    rendered = model.render(begun.result.eval(), data.position, data.grid)
    assert (rendered[0] - rendered[1]).abs().max() > 0


@every
def test_what_is_not_finite_stops_the_fit(room, monkeypatch, name):
    broken = room.spectrum.clone()
    broken[7, 3, 3] = float("nan")
    with pytest.raises(InputError, match="training spectrum 7"):
        fit(replace(room, store=Store(broken)), name)
    monkeypatch.setattr(Training, "rate", lambda self, step: 1e30)
    with pytest.raises(FitError, match="rate below"):
        fit(room, name)


def test_one_field_for_all_receivers():
    """RSSI is averaged over rays, in dBm; rows without detection do not train."""
    train = rssi_room(n=40).receivers(["1", "2", "3"])
    train.rssi_dbm[::3, 1] = torch.nan
    model = NeRF2Rssi(PUBLISHED_RSSI).fit(train)
    with pytest.raises(InputError, match="a predictor nerf2 has no map"):
        model.region()
    position = train.transmitter_position
    predicted = model.predict(position).mean
    assert predicted.shape == (40, 3)
    config, centre = model.config, model.centre
    rays = AngularGrid.hemisphere(2, 4).direction.flatten(0, 1).float()
    transmitter, receiver = ((at - centre).float() for at in (position[7:8], train.receiver_position[2:]))
    signal = received(model.field, config.reach, config.samples, transmitter, receiver, rays).mean(dim=1)
    torch.testing.assert_close(predicted[7, 2].float(), 100 * (torch.hypot(*signal) - 1))
