"""Run `python -m tasks.aoa --mix 0.3`."""

import sys

from tasks.command import run_command

sys.exit(run_command("aoa", sys.argv[1:], "python -m tasks.aoa"))
