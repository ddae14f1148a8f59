"""Built-in scenes with exact geometry: spectra in rectangular rooms with a few boxes in them, RSSI on an office floor.

Walls mirror the transmitter; up to two reflections give 25 image sources, each visible along a straight line through the
unfolded rooms (J. B. Allen and D. A. Berkley, "Image method for efficiently simulating small-room acoustics", J. Acoust.
Soc. Am. 65, 1979). Folding that line back into the room gives the path's corners, and with them the boxes that block it.
The geometry is exact. There is no diffraction, no scattering, and no material that depends on the angle.
"""

from __future__ import annotations

import math
from typing import Annotated

import torch
from annotated_types import Ge, Le
from torch import Tensor

from swiftwrf.array.angles import AngularGrid, ArrayPose
from swiftwrf.array.beamforming import unit_phasor
from swiftwrf.array.planar import LIGHT_SPEED, PlanarArray
from swiftwrf.choices import Moving
from swiftwrf.data.paths import PropagationPaths
from swiftwrf.data.rssi import Rssi
from swiftwrf.data.spectra import Spectra, array_spectra
from swiftwrf.data.stations import Stations
from swiftwrf.errors import InputError
from swiftwrf.runtime.validation import (
    NonNegativeFloat,
    NonNegativeInt,
    PositiveFloat,
    PositiveInt,
    checked,
    configuration,
)

Point = tuple[float, float, float]
GRID = AngularGrid.hemisphere(30, 120)
FACING_X = ArrayPose((0.1, 2.4, 1.2), (0.0, math.sqrt(0.5), 0.0, math.sqrt(0.5)))  # on the wall x = 0, its normal is +x
CEILING = ArrayPose((3.0, 2.5, 2.7))  # position of the fixed transmitter, orientation of the level array that moves
REGION = ((2.2, 1.6, 0.9), (4.2, 3.4, 1.5))  # of the moving end: opposite corners [m]
BATCH_POSITIONS = 4096  # whose paths take half a gigabyte
CHANNELS_HZ = (2.402e9, 2.426e9, 2.480e9)  # of BLE advertisements; a receiver does not report the channel


