"""Ray-traced scenes: furnished rooms of boxes, or scene files, traced by Sionna RT (extra `raytrace`)."""

from swiftwrf.data.raytraced.rooms import ROOMS, SCENE_FILE, Box, FurnishedRoom, check_scene
from swiftwrf.data.raytraced.scene import Scene, open_scene, sionna
from swiftwrf.data.raytraced.surfaces import Material, Surface
from swiftwrf.data.raytraced.trace import Tracing, trace

__all__ = ["ROOMS", "SCENE_FILE", "Box", "FurnishedRoom", "Material", "Scene", "Surface", "Tracing"]
__all__ += ["check_scene", "open_scene", "sionna", "trace"]
