"""Run `python -m tasks.inspect SOURCE`."""

import sys

from tasks.command import run_command

if __name__ == "__main__":
    sys.exit(run_command("inspect", sys.argv[1:]))
