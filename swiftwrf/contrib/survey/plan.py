"""Plans of access points: the coverage that a further one adds, by the path loss and shadowing that a survey determined.

Coverage is the expected share of scans in the measured area with a receiver above a threshold. Maps are uncertain, so it is
computed for samples of them:

    M_r(x) = mean_r(x) + std_r(x) g_r(x)                          a receiver of the survey
    M_c(x) = level + slope log10 |x - c| - floors + field_db g(x)  a further one at c

The fields g are Gaussian processes with the kernel of the survey's residuals. Level and slope are those of its receivers,
with their spread. The terms of a link are reciprocal, so a receiver stands for an access point.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import torch
from pandas import DataFrame
from torch import Tensor

from swiftwrf.contrib.survey.receivers import SharedPathLoss, locate_receivers
from swiftwrf.data.coordinates import degree_columns
from swiftwrf.data.dataset import Numbers
from swiftwrf.data.rssi import Rssi, receiver_row
from swiftwrf.errors import InputError
from swiftwrf.gp import subsample
from swiftwrf.metrics import LEVEL
from swiftwrf.plotting import Displayed
from swiftwrf.positions import check_positions, inside
from swiftwrf.rssi.coverage import Coverage, reach
from swiftwrf.rssi.maps import RssiMap
from swiftwrf.rssi.model import RssiModel
from swiftwrf.rssi.path_loss import log_distance
from swiftwrf.rssi.scans import at_least
from swiftwrf.runtime.threads import single_thread
from swiftwrf.runtime.validation import NonNegativeInt, checked

N_CELLS = 800  # of the measured area, on all floors together
N_CANDIDATES = 150  # places that are compared if none are given
N_SAMPLES = 60  # of the maps
HEIGHT_M = 1.0  # of a candidate above the scans if no receiver has a known position
WORTH = 0.02  # gain of coverage below which a further access point is not worth it


@dataclass(frozen=True, eq=False)
class CoveragePlan(Displayed):
    """Coverage of a survey and of changes to its access points.

    Args:
        threshold_dbm: Threshold.
        measured: Coverage as surveyed, samples (S,).
        before: Coverage with access points switched off and powers changed, samples (S,).
        candidates: Compared places, float64 (m, 3) [m].
        gain: Coverage that one access point at each candidate adds to `before`, samples (m, S).
        chosen: Numbers of the chosen candidates, in order.
        after: Coverage after each of them, samples (k, S).
        cells: Cells of the measured area, float64 (n, 3) [m].
        probability: Probability of a receiver above the threshold in each cell, before and after all changes, (2, n).
        survey: Rows of the survey.
    """

    threshold_dbm: float
    measured: Tensor
    before: Tensor
    candidates: Tensor
    gain: Tensor
    chosen: tuple[int, ...]
    after: Tensor
    cells: Tensor
    probability: Tensor
    survey: Rssi

    def to_frame(self) -> DataFrame:
        """Return a table of the candidates, the best first: place, gain of coverage with its 80 % interval, and rank."""
        mean, low, high = interval(self.gain)
        order = mean.argsort(descending=True, stable=True)
        at = self.candidates[order].numpy()
        rank = {number: str(i) for i, number in enumerate(self.chosen, start=1)}
        floors = self.survey.floors
        table = DataFrame(at.round(3), columns=["x_m", "y_m", "z_m"])
        table = table.assign(**degree_columns(self.survey.origin, at))
        if floors is not None:
            table["floor"] = floors.named(self.candidates[order])
        table = table.assign(
            **{
                name: values[order].numpy().round(4)
                for name, values in (("gain", mean), ("gain_low", low), ("gain_high", high))
            }
        )
        return table.assign(chosen=[rank.get(number, "") for number in order.tolist()])

    def __repr__(self) -> str:
        return f"<CoveragePlan: {float(self.before.mean()):.0%} above {self.threshold_dbm:g} dBm, {len(self.chosen)} chosen>"

    def _facts(self) -> dict[str, str]:
        shares = {"before": self.before, **{f"after {i}": one for i, one in enumerate(self.after, start=1)}}
        return {"threshold": f"{self.threshold_dbm:g} dBm"} | {
            name: f"{float(one.mean()):.1%}" for name, one in shares.items()
        }


def interval(samples: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the mean and the ends of the 80 % interval of samples (..., S)."""
    tail = (1 - LEVEL) / 2
    low, high = samples.quantile(torch.tensor([tail, 1 - tail], dtype=samples.dtype), dim=-1)
    return samples.mean(dim=-1), low, high