@configuration
class ShoeboxRoom:
    """A rectangular room with one corner at the origin.

    Example:
        >>> room, ends = ShoeboxRoom(boxes=()), torch.tensor([[1.0, 1, 1], [4, 1, 1]])
        >>> room.paths(ends[:1], ends[1:]).count.tolist()
        [25]
    """

    size: tuple[PositiveFloat, PositiveFloat, PositiveFloat] = (6.0, 5.0, 3.0)
    """extent along x, y and z [m]"""
    boxes: tuple[tuple[Point, Point], ...] = (
        ((1.0, 0.6, 0.0), (1.6, 1.9, 1.3)),
        ((4.6, 3.6, 0.0), (5.4, 4.6, 1.8)),
        ((1.2, 3.0, 0.0), (1.5, 3.2, 2.2)),
    )
    """obstacles, as pairs of opposite corners [m]"""
    reflection: float = -0.6
    """amplitude factor of a reflection, with its sign"""
    blockage: NonNegativeFloat = 0.1
    """amplitude factor of a path that a box blocks"""
    frequency_hz: PositiveFloat = 915e6
    """frequency of the carrier [Hz]"""

    def paths(self, transmitter: Tensor, receiver: Tensor) -> PropagationPaths:
        """Return the 25 paths with at most two reflections of each link between positions (n, 3) [m], the direct path first.

        Raises:
            InputError: A position outside the room, or both ends at one position.
        """
        transmitter, receiver = torch.broadcast_tensors(transmitter.double(), receiver.double())
        size = torch.tensor(self.size, dtype=torch.float64)
        for name, position in (("transmitter", transmitter), ("receiver", receiver)):
            if not bool(((position > 0) & (position < size)).all()):
                raise InputError(f"a {name} stands outside the room of {self.size} m")
        # mirrored rooms (25, 3) that at most two reflections reach, the room itself first
        steps = torch.arange(-2, 3, dtype=torch.float64)
        rooms = torch.cartesian_prod(steps, steps, steps)
        rooms = rooms[rooms.abs().sum(dim=1) <= 2]
        rooms = rooms[rooms.abs().sum(dim=1).argsort(stable=True)]
        inside = torch.where(rooms % 2 == 0, transmitter[:, None], size - transmitter[:, None])
        ray = rooms * size + inside - receiver[:, None]  # (n, 25, 3)
        length = ray.norm(dim=-1)
        if bool((length == 0).any()):
            raise InputError("transmitter and receiver stand at one place, so there is no direction between them")
        clear = ~self._blocked(receiver, ray, rooms)
        wavelength = LIGHT_SPEED / self.frequency_hz
        amplitude = wavelength / (4 * math.pi * length) * self.reflection ** rooms.abs().sum(-1)
        amplitude = torch.where(clear, amplitude, self.blockage * amplitude)
        gain = amplitude * unit_phasor(-2 * math.pi / wavelength * length)
        return PropagationPaths(
            transmitter=transmitter,
            receiver=receiver,
            count=torch.full((len(length),), len(rooms)),
            direction=(ray / length[..., None]).flatten(0, 1),
            gain=gain.flatten(),
            line_of_sight=clear[:, 0],
            frequency_hz=self.frequency_hz,
            length=length.flatten(),
        )

    def _blocked(self, receiver: Tensor, ray: Tensor, rooms: Tensor) -> Tensor:
        """Return whether a box, or its mirror image in a room on the way, blocks each path, bool (n, 25)."""
        on_the_way = (rooms - rooms[:, None]).abs() + rooms.abs() == rooms[:, None].abs()
        path, number = on_the_way.all(dim=-1).nonzero().T  # 79 pairs of a path and a room
        room, size = rooms[number], torch.tensor(self.size, dtype=torch.float64)
        hits = torch.zeros(ray.shape[:2], dtype=torch.int64)
        axes = [(x[:, None], step[:, path]) for x, step in zip(receiver.unbind(-1), ray.unbind(-1), strict=True)]
        for corners in torch.tensor(self.boxes, dtype=torch.float64):
            ends = room * size + torch.where(room % 2 == 0, corners[:, None], size - corners[:, None])  # (2, 79, 3)
            enter, leave = torch.zeros(len(ray), len(path)), torch.ones(len(ray), len(path))  # fractions of a ray
            for (x, step), (near, far) in zip(axes, ends.unbind(-1), strict=True):
                a, b = (near - x) / step, (far - x) / step
                enter, leave = torch.maximum(enter, torch.minimum(a, b)), torch.minimum(leave, torch.maximum(a, b))
            hits = hits.index_add(1, path, (enter < leave).long())
        return hits > 0


@checked
def simulated_room(
    n: PositiveInt = 300,
    moving: Moving = "transmitter",
    seed: NonNegativeInt = 0,
    room: ShoeboxRoom | None = None,
    grid: AngularGrid = GRID,
    phase_noise: NonNegativeFloat = 0.1,
    position: Tensor | None = None,
) -> Spectra:
    """Return spectra of a 4 x 4 array in the simulated room, with the moving end in a region of 2 x 1.8 x 0.6 m.

    300 positions are a third of a wavelength apart, close enough to interpolate the field between them.

    Args:
        n: Number of positions.
        moving: "transmitter": the array hangs on a wall and faces the room. "receiver": the level array moves under a
            transmitter at the ceiling.
        seed: Seed of positions and noise.
        room: Room that contains the region. Defaults to `ShoeboxRoom()`.
        grid: Directions of the spectra.
        phase_noise: Standard deviation of the phase at each element [rad].
        position: Positions of the moving end, (n, 3) [m]. Defaults to random ones.

    Raises:
        InputError: An argument outside its range, or a position outside the room.

    Example:
        >>> simulated_room(n=20, moving="receiver").spectrum.shape
        torch.Size([20, 30, 120])
    """
    generator = torch.Generator().manual_seed(seed)
    room = room or ShoeboxRoom()
    if position is None:
        low, high = torch.tensor(REGION, dtype=torch.float64)
        position = low + (high - low) * torch.rand(n, 3, dtype=torch.float64, generator=generator)
    position = position.double()
    pose = FACING_X if moving == "transmitter" else CEILING
    fixed = torch.tensor(pose.position, dtype=torch.float64)
    array = PlanarArray.square(4, room.frequency_hz)
    links = [(part, fixed) if moving == "transmitter" else (fixed, part) for part in position.split(BATCH_POSITIONS)]
    parts = [room.paths(*ends) for ends in links]
    channel = torch.cat([paths.channel(array, pose.rotation) for paths in parts])
    noise = phase_noise * torch.randn(channel.shape, dtype=torch.float64, generator=generator)
    return Spectra(
        store=array_spectra(array, channel * unit_phasor(noise), grid),
        position=position,
        array=array,
        moving=moving,
        grid=grid,
        line_of_sight=torch.cat([paths.line_of_sight for paths in parts]),
        name="simulated-room",
        fixed_position=fixed,
        rotation=pose.rotation,
    )


