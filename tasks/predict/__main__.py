"""Run `python -m tasks.predict MODEL SOURCE`."""

import sys

from tasks.command import run_command

if __name__ == "__main__":
    sys.exit(run_command("predict", sys.argv[1:]))
