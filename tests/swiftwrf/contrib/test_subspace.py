"""MUSIC, ESPRIT and maximum likelihood on simulated snapshots: against the Cramér-Rao bound and another implementation."""

import math
from dataclasses import replace

import pytest
import torch
from samples import snapshots, write_snapshots

from augment import Mixed, turbo_learning
from augment.estimators import make_estimator
from swiftwrf import InputError, load_spectra
from swiftwrf.array.angles import angular_distance
from swiftwrf.array.planar import PlanarArray
from swiftwrf.contrib.subspace import esprit, joint_music, maximum_likelihood, music
from swiftwrf.metrics import angle_errors

SQUARE = PlanarArray.square(4, 2.4e9)
ROW = PlanarArray(torch.arange(8, dtype=torch.float64)[:, None] * torch.tensor([[0.03, 0.04]]), SQUARE.wavelength)
ON_SNAPSHOTS = ("music", "esprit", "maximum_likelihood")
METHODS = [music, esprit, maximum_likelihood]


def unit(*cosine: float) -> torch.Tensor:
    """Unit vector of the first two direction cosines, in front of the array."""
    return torch.tensor([*cosine, math.sqrt(1 - sum(c * c for c in cosine))], dtype=torch.float64)


def received(array, direction, n=1, snapshots=20, noise=0.3, seed=0):
    """Channels (n, S, K) of Gaussian sources of unit power from directions (q, 3), and the sources (n, S, q)."""
    generator = torch.Generator().manual_seed(seed)

    def gaussian(*shape):
        return torch.randn(shape, dtype=torch.complex128, generator=generator)

    source = gaussian(n, snapshots, len(direction))
    steering = torch.exp(1j * array.phase(direction))
    return source @ steering + noise * gaussian(n, snapshots, len(array.element)), source


def bound(array, direction, source, noise):
    """Cramér-Rao bound of the direction cosines, (2 q, 2 q): P. Stoica and A. Nehorai, IEEE Trans. ASSP 37, 1989."""
    steering = torch.exp(1j * array.phase(direction)).T
    wave = 2j * math.pi * array.element / array.wavelength
    slope = torch.cat([wave * column[:, None] for column in steering.T], dim=1)
    outside = torch.eye(len(steering)) - steering @ torch.linalg.pinv(steering)
    power = (source.mT @ source.conj()).mean(dim=0)
    power = torch.kron(power.T.resolve_conj().contiguous(), torch.ones(2, 2, dtype=power.dtype))
    return noise**2 / 2 * torch.linalg.inv((slope.mH @ outside @ slope * power).real)


@pytest.mark.parametrize(("method", "worst"), [(music, 1.08), (maximum_likelihood, 1.08), (esprit, 1.2)])
def test_errors_of_one_source_reach_the_cramer_rao_bound(method, worst):
    direction = unit(0.35, -0.5)[None]
    channel, source = received(SQUARE, direction, n=500)
    error = method(SQUARE, channel)[:, :2] - direction[0, :2]
    ratio = math.sqrt(float(error.square().sum(1).mean() / bound(SQUARE, direction, source, 0.3).trace()))
    assert 0.92 < ratio < worst


@pytest.mark.parametrize("method", METHODS)
def test_directions_from_everywhere_and_of_a_linear_array(method):
    generator = torch.Generator().manual_seed(1)
    away = torch.randn(500, 3, dtype=torch.float64, generator=generator)
    away = away / away.norm(dim=1, keepdim=True)
    for array in (SQUARE, ROW):
        folded = array.folded(away)
        folded = folded[folded[:, 2] > 0.3]  # nearer to the plane or the axis both of its ends are alike
        channel = torch.exp(1j * array.phase(folded))[:, None]
        torch.testing.assert_close(method(array, channel), folded, rtol=0, atol=1e-6)


