"""python -m tasks.aoa --mix 0.3"""

import sys

from tasks.aoa.condition import meaning
from tasks.aoa.experiment import run
from tasks.aoa.options import AoaConfig
from tasks.run import command_line

if __name__ == "__main__":
    sys.exit(command_line("tasks.aoa", AoaConfig, run, sys.argv[1:], meaning))
