"""Run `python -m tasks.estimate ESTIMATOR SOURCE`."""

import sys

from tasks.command import run_command

if __name__ == "__main__":
    sys.exit(run_command("estimate", sys.argv[1:]))