@checked
@single_thread()
def plan_coverage(
    model: RssiModel,
    survey: Rssi,
    count: NonNegativeInt = 1,
    *,
    above_dbm: float = -67.0,
    candidates: Numbers | None = None,
    off: Sequence[str] = (),
    power_db: Mapping[str, float] | None = None,
    seed: int = 0,
) -> CoveragePlan:
    """Return the coverage that further access points add, at the places where they add most, chosen one after the other.

    A choice counts the gain in each cell once more by the share of scans that fail there: holes count more than edges of
    covered areas. On 24 simulated floors, other than those of `benchmarks/survey.py`, the chosen places lose 1.3 points of
    coverage against the best ones, and 1.6 points without it.

    Args:
        model: Model fitted to the survey.
        survey: Measured rows. Positions of receivers that it does not contain are estimated.
        count: Number of further access points.
        above_dbm: Threshold of the coverage [dBm].
        candidates: Places to compare, (m, 3) [m]. Defaults to a grid inside of what was walked.
        off: Receivers that are switched off, by name or number from 1. To move one, switch it off and add one.
        power_db: Changes of the transmit power by name [dB].
        seed: Seed of the samples.

    Raises:
        InputError: Receivers that move, an unknown receiver, no position of any receiver, or fewer candidates than access
            points.

    Example:
        >>> import swiftwrf
        >>> floor = swiftwrf.rssi_room(n=150).columns([0, 1, 2])
        >>> found = plan_coverage(swiftwrf.RssiModel().fit(floor), floor, above_dbm=-60)
        >>> float(found.candidates[found.chosen[0], 0]) > 8.0  # the receivers are at x = 2.5 m
        True
    """
    if survey.receiver_moves:
        raise InputError(f"the receivers of {survey.name} move; a plan is for access points at fixed places")
    if survey.origin != model.origin:
        raise InputError(f"{survey.name} has another origin than the model; give survey.about(model.origin)")
    names, changes = list(survey.receiver_names), {**(power_db or {})}
    switched = {receiver_row(names, name, survey.name) for name in off}
    change = torch.zeros(len(names), dtype=torch.float64)
    for name, db in changes.items():
        change[receiver_row(names, name, survey.name)] = db
    generator = torch.Generator().manual_seed(seed)
    area = _Area.of(model, survey, above_dbm, generator)
    every = torch.arange(len(names))
    kept = every[[number not in switched for number in range(len(names))]]
    measured = area.share(area.existing(every, torch.zeros_like(change)))
    missing = area.existing(kept, change)  # probability that no receiver is above, (S, n)
    before = area.share(missing)
    places = area.grid() if candidates is None else check_positions(candidates, "candidates")
    if count > len(places):
        raise InputError(f"{count} access points cannot be chosen among {len(places)} candidates; give more")
    first, gain = missing.mean(dim=0), torch.zeros(len(places), N_SAMPLES, dtype=torch.float64)
    chosen: list[int] = []
    after: list[Tensor] = []
    for number in range(max(count, 1) if len(places) else 0):
        fields = area.new_fields()
        absent = [area.further(place, *fields) for place in places]
        shares = torch.stack([area.share(missing * none) for none in absent])
        if number == 0:
            gain = shares - before
        if number < count:
            holes = missing * missing.mean(dim=0)  # where most scans fail
            scores = torch.stack([(holes * (1 - none)).mean() for none in absent])
            scores[chosen] = -math.inf
            best = int(scores.argmax())
            chosen.append(best)
            after.append(shares[best])
            missing = missing * absent[best]
    return CoveragePlan(
        threshold_dbm=above_dbm,
        measured=measured,
        before=before,
        candidates=places,
        gain=gain,
        chosen=tuple(chosen),
        after=torch.stack(after) if after else torch.zeros(0, N_SAMPLES, dtype=torch.float64),
        cells=area.position,
        probability=1 - torch.stack([first, missing.mean(dim=0)]),
        survey=survey,
    )


