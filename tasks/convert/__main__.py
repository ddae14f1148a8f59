"""python -m tasks.convert SOURCE OUT"""

import sys

from tasks.convert import ConvertConfig, run
from tasks.run import command_line

if __name__ == "__main__":
    sys.exit(command_line("tasks.convert", ConvertConfig, run, sys.argv[1:]))
