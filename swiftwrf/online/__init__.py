"""Models that follow their scene: prequential scores, detection of changes, and adaptation."""

from swiftwrf.online.follower import Follower, KernelMonitor, Monitor, MonitorConfig, Step, adapted
from swiftwrf.online.scores import Alarm, Cusum, Scores, alarm_threshold, prequential, score

__all__ = ["Alarm", "Cusum", "Follower", "KernelMonitor", "Monitor", "MonitorConfig", "Scores", "Step"]
__all__ += ["adapted", "alarm_threshold", "prequential", "score"]
