"""Models that follow their scene: prequential scores, detection of changes, and adaptation."""

from swiftwrf.contrib.online.follower import Follower, Monitor, Step, adapted
from swiftwrf.contrib.online.scores import Scores, alarm_threshold, prequential, score

__all__ = ["Follower", "Monitor", "Scores", "Step"]
__all__ += ["adapted", "alarm_threshold", "prequential", "score"]
