"""Downstream tasks: angle of arrival and RSSI."""

import os

# Threads that have done their part of a loop wait busily for the others, for milliseconds by default, before they sleep.
# Beside other work on the same cores that made the network's steps eight times slower (benchmarks/busy.py). libgomp reads
# this when torch is loaded, and a user's own choice counts.
if "OMP_WAIT_POLICY" not in os.environ:
    os.environ.setdefault("GOMP_SPINCOUNT", "30000")
