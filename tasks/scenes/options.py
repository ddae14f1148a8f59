"""Options of python -m tasks.scenes, and their checks."""

from __future__ import annotations

from typing import Annotated

import tyro
from annotated_types import Ge, Le

from swiftwrf.choices import CARRIERS_HZ, ROOMS, SCENE_FILE, Moving, check_scene
from swiftwrf.errors import InputError
from swiftwrf.runtime.validation import Fraction
from tasks.options import Options, Output, Seed, options

ROOM_HELP = "a Mitsuba scene with radio materials (FILE.xml), or a built-in room: " + "; ".join(
    f"{name}: {summary}" for name, summary in ROOMS.items()
)


@options
class ScenesConfig(Options):
    """Ray paths in a room with furniture or in a scene file of Mitsuba, traced by Sionna RT (extra: raytrace).

    The directory holds paths.npz, which --data of the tasks reads, and scene.svg, a plan of the room and the positions.

    Example: swiftwrf scenes --room office --moving receiver --positions 1000 --out office
    """

    room: Annotated[str, tyro.conf.arg(help=ROOM_HELP)]
    moving: Moving
    """which end moves; the array lies level at the receiver"""
    positions: Annotated[int, Ge(2), Le(100_000)]
    """number of random positions in the region, none of them in furniture"""
    out: str
    """directory to write; must not exist"""
    frequency: Annotated[float, Ge(CARRIERS_HZ[0]), Le(CARRIERS_HZ[1])] = 2.4e9
    """carrier [Hz]; ITU-R P.2040 knows most materials from 1 GHz on"""
    order: Annotated[int, Ge(0), Le(8)] = 3
    """largest number of reflections (and other interactions) of a path"""
    scattering: Fraction = 0.0
    """fraction of the reflected amplitude that surfaces scatter, 0 to 1"""
    diffraction: bool = False
    """whether to trace paths diffracted at one edge"""
    fixed: tuple[float, float, float] | None = None
    """position of the fixed end [m] (default: that of the room)"""
    region: tuple[float, float, float, float, float, float] | None = None
    """region of the moving end: opposite corners x y z x y z [m] (default: that of the room)"""
    seed: Seed = 0
    """seed of positions, rays and scattered phases"""
    output: Output = Output()

    def check(self) -> None:
        super().check()
        if self.order == 0 and (self.scattering or self.diffraction):
            raise InputError(
                "--order 0 leaves the direct path alone; scattering and diffraction need at least --order 1"
            )
        check_scene(self.room)
        if not self.room.endswith(SCENE_FILE):
            return
        if self.fixed is None or self.region is None:
            raise InputError(
                f"{self.room} does not contain the positions of the ends; give --fixed X Y Z and --region X Y Z X Y Z"
            )
