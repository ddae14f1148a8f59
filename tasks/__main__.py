"""python -m tasks: the list of commands."""

import sys

from tasks.command import main

sys.exit(main())
