"""python -m tasks.scenes --room NAME --moving END --positions N --out DIR"""

import sys

from swiftwrf.data.raytraced import ROOMS
from tasks.run import command_line
from tasks.scenes import ScenesConfig, run


def rooms() -> str:
    """Return the built-in rooms, for the help."""
    return "\n\n".join(f"{name}: {room.summary}" for name, room in ROOMS.items())


if __name__ == "__main__":
    sys.exit(command_line("tasks.scenes", ScenesConfig, run, sys.argv[1:], rooms))