@dataclass(frozen=True, eq=False)
class _Area:
    """The cells of the measured area, with the maps of the receivers there.

    Args:
        model: Fitted model.
        survey: Rows.
        shared: Path loss that all receivers share.
        receiver: Positions of receivers, known or estimated, nan else, (R, 3) [m].
        position: Cells (n, 3) [m].
        mean: Mean of detected packets, (R, n) [dBm].
        std: Their standard deviation, (R, n) [dB].
        detection: Probability of a detection, (R, n).
        threshold_dbm: Threshold.
        generator: Generator of the samples.
    """

    model: RssiModel
    survey: Rssi
    shared: SharedPathLoss
    receiver: Tensor
    position: Tensor
    mean: Tensor
    std: Tensor
    detection: Tensor
    threshold_dbm: float
    generator: torch.Generator = field(repr=False)

    @classmethod
    def of(cls, model: RssiModel, survey: Rssi, threshold_dbm: float, generator: torch.Generator) -> _Area:
        receiver = survey.receiver_position.double().clone()
        if not bool(survey.receiver_located.all()):
            try:
                found = locate_receivers(survey)
            except InputError:
                found = None
            if found is not None:
                number = torch.tensor([survey.receiver_names.index(name) for name in found.names])
                receiver[number] = found.position
        if not bool(receiver.isfinite().all(dim=1).any()):
            raise InputError(
                f"{survey.name} has no receiver whose position is known or can be estimated, so the path loss of a further "
                "access point is unknown; give receivers.csv beside the survey"
            )
        rows = survey if model.attenuation is None else model.attenuation.removed(survey)
        known = receiver.isfinite().all(dim=1).nonzero()[:, 0].tolist()
        shared = SharedPathLoss.fit(rows.columns(known), receiver[known])
        floors = survey.floors
        heights: Sequence[float | None] = [None] if floors is None else floors.height_m
        at = survey.transmitter_position
        low, high = at.amin(dim=0)[:2], at.amax(dim=0)[:2]
        edge = max(
            math.sqrt(float((high - low).prod()) * len(heights) / N_CELLS), float((high - low).max()) / 200, 1e-3
        )
        parts = []
        for n, height in enumerate(heights):
            scans = survey if floors is None else survey[floors.number(at) == n]
            if len(scans):
                chart = RssiMap.predict(model, edge, height, scans.transmitter_position, detected=True)
                chosen = Coverage.of(chart, scans, (threshold_dbm, 0.9, 1), reach(model)).measured
                x, y = np.meshgrid(chart.x, chart.y)
                cells = np.stack([x, y, np.full_like(x, chart.height)], axis=-1)[chosen]
                maps = np.stack([chart.mean, chart.std, chart.detection])[:, :, chosen]
                parts.append((torch.from_numpy(cells), torch.from_numpy(maps).double()))
        position = torch.cat([cells for cells, _ in parts])
        if not len(position):
            raise InputError(f"no cell of {survey.name} is measured; survey an area, and not a line")
        mean, std, detection = torch.cat([maps for _, maps in parts], dim=2)
        return cls(model, survey, shared, receiver, position, mean, std, detection, threshold_dbm, generator)

    @cached_property
    def _factor(self) -> Tensor:
        """Cholesky factor of the correlation of fields between cells, (n, n)."""
        correlation = self.shared.kernel(self.position, self.position)
        factor: Tensor = torch.linalg.cholesky(correlation + 1e-6 * torch.eye(len(self.position), dtype=torch.float64))
        return factor

    def _fields(self, *shape: int) -> Tensor:
        """Return samples of unit variance in the cells, (*shape, n)."""
        drawn = torch.randn(*shape, len(self.position), dtype=torch.float64, generator=self.generator)
        return drawn @ self._factor.T

    @cached_property
    def _existing_fields(self) -> Tensor:
        """Samples of the receivers' fields, the same for all changes, (S, R, n)."""
        return self._fields(N_SAMPLES, len(self.mean))

    def new_fields(self) -> tuple[Tensor, Tensor]:
        """Return samples of level and slope of a further receiver, (S, 2), and of its field in the cells, (S, n) [dB]."""
        drawn = torch.randn(N_SAMPLES, 2, dtype=torch.float64, generator=self.generator)
        loss = drawn @ self.shared.root.T + torch.tensor([self.shared.level, self.shared.slope], dtype=torch.float64)
        loss[:, 1].clamp_max_(0.0)
        mean, std = self._common
        std_db = math.sqrt(self.shared.field_db**2 - self.shared.common_db**2 + std**2)
        return loss, mean + std_db * self._fields(N_SAMPLES)

    @cached_property
    def _common(self) -> tuple[Tensor, float]:
        """The part of the field that all receivers have in each cell, (n,) [dB], and its standard deviation [dB].

        A residual of the R maps is this part of variance v plus another one of variance w. Given their mean m, this part has
        the mean m v / (v + w / R) and the variance v w / (R v + w).
        """
        located = self.receiver.isfinite().all(dim=1)
        distance = log_distance(self.position, self.receiver[located])
        mean = self.mean[located]
        if self.model.attenuation is not None:
            mean = mean - self.model.attenuation.of(self.position).T[located]
        residual = (mean - self.shared.each(distance).T).mean(dim=0)
        v, count = self.shared.common_db**2, int(located.sum())
        w = self.shared.field_db**2 - v
        if v == 0:
            return torch.zeros_like(residual), 0.0
        return v / (v + w / count) * residual, math.sqrt(v * w / (count * v + w))

    def existing(self, columns: Tensor, change_db: Tensor) -> Tensor:
        """Return the probability that a scan has none of these receivers above the threshold, samples (S, n)."""
        if not len(columns):
            return torch.ones(N_SAMPLES, len(self.position), dtype=torch.float64)
        noise = self.model.noise_db[columns].double()[:, None]
        map_std = (self.std[columns].square() - noise.square()).clamp_min(0).sqrt()
        mean = self.mean[columns] + change_db[columns, None] + map_std * self._existing_fields[:, columns]  # (S, r, n)
        detection = self.detection[columns]
        if self.model.detection is not None and bool(change_db.any()):
            curve = self.model.detection.columns(columns)
            z = (mean.mean(dim=0) - curve.limit[:, None]) / (self.std[columns].square() + curve.width**2).sqrt()
            shifted = (1 - curve.missed[:, None]) * torch.special.ndtr(z)
            detection = shifted.where(change_db[columns, None] != 0, detection)
        std, limit = noise.expand(-1, len(self.position)), (self.threshold_dbm, self.model.scan_correlation)
        return torch.stack([1 - at_least(1, each, std, detection, *limit) for each in mean])

    def further(self, place: Tensor, loss: Tensor, fields: Tensor) -> Tensor:
        """Return the probability that a further receiver at a place (3,) [m] is not above the threshold, samples (S, n)."""
        distance = (self.position - place).norm(dim=1).clamp_min(0.3).log10()
        mean = loss[:, :1] + loss[:, 1:] * distance + fields
        if (attenuation := self.model.attenuation) is not None:
            mean = mean + attenuation.between(self.position, place.expand_as(self.position))
        missed = 0.0 if self.model.detection is None else float(self.model.detection.missed.median())
        z = (mean - self.threshold_dbm) / self.shared.noise_db
        none: Tensor = 1 - (1 - missed) * torch.special.ndtr(z)
        return none

    def share(self, missing: Tensor) -> Tensor:
        """Return the coverage by the probability (S, n) that no receiver is above, (S,)."""
        return 1 - missing.mean(dim=1)

    def grid(self) -> Tensor:
        """Return candidate places inside of what was walked, at the height of the receivers above the scans, (m, 3) [m]."""
        located = self.receiver[self.survey.receiver_located]
        floors, at = self.survey.floors, self.position.clone()
        if floors is None:
            height = float(located[:, 2].mean()) if len(located) else float(at[:, 2].median()) + HEIGHT_M
            at[:, 2] = height
        else:
            at[:, 2] += HEIGHT_M
        (chosen,) = subsample(torch.randperm(len(at), generator=torch.Generator().manual_seed(0)), rows=N_CANDIDATES)
        walked = inside(at.numpy(), self.survey.transmitter_position.numpy())
        chosen = chosen[torch.from_numpy(walked)[chosen]]
        return at[chosen.sort().values]
