"""python -m tasks.scenes --room NAME --moving END --positions N --out DIR"""

import sys

from tasks.run import command_line
from tasks.scenes import ScenesConfig, run

if __name__ == "__main__":
    sys.exit(command_line("tasks.scenes", ScenesConfig, run, sys.argv[1:]))
