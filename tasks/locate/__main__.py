"""Run `python -m tasks.locate --rx all`."""

import sys

from tasks.command import run_command

if __name__ == "__main__":
    sys.exit(run_command("locate", sys.argv[1:]))