OFFICE = ShoeboxRoom(
    size=(8.0, 6.0, 3.0),
    boxes=(
        ((1.0, 0.6, 0.0), (1.6, 1.9, 1.8)),
        ((4.6, 3.6, 0.0), (5.4, 4.6, 2.2)),
        ((2.2, 3.0, 0.0), (2.5, 4.2, 2.2)),
        ((6.2, 1.0, 0.0), (6.6, 2.4, 2.0)),
    ),
    frequency_hz=2.44e9,
)
STATIONS = {
    "west": ArrayPose((0.1, 2.9, 1.8), (0.0, math.sqrt(0.5), 0.0, math.sqrt(0.5))),
    "east": ArrayPose((7.9, 3.3, 1.9), (0.0, -math.sqrt(0.5), 0.0, math.sqrt(0.5))),
    "south": ArrayPose((4.1, 0.1, 2.0), (-math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5))),
    "north": ArrayPose((3.7, 5.9, 2.1), (math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5))),
}  # on the four walls, each facing the room
OFFICE_REGION = ((1.5, 1.0, 0.9), (6.0, 5.0, 1.5))  # of the transmitter: opposite corners [m]


@checked
def simulated_stations(
    n: PositiveInt = 125,
    stations: Annotated[int, Ge(1), Le(len(STATIONS))] = 3,
    seed: NonNegativeInt = 0,
    grid: AngularGrid = GRID,
    phase_noise: NonNegativeFloat = 0.1,
    snr_db: float | None = None,
) -> Stations:
    """Return spectra of 4 x 4 arrays on the walls of a simulated office, with cupboards between them and the transmitter.

    Args:
        n: Number of positions of the transmitter, in a region of 4.5 x 4 x 0.6 m.
        stations: Number of arrays.
        seed: Seed of positions and noise.
        grid: Directions of the spectra.
        phase_noise: Standard deviation of the phase at each element [rad].
        snr_db: Mean signal-to-noise ratio at an element [dB]. Defaults to channels without noise.

    Raises:
        InputError: An argument outside its range.

    Example:
        >>> simulated_stations(n=20, stations=2)
        <Stations 'simulated-office': 20 transmissions at 2 stations (west, east), moving transmitter,
         positions over ... m>
    """
    generator = torch.Generator().manual_seed(seed)
    low, high = torch.tensor(OFFICE_REGION, dtype=torch.float64)
    position = low + (high - low) * torch.rand(n, 3, dtype=torch.float64, generator=generator)
    array = PlanarArray.square(4, OFFICE.frequency_hz)
    spectra = {}
    for name, pose in list(STATIONS.items())[:stations]:
        channel, line_of_sight = simulated_channel(OFFICE, position, pose, array)
        turn = phase_noise * torch.randn(channel.shape, dtype=torch.float64, generator=generator)
        channel = channel * unit_phasor(turn)
        if snr_db is not None:
            std = channel.abs().square().mean().sqrt() * 10 ** (-snr_db / 20)
            channel = channel + std * torch.randn(channel.shape, dtype=channel.dtype, generator=generator)
        spectra[name] = Spectra(
            store=array_spectra(array, channel, grid),
            position=position,
            array=array,
            pose=pose,
            grid=grid,
            line_of_sight=line_of_sight,
            name=f"simulated-office {name}",
        )
    return Stations(spectra, name="simulated-office")


