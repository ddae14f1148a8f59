"""Diagnoses of measurements with a known error name the true cause, and never another one.

Scenes are random: size of the room, shape, place and orientation of the array, noise and an echo from the floor.
"""

import math
from dataclasses import replace

import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from swiftwrf import AngularGrid
from swiftwrf.array.planar import LIGHT_SPEED, PlanarArray
from swiftwrf.data import Snapshots
from swiftwrf.diagnostics.inspection import inspect

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


def without_delay(seed):
    data = scene(seed)
    return replace(data, channel=data.channel[..., :1] * (1 + 0.05 * torch.randn(data.channel.shape)))


def axes_swapped(seed):
    rows, columns = SHAPES[seed % len(SHAPES)]
    data = scene(seed, count=rows * columns)
    return replace(data, channel=data.channel.mT)


def by_column(seed):
    data = scene(seed)
    rows, columns = SHAPES[seed % len(SHAPES)]
    order = torch.arange(rows * columns).reshape(rows, columns).T.flatten()
    return replace(data, channel=data.channel[..., order])


def normalised(seed):
    data = scene(seed)
    low, high = data.position.amin(dim=0), data.position.amax(dim=0)
    return replace(data, position=2 * (data.position - low) / (high - low) - 1)


def there_and_back(seed):
    return received(scene(seed), seed, echo=0.1, ways=2)


def flipped(seed):
    data = scene(seed, count=1)
    draw = torch.Generator().manual_seed(seed)
    half = torch.arange(data.channel.shape[2]) >= data.channel.shape[2] // 2
    flip = torch.rand(len(data), 1, 1, generator=draw) < 0.5
    return replace(data, channel=torch.where(flip & half, -data.channel, data.channel))


def uncalibrated(seed):
    data = scene(seed, n=100)
    phase = 2 * math.pi * torch.rand(data.channel.shape[2], generator=torch.Generator().manual_seed(seed))
    return replace(data, channel=data.channel * torch.polar(torch.ones_like(phase), phase))


def tilted(seed):
    data = scene(seed)
    wrong = Rotation.from_rotvec([0, 0, math.radians(25 + seed)])
    return replace(data, rotation=data.rotation @ torch.from_numpy(wrong.as_matrix()))


def image_axes(seed):
    data = scene(seed)
    top = float(data.position[:, 1].max()) + 0.7
    return replace(data, position=data.position * torch.tensor([1.0, -1.0, 1.0]) + torch.tensor([0.0, top, 0.0]))


def walk(seed: int, n: int = 120) -> Snapshots:
    """A scene whose positions lie along a walk, 0.2 s apart."""
    data = scene(seed, n=n)
    draw = torch.Generator().manual_seed(2000 + seed)
    time = torch.arange(n, dtype=torch.float64)
    low, high = data.position.amin(dim=0), data.position.amax(dim=0)
    rate, start = 0.05 + 0.1 * torch.rand(3, generator=draw), 6 * torch.rand(3, generator=draw)
    position = low + (high - low) * (0.5 + 0.5 * torch.sin(time[:, None] * rate + start))
    return received(replace(data, position=position, time=0.2 * time), seed)


def delayed(seed):
    data, late = walk(seed), (-9, -4, 3, 6, 11)[seed % 5]
    return replace(data, position=data.position[(torch.arange(len(data)) + late).clamp(0, len(data) - 1)])


def by_text(seed):
    data = scene(seed)
    return replace(data, position=data.position[sorted(range(len(data)), key=str)])


def carrier_of_another_band(seed):
    data, factor = scene(seed), (3.0, 2.8, 0.45, 1.3, 0.8)[seed % 5]
    return replace(data, array=PlanarArray(data.array.element, data.array.wavelength * factor))


def sampled_in_turn(seed):
    """Carrier offsets turn the phases from element to element, by another angle in each packet."""
    data = scene(seed, count=4)
    draw = torch.Generator().manual_seed(3000 + seed)
    slope = (0.4 + 0.1 * (seed % 5)) * torch.randn(len(data), 4, 1, generator=draw)
    phase = slope * torch.arange(data.channel.shape[2])
    return replace(data, channel=data.channel * torch.polar(torch.ones_like(phase), phase))


def exchanged(seed, moved=2, shape=None):
    """Cables of some elements exchanged, in a cycle."""
    data = scene(seed, shape=shape)
    elements = torch.randperm(data.channel.shape[2], generator=torch.Generator().manual_seed(seed))[:moved]
    order = torch.arange(data.channel.shape[2])
    order[elements] = elements.roll(1)
    return replace(data, channel=data.channel[..., order])


def random_order(seed, shape=(4, 4)):
    data = scene(seed, shape=shape)
    order = torch.randperm(data.channel.shape[2], generator=torch.Generator().manual_seed(seed))
    return replace(data, channel=data.channel[..., order])


def narrow(seed):
    data = scene(seed, n=4000)
    ahead = torch.nn.functional.normalize(data.direction.mean(dim=0), dim=0)
    return data.subset(((data.direction @ ahead) > 0.996).nonzero()[:40, 0])


