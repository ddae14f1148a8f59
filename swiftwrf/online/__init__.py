"""Models that follow their scene: prequential scores, detection of changes, adaptation, and obstacles in a room."""

from swiftwrf.online.adaptation import adapted
from swiftwrf.online.change import Alarm, Cusum, alarm_threshold
from swiftwrf.online.follower import Follower, Step
from swiftwrf.online.kernel import KernelMonitor
from swiftwrf.online.monitor import Monitor, MonitorConfig
from swiftwrf.online.obstacles import Boxes, ObstacleMonitor
from swiftwrf.online.prequential import Scores, prequential, score

__all__ = [
    "Alarm",
    "Boxes",
    "Cusum",
    "Follower",
    "KernelMonitor",
    "Monitor",
    "MonitorConfig",
    "ObstacleMonitor",
    "Scores",
]
__all__ += ["Step", "adapted", "alarm_threshold", "prequential", "score"]
