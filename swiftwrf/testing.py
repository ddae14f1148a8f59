"""Checks of your own implementations: the names of `swiftwrf.contrib.testing`."""

from swiftwrf.contrib.testing import *  # noqa: F403 (its public names)
