"""Run `python -m tasks.scenes --room NAME --moving END --positions N --out DIR`."""

import sys

from tasks.command import run_command

if __name__ == "__main__":
    sys.exit(run_command("scenes", sys.argv[1:]))
