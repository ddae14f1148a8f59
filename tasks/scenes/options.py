"""Options of python -m tasks.scenes, and their checks."""

from __future__ import annotations

from typing import Annotated

import tyro

from swiftwrf.choices import CARRIERS_HZ, ROOMS, SCENE_FILE, Moving, check_scene
from swiftwrf.errors import InputError
from tasks.options import Options, Output, options

RANGES = {"positions": (2, 100_000), "frequency": CARRIERS_HZ, "order": (0, 8), "scattering": (0, 1)}
ROOM_HELP = "a Mitsuba scene with radio materials (FILE.xml), or a built-in room: " + "; ".join(
    f"{name}: {summary}" for name, summary in ROOMS.items()
)


@options
class ScenesConfig(Options):
    """Ray paths in a room with furniture or in a scene file of Mitsuba, traced by Sionna RT (extra: raytrace).

    The directory holds paths.npz, which --data of the tasks reads, and scene.svg, a plan of the room and the positions.

    Example: python -m tasks.scenes --room office --moving receiver --positions 1000 --out office
    """

    room: Annotated[str, tyro.conf.arg(help=ROOM_HELP)]
    moving: Moving
    """which end moves; the array lies level at the receiver"""
    positions: int
    """number of random positions in the region, none of them in furniture"""
    out: str
    """directory to write; must not exist"""
    frequency: float = 2.4e9
    """carrier [Hz]; ITU-R P.2040 knows most materials from 1 GHz on"""
    order: int = 3
    """largest number of reflections (and other interactions) of a path"""
    scattering: float = 0.0
    """fraction of the reflected amplitude that surfaces scatter, 0 to 1"""
    diffraction: bool = False
    """whether to trace paths diffracted at one edge"""
    fixed: tuple[float, float, float] | None = None
    """position of the fixed end [m] (default: that of the room)"""
    region: tuple[float, float, float, float, float, float] | None = None
    """region of the moving end: opposite corners x y z x y z [m] (default: that of the room)"""
    seed: int = 0
    """seed of positions, rays and scattered phases"""
    output: Output = Output()

    def check(self) -> None:
        super().check()
        for name, (low, high) in RANGES.items():
            if not low <= getattr(self, name) <= high:
                unit = " [Hz]" if name == "frequency" else ""
                raise InputError(f"--{name} takes {low:g} to {high:g}{unit}, got {getattr(self, name):g}")
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
