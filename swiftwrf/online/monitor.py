"""A monitor of innovations: whether, where and since when a field no longer follows its model."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import fields
from typing import Annotated, Any

import torch
from annotated_types import Ge, Gt, Lt
from scipy.cluster.vq import kmeans2
from torch import Tensor

from swiftwrf.data.rssi import Rssi
from swiftwrf.data.spectra import Spectra
from swiftwrf.models.base import FieldModel
from swiftwrf.models.process import ProcessModel
from swiftwrf.online.change import Alarm, Cusum, alarm_threshold
from swiftwrf.online.prequential import Scores, score
from swiftwrf.positions import nearest
from swiftwrf.rssi.model import RssiModel
from swiftwrf.runtime.validation import configuration

N_FOLDS = 5  # of the training spectra that give the reference
MAX_INNOVATION = 3.0  # standard deviations; single outliers raise no alarm


@configuration
class MonitorConfig:
    """Options of a `Monitor`.

    Example:
        >>> Monitor(torch.rand(50, 3), config=MonitorConfig(false_alarm_rate=1e-3)).config.n_regions
        8
    """

    false_alarm_rate: Annotated[float, Gt(0), Lt(1)] = 1e-4
    """false alarms a measurement, over all regions and receivers together"""
    n_regions: Annotated[int, Ge(1)] = 8
    """number of regions of the positions that are tested separately, beside all positions together"""
    n_reference: Annotated[int, Ge(10)] = 30
    """number of measurements without alarm, which calibrate the innovations if no reference is given"""


class Monitor:
    """Cumulative sums of innovations: of all positions and of each region; for RSSI of each receiver, up and down.

    Innovations of spectra are replaced by normal scores, their rank among those of a reference. Innovations of RSSI are
    standard normal if the standard deviations of the model are right.

    Args:
        position: Positions around which the model was fitted, (n, 3) [m], which give the regions.
        receiver_names: Names of the receivers; none for spectra.
        reference: Innovations (n,) of spectra of the unchanged scene. Defaults to the first measurements.
        config: Options.

    Example:
        >>> import swiftwrf
        >>> data = swiftwrf.simulated_room(n=60)
        >>> train, new = data.subset(torch.arange(50)), data.subset(torch.arange(50, 60))
        >>> model = swiftwrf.make_model("coarray").fit(train)
        >>> monitor = Monitor.of(model, train)
        >>> scores = score(model, new)
        >>> [alarm for at, z in zip(scores.position, scores.innovation) for alarm in monitor.observe(at, z)]
        []
    """

    def __init__(
        self,
        position: Tensor,
        receiver_names: Sequence[str] = (),
        reference: Tensor | None = None,
        config: MonitorConfig | None = None,
    ) -> None:
        self.config, self.receiver_names = config or MonitorConfig(), tuple(receiver_names)
        n_regions = min(self.config.n_regions, max(1, len(position) // 10))
        self.centre = torch.from_numpy(kmeans2(position.double().numpy(), n_regions, seed=0, minit="++")[0])
        self.reference = torch.zeros(0, dtype=torch.float64) if reference is None else reference.double()
        self.cusum = Cusum.start((1 + n_regions) * (2 * len(self.receiver_names) or 1))
        self.threshold = alarm_threshold(self.config.false_alarm_rate, len(self.cusum.value))

    @classmethod
    def of(
        cls, model: FieldModel | RssiModel, train: Spectra | Rssi | None = None, config: MonitorConfig | None = None
    ) -> Monitor:
        """Return the monitor of a fitted model.

        Args:
            model: Fitted model.
            train: Its training data in their order. Spectra give the reference; see `held_out_scores`.
            config: Options.
        """
        if isinstance(model, RssiModel):
            return cls(model.region(), model.receiver_names, None, config)
        if isinstance(train, Spectra):
            model.check_measurements(train)
        reference = held_out_scores(model, train).innovation[:, 0] if isinstance(train, Spectra) else None
        return cls(model.region(), (), reference, config)

    def observe(self, position: Tensor, innovation: Tensor) -> list[Alarm]:
        """Add the innovations of one measurement at a position (3,) [m], (1,) or (R,); return the alarms."""
        value = innovation.double()
        if self.receiver_names:
            standard = value.clamp(-MAX_INNOVATION, MAX_INNOVATION)
            standard = torch.cat([standard, -standard])
        elif self.cusum.count == 0 and len(self.reference) < self.config.n_reference:
            self.reference = torch.cat([self.reference, value])
            return []
        else:
            rank = (self.reference < value).double().sum() + 0.5
            standard = torch.special.ndtri(rank / (len(self.reference) + 1))[None]
        series = torch.full((1 + len(self.centre), len(standard)), torch.nan, dtype=torch.float64)
        series[[0, 1 + int(nearest(position[None], self.centre, 1)[1])]] = standard
        self.cusum, alarms = self.cusum.updated(series.flatten(), self.threshold)
        return alarms

    def state(self) -> dict[str, Any]:
        """Return reference, regions and sums as plain values."""
        sums = {"value": self.cusum.value.tolist(), "since": self.cusum.since.tolist(), "count": self.cusum.count}
        return {"reference": self.reference.tolist(), "centre": self.centre.tolist(), "cusum": sums}

    def continued(self, state: dict[str, Any]) -> Monitor:
        """Return this monitor with the regions and sums of a `state`."""
        monitor, sums = copy(self), state["cusum"]
        monitor.reference, monitor.centre = (
            torch.tensor(state[name], dtype=torch.float64) for name in ("reference", "centre")
        )
        monitor.cusum = Cusum(torch.tensor(sums["value"]).double(), torch.tensor(sums["since"]), int(sums["count"]))
        monitor.threshold = alarm_threshold(self.config.false_alarm_rate, len(monitor.cusum.value))
        return monitor

    def describe(self, alarm: Alarm) -> str:
        """Return what changed and where, in words."""
        region, column = divmod(alarm.series, 2 * len(self.receiver_names) or 1)
        where = "everywhere"
        if region:
            where = "around " + ", ".join(f"{x:.1f}" for x in self.centre[region - 1].tolist()) + " m"
        if not self.receiver_names:
            return f"spectra {where}"
        change = "stronger" if column < len(self.receiver_names) else "weaker"
        return f"{self.receiver_names[column % len(self.receiver_names)]} {change} {where}"


def held_out_scores(model: FieldModel, train: Spectra) -> Scores:
    """Return the scores of training spectra, each fifth of them predicted without itself if the model can forget spectra.

    Args:
        model: Fitted model.
        train: Its training spectra in their order.
    """
    if not isinstance(model, ProcessModel):
        return score(model, train)
    parts, order = [], []
    for rows in torch.randperm(len(train), generator=torch.Generator().manual_seed(0)).chunk(N_FOLDS):
        parts.append(score(model.forget(rows), train.subset(rows)))
        order.append(rows)
    back = torch.cat(order).argsort()
    joined = Scores.joined(parts)
    return Scores(*(getattr(joined, field.name)[back] for field in fields(joined)))
