"""First module that the server of processes loads: those that follow leave no garbage, and to look for it takes time."""

import atexit
import gc
import os

gc.disable()
atexit.register(os._exit, 0)  # the end of the interpreter would look through all objects for a second
