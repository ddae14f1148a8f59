"""Run `python -m tasks.rssi --rx 6`."""

import sys

from tasks.command import run_command

sys.exit(run_command("rssi", sys.argv[1:], "python -m tasks.rssi"))
