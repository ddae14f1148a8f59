"""Run `python -m tasks.report RUN [RUN ...]`."""

import sys

from tasks.command import run_command

sys.exit(run_command("report", sys.argv[1:]))