def simulated_channel(
    room: ShoeboxRoom, position: Tensor, pose: ArrayPose, array: PlanarArray
) -> tuple[Tensor, Tensor]:
    """Return channels (n, S, K) of a fixed array, and where the direct path is unobstructed, bool (n,)."""
    fixed = torch.tensor(pose.position, dtype=torch.float64)
    parts = [room.paths(some, fixed) for some in position.split(BATCH_POSITIONS)]
    channel = torch.cat([paths.channel(array, pose.rotation) for paths in parts])
    return channel, torch.cat([paths.line_of_sight for paths in parts])


FLOOR = ShoeboxRoom(
    size=(20.0, 16.0, 3.0),
    boxes=(
        ((4.0, 3.0, 0.0), (6.5, 3.4, 2.6)),
        ((9.0, 7.0, 0.0), (11.0, 9.5, 2.8)),
        ((14.0, 11.0, 0.0), (14.4, 14.0, 2.6)),
        ((3.0, 11.5, 0.0), (4.5, 13.0, 2.2)),
        ((15.5, 3.0, 0.0), (18.0, 4.0, 2.0)),
    ),
    reflection=-0.6,
    blockage=0.3,
    frequency_hz=2.44e9,
)


@checked
def rssi_room(n: PositiveInt = 600, seed: NonNegativeInt = 0) -> Rssi:
    """Return simulated RSSI at twelve receivers, one packet a row and receiver on a random channel.

    The transmitter has -8 dBm, packets vary by 2 dB (standard deviation), and a tenth are missed. So are those below
    -85 dBm, the sensitivity of a simple receiver.

    Args:
        n: Number of positions of the transmitter.
        seed: Seed of positions, gains, channels, noise and misses.

    Raises:
        InputError: An argument outside its range.

    Example:
        >>> rssi_room(n=20).rssi_dbm.shape
        torch.Size([20, 12])
    """
    generator = torch.Generator().manual_seed(seed)
    x, y = torch.meshgrid(torch.tensor([2.5, 7.5, 12.5, 17.5]), torch.tensor([1.0, 8.0, 15.0]), indexing="ij")
    height = torch.where(torch.arange(12) % 2 == 0, 2.3, 1.2)
    receiver = torch.stack([x.flatten(), y.flatten(), height], dim=1).double()
    low, high = torch.tensor([[0.5, 0.5, 1.0], [19.5, 15.5, 1.4]], dtype=torch.float64)
    position = low + (high - low) * torch.rand(n, 3, dtype=torch.float64, generator=generator)
    gain_db = 2 * torch.randn(12, dtype=torch.float64, generator=generator)  # receivers differ
    power = torch.stack([_power(position, place) for place in receiver], dim=1)  # (n, R, channels)
    channel = torch.randint(len(CHANNELS_HZ), (n, 12, 1), generator=generator)
    noise = 2.0 * torch.randn(n, 12, dtype=torch.float64, generator=generator)
    rssi = (-8.0 + gain_db + power.gather(2, channel)[..., 0] + noise).round()
    missed = (torch.rand(n, 12, generator=generator) < 0.1) | (rssi < -85.0)
    return Rssi(
        torch.where(missed, torch.nan, rssi),
        position,
        receiver_position=receiver,
        receiver_names=[f"receiver{number:02d}" for number in range(1, 13)],
        name="simulated-floor",
    )


def _power(position: Tensor, receiver: Tensor) -> Tensor:
    """Return the power gain of the coherent sum of all paths on each channel, (n, channels) [dB]."""
    paths = PropagationPaths.joined([FLOOR.paths(part, receiver) for part in position.split(BATCH_POSITIONS)])
    assert paths.length is not None
    power = []
    for frequency in CHANNELS_HZ:
        turn = -math.tau / LIGHT_SPEED * (frequency - FLOOR.frequency_hz) * paths.length
        gain = FLOOR.frequency_hz / frequency * paths.gain * unit_phasor(turn)
        power.append(20 * gain.reshape(len(position), -1).sum(dim=1).abs().clamp_min(1e-9).log10())
    return torch.stack(power, dim=1)
