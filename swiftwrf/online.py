"""Models of measurements that arrive one after another: the names of `swiftwrf.contrib.online`."""

from swiftwrf.contrib.online import *  # noqa: F403 (its public names)
