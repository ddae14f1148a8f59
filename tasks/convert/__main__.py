"""Run `python -m tasks.convert SOURCE OUT`."""

import sys

from tasks.command import run_command

if __name__ == "__main__":
    sys.exit(run_command("convert", sys.argv[1:]))
