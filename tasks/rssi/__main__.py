"""Run `python -m tasks.rssi --rx 6`."""

import sys

from tasks.command import run_command

if __name__ == "__main__":
    sys.exit(run_command("rssi", sys.argv[1:]))
