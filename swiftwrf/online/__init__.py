"""Models that follow their scene: prequential scores, detection of changes, and adaptation."""

from swiftwrf.online.adaptation import adapted
from swiftwrf.online.change import Alarm, Cusum, alarm_threshold
from swiftwrf.online.follower import Follower, Step
from swiftwrf.online.kernel import KernelMonitor
from swiftwrf.online.monitor import Monitor, MonitorConfig
from swiftwrf.online.prequential import Scores, prequential, score

__all__ = ["Alarm", "Cusum", "Follower", "KernelMonitor", "Monitor", "MonitorConfig", "Scores", "Step"]
__all__ += ["adapted", "alarm_threshold", "prequential", "score"]
