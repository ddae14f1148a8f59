"""Ray-traced scenes: furnished rooms of boxes, or scene files, traced by Sionna RT (extra `raytrace`)."""

from typing import TYPE_CHECKING

from swiftwrf.runtime.lazy import import_lazily

if TYPE_CHECKING:
    from swiftwrf.contrib.raytraced.rooms import ROOMS as ROOMS
    from swiftwrf.contrib.raytraced.rooms import FurnishedRoom as FurnishedRoom
    from swiftwrf.contrib.raytraced.rooms import Material as Material
    from swiftwrf.contrib.raytraced.rooms import Surface as Surface
    from swiftwrf.contrib.raytraced.trace import Scene as Scene
    from swiftwrf.contrib.raytraced.trace import Tracing as Tracing
    from swiftwrf.contrib.raytraced.trace import open_scene as open_scene
    from swiftwrf.contrib.raytraced.trace import sionna as sionna
    from swiftwrf.contrib.raytraced.trace import trace as trace

import_lazily(__name__)  # commands name rooms before they compute
