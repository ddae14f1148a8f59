"""Diagnoses of measurements with a known error name the true cause, and never another one.

Scenes are random: size of the room, shape, place and orientation of the array, noise and an echo from the floor.
"""

import math
from dataclasses import replace

import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from swiftwrf import AngularGrid, load_snapshots
from swiftwrf.array.planar import LIGHT_SPEED, PlanarArray
from swiftwrf.contrib.diagnostics.inspection import inspect
from swiftwrf.data import Snapshots

GRID = AngularGrid.hemisphere(18, 72)
SHAPES = ((2, 4), (3, 4), (2, 5), (3, 5), (4, 5))  # of arrays; not square, whose x and y may be exchanged


def scene(seed: int, n: int = 80, count: int = 2, shape: tuple[int, int] | None = None) -> Snapshots:
    """Snapshots of an array on the wall x = 0 of a room, with an echo from the floor."""
    draw = torch.Generator().manual_seed(seed)

    def uniform(low: float, high: float, *size: int) -> Tensor:
        return low + (high - low) * torch.rand(*size, generator=draw, dtype=torch.float64)

    frequency = float(uniform(0.9e9, 5.8e9, 1))
    size = torch.stack([uniform(5, 9, 1), uniform(6, 10, 1), uniform(2.6, 3.2, 1)])[:, 0]
    at = size * torch.tensor([0.0, 0.35, 0.45]) + torch.cat([torch.zeros(1), uniform(0, 0.6, 2)])
    position = torch.stack([uniform(1.2, float(size[0]), n),
                            uniform(0.3, float(size[1]), n), uniform(0.3, float(size[2]), n)], dim=1)  # fmt: skip
    askew = uniform(-25, 25, 3)
    rotation = Rotation.from_euler("y", 90, degrees=True) * Rotation.from_euler("zxy", askew.numpy(), degrees=True)
    rows, columns = shape or SHAPES[seed % len(SHAPES)]
    array = PlanarArray.grid(rows, columns, LIGHT_SPEED / frequency / 2, frequency)
    turned = torch.from_numpy(rotation.as_matrix())
    data = Snapshots(torch.ones(n, count, rows * columns, dtype=torch.complex64), position, array=array,
                     fixed_position=at, rotation=turned, name="scene")  # fmt: skip
    return received(data, seed, echo=float(uniform(0, 0.3, 1)), noise=float(uniform(0.05, 0.2, 1)))


def received(data: Snapshots, seed: int, echo: float = 0.1, noise: float = 0.1, ways: int = 1) -> Snapshots:
    """The snapshots with the channel of the direct path, an echo and noise."""
    draw = torch.Generator().manual_seed(1000 + seed)
    channel = torch.zeros(data.channel.shape, dtype=torch.complex128)
    bands = torch.linspace(1, 1.01, data.channel.shape[1], dtype=torch.float64)
    for mirror, amplitude in ((1.0, 1.0), (-1.0, echo)):
        away = data.position * torch.tensor([1.0, 1.0, mirror]) - data.fixed_position
        length = away.norm(dim=1, keepdim=True)
        phase = data.array.phase(away / length @ data.rotation)[:, None] - 2 * math.pi / data.array.wavelength * (
            length[:, :, None] * bands[:, None]
        )
        channel += amplitude * torch.polar(torch.ones_like(phase), phase)
    channel = channel**ways + noise * torch.randn(channel.shape, dtype=torch.complex128, generator=draw)
    return replace(data, channel=channel.to(torch.complex64))


def walk(seed: int, n: int = 120) -> Snapshots:
    """A scene whose positions lie along a walk, 0.2 s apart."""
    data = scene(seed, n=n)
    draw = torch.Generator().manual_seed(2000 + seed)
    time = torch.arange(n, dtype=torch.float64)
    low, high = data.position.amin(dim=0), data.position.amax(dim=0)
    rate, start = 0.05 + 0.1 * torch.rand(3, generator=draw), 6 * torch.rand(3, generator=draw)
    position = low + (high - low) * (0.5 + 0.5 * torch.sin(time[:, None] * rate + start))
    return received(replace(data, position=position, time=0.2 * time), seed)


