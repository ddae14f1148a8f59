"""python -m tasks.view RUN_OR_MODEL"""

import sys

from tasks.run import command_line
from tasks.view import ViewConfig, run

if __name__ == "__main__":
    sys.exit(command_line("tasks.view", ViewConfig, run, sys.argv[1:]))
