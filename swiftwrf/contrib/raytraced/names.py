"""Names of scenes: built-in rooms and scene files. Imports no torch."""

from __future__ import annotations

from pathlib import Path

from swiftwrf.errors import InputError

RAYTRACE = "raytrace"  # the field model that takes a scene
SCENE_FILE = ".xml"  # suffix of scene files; other names are those of rooms
ROOMS = {  # what stands in the rooms of rooms.yml
    "conference": "conference room, 8 x 5 x 2.8 m: a table with ten chairs, screen, whiteboard, sideboard",
    "office": "office, 6 x 5 x 2.7 m: four desks with screens, a partition, metal cabinets, shelves",
    "bedroom": "bedroom, 4.2 x 3.6 x 2.5 m: a double bed, wardrobe, chest of drawers, nightstands",
}


def check_scene(name: str, prefix: str = "") -> None:
    """Refuse a name that is neither a built-in room nor a scene file; the message names it after the prefix.

    Raises:
        InputError: No such room or file.

    Example:
        >>> check_scene("office")
    """
    if not name.endswith(SCENE_FILE) and name not in ROOMS:
        raise InputError(f"unknown room {name!r}; choose from {', '.join(ROOMS)}")
    if name.endswith(SCENE_FILE) and not Path(name).is_file():
        raise InputError(f"{prefix}{name} does not exist; expected a Mitsuba scene, or one of {', '.join(ROOMS)}")
