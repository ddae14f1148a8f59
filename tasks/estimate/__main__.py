"""python -m tasks.estimate ESTIMATOR SOURCE"""

import sys

from tasks.estimate import EstimateConfig, run
from tasks.run import command_line

if __name__ == "__main__":
    sys.exit(command_line("tasks.estimate", EstimateConfig, run, sys.argv[1:]))
