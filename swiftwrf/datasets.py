"""Public data sets: the names of `swiftwrf.contrib.datasets`."""

from swiftwrf.contrib.datasets import *  # noqa: F403 (its public names)