# changes of a scene, as functions of its seed


def drawn(seed):
    return torch.Generator().manual_seed(seed)


def with_channel(change, **options):
    """Change the channel of a scene by a function of channel and seed."""
    return lambda seed: replace(data := scene(seed, **options), channel=change(data.channel, seed))


def with_position(change, make=scene):
    """Change the positions of a scene by a function of positions and seed."""
    return lambda seed: replace(data := make(seed), position=change(data.position, seed))


def with_phases(angle, **options):
    """Add an angle, which is a function of channel and seed."""
    return with_channel(lambda c, seed: c * torch.polar(torch.ones(1), angle(c, seed).float()), **options)


def with_order(order, **options):
    """Put the elements in an order, which is a function of their number and the seed."""
    return with_channel(lambda c, seed: c[..., order(c.shape[2], seed)], **options)


def cycle(moved):
    """Return the order after the cables of some elements were exchanged, in a cycle."""

    def order(n, seed):
        elements, order = torch.randperm(n, generator=drawn(seed))[:moved], torch.arange(n)
        order[elements] = elements.roll(1)
        return order

    return order


def second_half(c):
    return torch.arange(c.shape[2]) >= c.shape[2] // 2


def of_elements(c, seed):
    return 2 * math.pi * torch.rand(c.shape[2], generator=drawn(seed))


def random_order(n, seed):
    return torch.randperm(n, generator=drawn(seed))


def there_and_back(seed, echo=0.1):
    return received(scene(seed), seed, echo=echo, ways=2)


def tilted(seed):
    wrong = Rotation.from_rotvec([0, 0, math.radians(25 + seed)])
    return replace(data := scene(seed), rotation=data.rotation @ torch.from_numpy(wrong.as_matrix()))


def late(p, seed):
    rows = torch.arange(len(p)) + (-9, -4, 3, 6, 11)[seed % 5]
    return p[rows.clamp(0, len(p) - 1)]


def carrier_of_another_band(seed):
    data, factor = scene(seed), (3.0, 2.8, 0.45, 1.3, 0.8)[seed % 5]
    return replace(data, array=PlanarArray(data.array.element, data.array.wavelength * factor))


def sampled_in_turn(c, seed):
    """Carrier offsets turn the phases from element to element, by another angle in each packet."""
    slope = (0.4 + 0.1 * (seed % 5)) * torch.randn(len(c), 4, 1, generator=drawn(3000 + seed))
    return slope * torch.arange(c.shape[2])


def in_degrees(c, seed):
    """Channels whose phases are degrees, rounded to a tenth, that were taken as radians."""
    wide = c.to(torch.complex128)
    return torch.polar(wide.abs(), wide.angle().rad2deg().round(decimals=1)).to(c.dtype)


def beside_the_base(p, seed):
    """Positions 0.45 m beside the antenna, in another direction each."""
    angle = 2 * math.pi * torch.rand(len(p), generator=drawn(seed), dtype=torch.float64)
    return p + 0.45 * torch.stack([angle.cos(), angle.sin(), 0 * angle], dim=1)


def from_zero_frequency(seed):
    """Subcarriers in the order of an FFT, whose carriers ascend."""
    data = scene(seed, count=32)
    carriers = data.array.frequency_hz * torch.linspace(1, 1.01, 32, dtype=torch.float64)
    return replace(data, channel=torch.fft.ifftshift(data.channel, dim=1), frequency_hz=carriers)


def narrow(seed):
    data = scene(seed, n=4000)
    ahead = torch.nn.functional.normalize(data.direction.mean(dim=0), dim=0)
    return data.subset(((data.direction @ ahead) > 0.996).nonzero()[:40, 0])


