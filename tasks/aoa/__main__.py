"""Run `python -m tasks.aoa --mix 0.3`."""

import sys

from tasks.command import run_command

if __name__ == "__main__":
    sys.exit(run_command("aoa", sys.argv[1:]))
