"""The built-in scene for spectra: an antenna array in the simulated room."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from swiftwrf.array.angles import AngularGrid, ArrayPose
from swiftwrf.array.planar import PlanarArray
from swiftwrf.data.simulated.room import Room
from swiftwrf.data.spectra import Moving, Spectra, array_spectra

GRID = AngularGrid.hemisphere(30, 120)
FACING_X = ArrayPose((0.1, 2.4, 1.2), (0.0, math.sqrt(0.5), 0.0, math.sqrt(0.5)))  # on the wall x = 0, its normal is +x
LEVEL = ArrayPose((3.0, 2.5, 2.7))  # lies level; the position is that of the fixed transmitter on the ceiling
REGION = ((2.2, 1.6, 0.9), (4.2, 3.4, 1.5))  # where the moving end goes: opposite corners [m]
AT_ONCE = 4096  # positions whose paths are found together: half a gigabyte


def simulated_room(
    n: int = 300,
    moving: Moving = "transmitter",
    seed: int = 0,
    room: Room | None = None,
    grid: AngularGrid = GRID,
    phase_noise: float = 0.1,
    position: Tensor | None = None,
) -> Spectra:
    """Spectra of a 4 x 4 array in the simulated room, the moving end at random places of a region of 2 x 1.8 x 0.6 m.

    With 300 positions neighbours are a third of a wavelength apart, so the field between them can be known.

    Args:
        n: number of positions.
        moving: `transmitter`: the array hangs on a wall and faces the room; `receiver`: the array lies level and moves
            under a transmitter on the ceiling.
        seed: of positions and noise.
        room: another room than the usual one; the region must lie inside.
        grid: directions of the spectra.
        phase_noise: standard deviation at each element [rad].
        position: of the moving end instead of random ones, (n, 3) [m].
    """
    generator = torch.Generator().manual_seed(seed)
    room = room or Room()
    if position is None:
        low, high = torch.tensor(REGION, dtype=torch.float64)
        position = low + (high - low) * torch.rand(n, 3, dtype=torch.float64, generator=generator)
    position = position.double()
    pose = FACING_X if moving == "transmitter" else LEVEL
    fixed = torch.tensor(pose.position, dtype=torch.float64)
    array = PlanarArray.square(4, room.frequency_hz)
    channels, clear, labels = [], [], []
    for some in position.split(AT_ONCE):
        ends = (some, fixed) if moving == "transmitter" else (fixed, some)
        paths = room.paths(*ends)
        owner = torch.arange(len(some)).repeat_interleave(paths.gain.shape[1])
        direction = (paths.direction @ pose.rotation).flatten(0, 1)
        channels.append(array.channel(direction, paths.gain.flatten(), owner, len(some)))
        clear.append(paths.clear[:, 0])
        labels.append(pose.line_of_sight(*ends))
    channel = torch.cat(channels)
    noise = phase_noise * torch.randn(channel.shape, dtype=torch.float64, generator=generator)
    return Spectra(
        name="simulated-room",
        position=position,
        store=array_spectra(array, channel * torch.polar(torch.ones_like(noise), noise), grid),
        grid=grid,
        label=torch.cat(labels),
        line_of_sight=torch.cat(clear),
        moving=moving,
        index=torch.arange(len(position)),
        array=array,
        fixed_position=fixed,
        rotation=pose.rotation,
    )