def behind(seed):
    data = scene(seed)
    normal, away = data.rotation[:, 2], data.position - data.fixed_position
    mirrored = data.position - 2 * (away @ normal)[:, None] * normal
    back = torch.arange(len(data))[:, None] % 3 == 0
    return received(replace(data, position=torch.where(back, mirrored, data.position)), seed)


CAUSES = {  # measurements, and the statement of the cause of an error
    "nothing": (scene, "in one frame"),
    "a line": (lambda seed: scene(seed, shape=(1, 3 + seed % 4)), "angle to the array's axis) and follow it"),
    "behind": (behind, "behind the array"),
    "no line of sight": (
        with_channel(lambda c, seed: torch.randn(c.shape, dtype=torch.complex64, generator=drawn(seed))),
        "do not follow it in any frame",
    ),
    "phases without delay": (
        with_channel(lambda c, seed: c[..., :1] * (1 + 0.05 * torch.randn(c.shape))),
        "hardly depend on the position",
    ),
    "axes swapped": (
        lambda seed: replace(d := scene(seed, count=math.prod(SHAPES[seed % len(SHAPES)])), channel=d.channel.mT),
        "csi.transpose(0, 2, 1)",
    ),
    "elements by column": (
        with_order(lambda n, seed: torch.arange(n).reshape(SHAPES[seed % len(SHAPES)]).T.flatten()),
        "the elements are given column by column",
    ),
    "normalised positions": (
        with_position(lambda p, seed: 2 * (p - p.amin(dim=0)) / (p.amax(dim=0) - p.amin(dim=0)) - 1),
        "look normalised",
    ),
    "there and back": (there_and_back, "there and back"),
    "half-turn flips": (
        with_phases(
            lambda c, seed: math.pi * (torch.rand(len(c), 1, 1, generator=drawn(seed)) < 0.5) * second_half(c), count=1
        ),
        "jumps by half a turn",
    ),
    "there and back with strong echoes": (lambda seed: there_and_back(seed, echo=0.35), "there and back"),
    "uncalibrated": (with_phases(of_elements, n=100), "The array is not calibrated"),
    "tilted": (tilted, "constant rotation of"),
    "x and y swapped": (with_position(lambda p, seed: p[:, [1, 0, 2]]), "x and y of the positions"),
    "millimetres": (with_position(lambda p, seed: 1000 * p), "the positions are in millimetres"),
    "image axes": (
        with_position(lambda p, seed: torch.stack([p[:, 0], p[:, 1].max() + 0.7 - p[:, 1], p[:, 2]], dim=1)),
        "y of the positions counts from the other side",
    ),
    "one direction": (narrow, "nearly one direction"),
    "positions late or early": (with_position(late, walk), "differ in time"),
    "rows in reverse order": (with_position(lambda p, seed: p.flip(0)), "in reverse order"),
    "rows in the order of text": (
        with_position(lambda p, seed: p[sorted(range(len(p)), key=str)]),
        "in the order of text",
    ),
    "carrier of another band": (carrier_of_another_band, "the carrier is about"),
    "phases in degrees": (with_channel(in_degrees), "phases in degrees were taken as radians"),
    "beside the base": (with_position(beside_the_base), "as of positions that are wrong by about 0."),
    "order of an FFT": (from_zero_frequency, "order of an FFT"),
    "elements in turn": (with_phases(sampled_in_turn, count=4), "another slope in each snapshot"),
    "two cables": (with_order(cycle(2)), "are exchanged"),
    "three cables": (with_order(cycle(3), shape=(3, 4)), "are exchanged"),
    "random order": (with_order(random_order, shape=(4, 4)), "are exchanged"),
    "random order on a line": (with_order(random_order, shape=(1, 8)), "are exchanged"),
    "four cables of a line": (with_order(cycle(4), shape=(1, 8)), "are exchanged"),
}
ERRORS = [says for name, (_, says) in CAUSES.items() if name not in ("nothing", "a line", "behind", "no line of sight")]
ALSO = {"tilted": "The array is not calibrated"}  # its calibration includes the rotation


