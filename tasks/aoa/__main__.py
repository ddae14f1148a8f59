"""python -m tasks.aoa --mix 0.3"""

import sys

from tasks.aoa import arms
from tasks.aoa.config import AoaConfig
from tasks.aoa.experiment import run
from tasks.run import command_line

if __name__ == "__main__":
    sys.exit(command_line("tasks.aoa", AoaConfig, run, sys.argv[1:], arms.meaning))
