"""Run `python -m tasks.scenes --room NAME --moving END --positions N --out DIR`."""

import sys

from tasks.command import run_command

sys.exit(run_command("scenes", sys.argv[1:]))