def check(name: str, seed: int) -> None:
    make, expected = CAUSES[name]
    findings = inspect(make(seed), grid=GRID)
    text = " ".join(text for _, text in findings.sentences)
    assert expected in text
    assert not [says for says in ERRORS if says in text and says not in (expected, ALSO.get(name))]
    assert all(expected in cause for cause in findings.numbers["explanations"])


further = pytest.mark.parametrize("further", [False, pytest.param(True, marks=pytest.mark.fuzz)])


@further
@pytest.mark.parametrize("name", CAUSES)
def test_true_cause_is_stated_and_no_other(name, further):
    for seed in range(25) if further else [list(CAUSES).index(name) % 5]:
        check(name, seed)


def jumping(turns):
    """Phases of half of the elements that change from measurement to measurement, by multiples of a turn / `turns`."""

    def angle(c, seed):
        steps = torch.randint(0, turns, (len(c), 1, 1), generator=drawn(seed))
        return 2 * math.pi / turns * steps * second_half(c)

    return with_phases(angle, shape=(4, 4), count=1)


def mixed_in_part(p, seed):
    order = torch.arange(len(p))
    order[:40] = order[:40].roll(1 + seed % 20)
    return p[order]


ABOUT_THE_ORIGIN = torch.tensor([[0.8, 0.6, 0], [-0.6, 0.8, 0], [0, 0, 1.0]]).double()
UNKNOWN = {  # errors that no statement names
    "quarter turns": jumping(4),
    "boards without common phase": jumping(360),
    "uncalibrated line": with_phases(of_elements, shape=(1, 4)),
    "standardised positions": with_position(lambda p, seed: (p - p.mean(dim=0)) / p.std(dim=0)),
    "positions of other rows": with_position(lambda p, seed: p[random_order(len(p), seed)]),
    "labels mixed in part": with_position(mixed_in_part),
    "stretched": with_position(lambda p, seed: p * torch.tensor([0.6, 1.5, 1.0])),
    "turned about the origin and tilted": with_position(lambda p, seed: p @ ABOUT_THE_ORIGIN, tilted),
    "shifted": with_position(lambda p, seed: p + torch.tensor([2.0, -3.0, 0.5])),
}


LIKE_A_CARRIER = {"stretched": (1030, 1045)}  # scenes that another carrier explains in part


def check_unknown(name: str, seed: int) -> None:
    findings = inspect(UNKNOWN[name](seed), grid=GRID)
    text = " ".join(text for _, text in findings.sentences)
    harmless = ("nearly one direction", ALSO["tilted"])  # constant phases mend an exchange in part
    assert not [says for says in ERRORS if says in text and says not in harmless]
    assert not findings.numbers["explanations"]


@further
@pytest.mark.parametrize("name", UNKNOWN)
def test_no_cause_is_stated_of_other_errors(name, further):
    for seed in range(31, 70) if further else [31 + list(UNKNOWN).index(name), *LIKE_A_CARRIER.get(name, ())]:
        check_unknown(name, seed)


@pytest.mark.data
def test_a_quarter_turn_of_a_measured_array_is_named_although_the_array_could_reach_more(measured_data):
    data = load_snapshots(measured_data / "ble-uca" / "as-described")
    findings = inspect(data, grid=(16, 72))
    assert findings.numbers["peak_to_line_of_sight_deg"] > 80
    assert all("count from y instead of x" in cause for cause in findings.numbers["explanations"])
    assert any("would fit in part if azimuths of the spectra count from y" in warning for warning in findings.warnings)
    turned = inspect(load_snapshots(measured_data / "ble-uca" / "turned"), grid=(16, 72))
    assert turned.numbers["peak_to_line_of_sight_deg"] < 25
    assert not turned.numbers["explanations"]
