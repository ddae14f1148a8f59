"""The built-in scene for spectra: an antenna array in the simulated room."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from swiftwrf.array.angles import AngularGrid, ArrayPose
from swiftwrf.array.planar import PlanarArray
from swiftwrf.choices import Moving
from swiftwrf.data.simulated.room import ShoeboxRoom
from swiftwrf.data.spectra import Spectra, array_spectra
from swiftwrf.runtime.validation import NonNegativeFloat, NonNegativeInt, PositiveInt, checked

GRID = AngularGrid.hemisphere(30, 120)
FACING_X = ArrayPose((0.1, 2.4, 1.2), (0.0, math.sqrt(0.5), 0.0, math.sqrt(0.5)))  # on the wall x = 0, its normal is +x
CEILING = ArrayPose((3.0, 2.5, 2.7))  # position of the fixed transmitter, orientation of the level array that moves
REGION = ((2.2, 1.6, 0.9), (4.2, 3.4, 1.5))  # of the moving end: opposite corners [m]
BATCH_POSITIONS = 4096  # whose paths take half a gigabyte


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
    links = [(some, fixed) if moving == "transmitter" else (fixed, some) for some in position.split(BATCH_POSITIONS)]
    parts = [room.paths(*ends) for ends in links]
    channel = torch.cat([paths.channel(array, pose.rotation) for paths in parts])
    noise = phase_noise * torch.randn(channel.shape, dtype=torch.float64, generator=generator)
    return Spectra(
        store=array_spectra(array, channel * torch.polar(torch.ones_like(noise), noise), grid),
        position=position,
        array=array,
        moving=moving,
        grid=grid,
        line_of_sight=torch.cat([paths.line_of_sight for paths in parts]),
        name="simulated-room",
        fixed_position=fixed,
        rotation=pose.rotation,
    )
