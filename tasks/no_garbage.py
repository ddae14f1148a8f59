"""First module that the server of processes loads: those that follow leave no garbage, and to look for it takes time."""

import gc

gc.disable()
