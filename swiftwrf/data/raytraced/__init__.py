"""Ray-traced scenes: furnished rooms of boxes, or scene files, traced by Sionna RT (extra `raytrace`)."""

from swiftwrf.data.raytraced.rooms import ROOMS, Box, FurnishedRoom
from swiftwrf.data.raytraced.scene import Scene, open_scene, sionna
from swiftwrf.data.raytraced.surfaces import Material, Surface
from swiftwrf.data.raytraced.trace import Tracing, trace

__all__ = ["ROOMS", "Box", "FurnishedRoom", "Material", "Scene", "Surface", "Tracing"]
__all__ += ["open_scene", "sionna", "trace"]
