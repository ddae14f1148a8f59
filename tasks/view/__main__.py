"""Run `python -m tasks.view RUN_OR_MODEL`."""

import sys

from tasks.command import run_command

if __name__ == "__main__":
    sys.exit(run_command("view", sys.argv[1:]))
