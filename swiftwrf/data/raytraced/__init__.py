"""Ray-traced scenes: furnished rooms of boxes, or scene files, traced by Sionna RT (extra `raytrace`)."""

from swiftwrf.data.raytraced.rooms import ROOMS, Box, FurnishedRoom
from swiftwrf.data.raytraced.scene import SCENE_FILE, Scene, check_scene, sionna
from swiftwrf.data.raytraced.surfaces import Material, Surface, outline
from swiftwrf.data.raytraced.trace import TracedPaths, Tracing, trace

__all__ = [
    "ROOMS",
    "SCENE_FILE",
    "Box",
    "FurnishedRoom",
    "Material",
    "Scene",
    "Surface",
    "TracedPaths",
    "Tracing",
    "check_scene",
    "outline",
    "sionna",
    "trace",
]
