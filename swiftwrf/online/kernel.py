"""Choice of the kernel while a model learns, by its scores of new measurements."""

from __future__ import annotations

import torch
from scipy import stats

from swiftwrf.data.rssi import Rssi
from swiftwrf.data.spectra import Spectra
from swiftwrf.data.splits import MIN_TRAINING
from swiftwrf.gp import Kernel
from swiftwrf.models.process import ProcessModel
from swiftwrf.online.prequential import Scores, learnt, score
from swiftwrf.rssi.model import RssiModel

MIN_NEW, MIN_GROWTH = 30, 0.1  # measurements, and relative to those before, after which a choice is made


class KernelMonitor:
    """Choice of the kernel whenever a model has learnt 30 measurements and a tenth of its data more.

    The kernel is chosen by all data before these measurements. It is kept if it predicts these measurements, each before it
    is learnt, with an error that is lower by a paired t-test of the log errors. The level of the test is the false-alarm
    rate times the number of measurements.

    Args:
        false_alarm_rate: Kernels per measurement that are kept though they are no better.

    Example:
        >>> import swiftwrf
        >>> data = swiftwrf.rssi_room(n=61)
        >>> model, new = RssiModel().fit(data.subset(torch.arange(60))), data.subset(torch.tensor([60]))
        >>> KernelMonitor(1e-4).observe(model.update(new), new, score(model, new)) is None
        True
    """

    def __init__(self, false_alarm_rate: float) -> None:
        self.false_alarm_rate = false_alarm_rate
        self.restart()

    def restart(self) -> None:
        """Begin with new measurements."""
        self._new: list[Spectra | Rssi] = []
        self._scores: list[Scores] = []

    def observe(
        self, model: ProcessModel | RssiModel, new: Spectra | Rssi, scores: Scores
    ) -> ProcessModel | RssiModel | None:
        """Add one measurement; return the model with another kernel if that predicts better.

        Args:
            model: Model that has learnt the measurement.
            new: The measurement.
            scores: Its scores before it was learnt.
        """
        self._new.append(new)
        self._scores.append(scores)
        n, count = len(model.region()), len(self._new)
        if count < max(MIN_NEW, MIN_GROWTH * (n - count)) or n - count < MIN_TRAINING:
            return None
        last, error = self._new, Scores.joined(self._scores).error
        self.restart()
        other = model.with_chosen_kernel(without=torch.arange(n - count, n))
        if other.kernel == model.kernel:
            return None
        found = []
        for one in last:
            found.append(score(other, one))
            other = learnt(other, one)
        gain = error.log() - Scores.joined(found).error.log()
        better = stats.ttest_1samp(gain, 0.0, nan_policy="omit", alternative="greater")
        return other if better.pvalue < self.false_alarm_rate * count else None


def described(old: Kernel, new: Kernel) -> str:
    """Return how a kernel differs from an earlier one, in words.

    Example:
        >>> described(Kernel(1.0, matern12_weight=1.0), Kernel(0.5, matern12_weight=1.0, noise=0.1))
        'correlation length 1 -> 0.5 m, noise 0.01 -> 0.1'
    """
    lengths = f"correlation length {old.correlation_length:.2g} -> {new.correlation_length:.2g} m"
    return f"{lengths}, noise {old.noise:.2g} -> {new.noise:.2g}"
