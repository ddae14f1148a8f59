"""python -m tasks.rssi --rx 6"""

import sys

from tasks.rssi.experiment import RssiTaskConfig, run
from tasks.run import command_line

if __name__ == "__main__":
    sys.exit(command_line("tasks.rssi", RssiTaskConfig, run, sys.argv[1:]))
