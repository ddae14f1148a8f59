"""Ray-traced scenes: furnished rooms of boxes, or scene files, traced by Sionna RT (extra `raytrace`)."""

from swiftwrf.contrib.raytraced.rooms import ROOMS, FurnishedRoom, Material, Surface
from swiftwrf.contrib.raytraced.trace import Scene, Tracing, open_scene, sionna, trace

__all__ = ["ROOMS", "FurnishedRoom", "Material", "Scene", "Surface", "Tracing"]
__all__ += ["open_scene", "sionna", "trace"]