def behind(seed):
    data = scene(seed)
    position = data.position.clone()
    normal = data.rotation[:, 2]
    away = position - data.fixed_position
    back = torch.arange(len(data))[:, None] % 3 == 0
    return received(
        replace(data, position=torch.where(back, position - 2 * (away @ normal)[:, None] * normal, position)), seed
    )


def hidden(seed):
    data = scene(seed)
    draw = torch.Generator().manual_seed(seed)
    return replace(data, channel=torch.randn(data.channel.shape, dtype=torch.complex64, generator=draw))


CAUSES = {  # measurements, and the statement of the cause of an error
    "nothing": (scene, "in one frame"),
    "a line": (lambda seed: scene(seed, shape=(1, 3 + seed % 4)), "angle to the array's axis) and follow it"),
    "behind": (behind, "behind the array"),
    "no line of sight": (hidden, "do not follow it in any frame"),
    "phases without delay": (without_delay, "hardly depend on the position"),
    "axes swapped": (axes_swapped, "csi.transpose(0, 2, 1)"),
    "elements by column": (by_column, "the elements are given column by column"),
    "normalised positions": (normalised, "look normalised"),
    "there and back": (there_and_back, "there and back"),
    "half-turn flips": (flipped, "jumps by half a turn"),
    "there and back with strong echoes": (lambda s: received(scene(s), s, echo=0.35, ways=2), "there and back"),
    "uncalibrated": (uncalibrated, "The array is not calibrated"),
    "tilted": (tilted, "constant rotation of"),
    "x and y swapped": (
        lambda s: replace(d := scene(s), position=d.position[:, [1, 0, 2]]),
        "x and y of the positions",
    ),
    "millimetres": (lambda s: replace(d := scene(s), position=1000 * d.position), "the positions are in millimetres"),
    "image axes": (image_axes, "y of the positions counts from the other side"),
    "one direction": (narrow, "nearly one direction"),
    "positions late or early": (delayed, "differ in time"),
    "rows in reverse order": (lambda s: replace(d := scene(s), position=d.position.flip(0)), "in reverse order"),
    "rows in the order of text": (by_text, "in the order of text"),
    "carrier of another band": (carrier_of_another_band, "the carrier is about"),
    "elements in turn": (sampled_in_turn, "another slope in each snapshot"),
    "two cables": (exchanged, "are exchanged"),
    "three cables": (lambda seed: exchanged(seed, 3, (3, 4)), "are exchanged"),
    "random order": (random_order, "are exchanged"),
    "random order on a line": (lambda seed: random_order(seed, (1, 8)), "are exchanged"),
    "four cables of a line": (lambda seed: exchanged(seed, 4, (1, 8)), "are exchanged"),
}
OF_INSPECTION = (  # statements that are not those of an error of frames, elements or labels
    "nothing",
    "a line",
    "behind",
    "no line of sight",
    "normalised positions",
    "uncalibrated",
    "one direction",
)
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


def jumping(seed, turns):
    """Phases of half of the elements that change from measurement to measurement, by multiples of a turn / `turns`."""
    data = scene(seed, shape=(4, 4), count=1)
    steps = torch.randint(0, turns, (len(data), 1, 1), generator=torch.Generator().manual_seed(seed))
    half = torch.arange(16) >= 8
    phase = 2 * math.pi / turns * steps * half
    return replace(data, channel=data.channel * torch.polar(torch.ones(phase.shape), phase.float()))


def uncalibrated_line(seed):
    data = scene(seed, shape=(1, 4))
    phase = 2 * math.pi * torch.rand(4, generator=torch.Generator().manual_seed(seed))
    return replace(data, channel=data.channel * torch.polar(torch.ones_like(phase), phase))


def standardised(seed):
    data = scene(seed)
    return replace(data, position=(data.position - data.position.mean(dim=0)) / data.position.std(dim=0))


def labels_mixed_in_part(seed):
    data = scene(seed)
    order = torch.arange(len(data))
    order[:40] = order[:40].roll(1 + seed % 20)
    return replace(data, position=data.position[order])


def moved_and_turned(seed):
    data = tilted(seed)
    return replace(data, position=data.position @ torch.tensor([[0.8, 0.6, 0], [-0.6, 0.8, 0], [0, 0, 1.0]]).double())


def stretched(seed):
    return replace(d := scene(seed), position=d.position * torch.tensor([0.6, 1.5, 1.0]))


UNKNOWN = {  # errors that no statement names
    "quarter turns": lambda seed: jumping(seed, 4),
    "boards without common phase": lambda seed: jumping(seed, 360),
    "uncalibrated line": uncalibrated_line,
    "standardised positions": standardised,
    "positions of other rows": lambda s: replace(
        d := scene(s), position=d.position[torch.randperm(len(d), generator=torch.Generator().manual_seed(s))]
    ),
    "labels mixed in part": labels_mixed_in_part,
    "stretched": stretched,
    "turned about the origin and tilted": moved_and_turned,
    "shifted": lambda s: replace(d := scene(s), position=d.position + torch.tensor([2.0, -3.0, 0.5])),
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
