"""python -m tasks.inspect SOURCE"""

import sys

from tasks.inspect import InspectConfig, run
from tasks.run import command_line

if __name__ == "__main__":
    sys.exit(command_line("tasks.inspect", InspectConfig, run, sys.argv[1:]))