@pytest.mark.parametrize("method", METHODS)
def test_the_two_ends_of_an_axis_are_distinguished(method):
    """Elements exactly half a wavelength apart, sources 6 to 26 degrees from the axis."""
    wavelength = SQUARE.wavelength
    for elements in (2, 3, 4):
        array = PlanarArray.grid(1, elements, wavelength / 2, 299792458 / wavelength)
        angle = torch.arange(6, 28, 4.0).double().deg2rad()
        direction = torch.stack([angle.cos(), 0 * angle, angle.sin()], dim=1)
        direction = torch.cat([direction, direction * torch.tensor([-1, 1, 1])])
        generator = torch.Generator().manual_seed(elements)
        amplitude = torch.randn(len(direction), 40, 1, dtype=torch.complex128, generator=generator)
        channel = torch.exp(1j * array.phase(direction))[:, None] * amplitude
        channel = channel + 0.003 * torch.randn(channel.shape, dtype=torch.complex128, generator=generator)
        assert angular_distance(method(array, channel), direction).max() < math.radians(5)


@pytest.mark.parametrize("array", [SQUARE, ROW])
def test_the_earliest_path_is_found_below_a_stronger_reflection(array):
    """With a delay and a phase of each packet, noise, and subcarriers in any order."""
    generator = torch.Generator().manual_seed(1)
    direction = torch.stack([unit(0.48, 0.5), unit(-0.3, 0.1)])
    direction = direction if array is SQUARE else array.folded(direction)
    frequency = (2.4e9 + 10e6 * torch.arange(-4, 4, dtype=torch.float64))[torch.randperm(8, generator=generator)]
    delay = torch.tensor([10e-9, 35e-9]) + 200e-9 * torch.rand(20, 1, dtype=torch.float64, generator=generator)
    turned = torch.polar(torch.tensor([1.0, 1.5]).double(), -math.tau * delay[..., None, :] * frequency[:, None])
    channel = turned @ torch.exp(1j * array.phase(direction))
    channel = channel + 0.05 * torch.randn(channel.shape, dtype=channel.dtype, generator=generator)
    first = direction[:1].expand(20, 3)
    error = angular_distance(joint_music(array, channel, frequency), first)
    assert float(error.rad2deg().median()) < 1.5
    assert float(angular_distance(music(array, channel), first).rad2deg().median()) > 10
    with pytest.raises(InputError, match="at least 4 subcarriers at equal distances, got 3"):
        joint_music(array, channel[:, :3], frequency[:3])


def test_estimators_use_the_snapshots_of_measured_spectra(tmp_path):
    made = snapshots(n=60, count=5, noise=0.3)
    data = load_spectra(write_snapshots(tmp_path / "walk", data=made), grid=(16, 64))
    assert torch.equal(data.subset(torch.tensor([3])).channel, data.channel[3:4])
    errors = {}
    for name in ("peak", *ON_SNAPSHOTS):
        estimate = make_estimator(name).fit(Mixed.measured(data)).estimate(data)
        errors[name] = float(angle_errors(estimate, data.label)["great_circle"].rad2deg().median())
    assert all(errors[name] < errors["peak"] for name in ON_SNAPSHOTS)
    for without, expected in ((False, set(ON_SNAPSHOTS)), (True, set())):
        scene = replace(data, channel=None) if without else data
        result = turbo_learning(scene, measured=0.5, models=["nearest"], estimators=ON_SNAPSHOTS, extra=0)
        # there is no training that more spectra improve
        assert {name for name in result.summary().index if "," not in name} == expected
        assert set(result.missing) >= set(ON_SNAPSHOTS) - expected


def test_one_snapshot_of_each_position_is_not_enough():
    data = snapshots(n=20, count=1).spectra((8, 32))
    for name in ON_SNAPSHOTS:
        estimator = make_estimator(name).fit(Mixed.measured(data))
        assert estimator.lacking(data).endswith("are needed, and made contains one")
        with pytest.raises(InputError, match="are needed, and made contains one"):
            estimator.estimate(data)
