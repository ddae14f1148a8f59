"""Attenuation of floors and offsets between groups of rows, which are removed from RSSI before a fit.

    rssi = rssi within a floor and group - F |floor(s) - floor(receiver)| + offset of the group       [dBm]

F is the floor attenuation factor (S. Y. Seidel and T. S. Rappaport, IEEE Transactions on Antennas and Propagation 40, 1992),
linear in the number of floors. Groups are devices, channels or any other between which RSSI has constant offsets.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import torch
from torch import Tensor

from swiftwrf.data.coordinates import Floors
from swiftwrf.data.rssi import Offsets, Rssi
from swiftwrf.errors import InputError, listed
from swiftwrf.gp import Kernel
from swiftwrf.rssi.path_loss import fit_path_losses, log_distance
from swiftwrf.runtime.threads import single_thread


@dataclass(frozen=True)
class FloorAttenuation:
    """Attenuation of each floor between transmitter and receiver.

    Args:
        floors: Floors of the building.
        receiver_floor: Number of each receiver's floor.
        db: Attenuation of a floor [dB].

    Example:
        >>> floors = Floors(("ground", "first"), (0.0, 3.0))
        >>> FloorAttenuation(floors, receiver_floor=(0,), db=15.0).of(torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, 3.0]]))
        tensor([[ -0.],
                [-15.]], dtype=torch.float64)
    """

    floors: Floors
    receiver_floor: Annotated[tuple[int, ...], "r"]
    db: float

    def of(self, position: Tensor) -> Tensor:
        """Return the RSSI that the floors take from transmitters (n, 3) at each receiver, float64 (n, R) [dB]."""
        receiver = torch.tensor(self.receiver_floor)
        return -self.db * (self.floors.number(position.detach())[:, None] - receiver).abs().double()

    def between(self, a: Tensor, b: Tensor) -> Tensor:
        """Return the RSSI that the floors between positions a and b (m, 3) take, float64 (m,) [dB]."""
        return -self.db * (self.floors.number(a.detach()) - self.floors.number(b.detach())).abs().double()

    def removed(self, data: Rssi) -> Rssi:
        """Return the data as if all links were within a floor."""
        return data.derived(rssi_dbm=data.rssi_dbm - self.of(data.transmitter_position))


def estimate_floor_attenuation(data: Rssi, max_rows: int = 3000) -> FloorAttenuation:
    """Estimate the attenuation of a floor jointly with the path-loss models of the receivers; see `fit_path_losses`.

    A receiver of unknown position counts as on the floor of its strongest mean RSSI, amid its three strongest rows.

    Args:
        data: Training rows with floors, at all receivers that determine the attenuation.
        max_rows: Number of rows that determine it, drawn at random. In the building of ts-uji1, 1,500, 3,000 and 6,000 rows
            give 4.4, 3.7 and 4.3 dB, and all 19,861 take 20 times as long as 1,500.

    Raises:
        InputError: Rows without floors.

    Example:
        >>> import pandas as pd
        >>> table = pd.DataFrame({"x": [0.0, 5, 9] * 4, "y": 0.0, "floor": [0] * 6 + [1] * 6})
        >>> table["hall"] = [-50.0, -60, -64] * 2 + [-65.0, -75, -79] * 2
        >>> round(estimate_floor_attenuation(Rssi.from_frame(table)).db)
        15
    """
    if data.floors is None:
        raise InputError(f"{data.name} has no floors; give the table a column with the floor of each row")
    floor, rssi = data.floors.number(data.transmitter_position), data.rssi_dbm
    member = torch.nn.functional.one_hot(floor, len(data.floors.names)).double()
    count = member.T @ data.detected.double()  # rows of each floor that a receiver detected
    weak = rssi.nan_to_num(float(rssi[data.detected].min()))  # what was not received was weak
    mean = (member.T @ weak) / member.sum(dim=0)[:, None]
    strongest = mean.where(count >= count.amax(dim=0).clamp(1, 3), -torch.inf).argmax(dim=0)
    receiver_floor = data.floors.number(data.receiver_position.nan_to_num(0.0)).where(data.receiver_located, strongest)
    nearby = data.transmitter_position[rssi.nan_to_num(-torch.inf).topk(min(3, len(data)), dim=0).indices].mean(dim=0)
    receiver = data.receiver_position.where(data.receiver_located[:, None], nearby)
    crossed = (floor[:, None] - receiver_floor).abs().double()
    rows = torch.randperm(len(data), generator=torch.Generator().manual_seed(0))[:max_rows].sort().values
    losses = fit_path_losses(data.transmitter_position[rows], receiver, rssi[rows], crossed=crossed[rows])
    measured = data.detected.sum(dim=0).double()
    db = float(losses.floor_db @ measured / measured.sum())
    return FloorAttenuation(data.floors, tuple(receiver_floor.tolist()), db)


@single_thread()
def estimate_offsets(
    train: Rssi,
    reference: str | None = None,
    *,
    relative_length: float = 0.25,
    prior_precision: float = 0.05,
) -> Offsets:
    """Estimate the offset of each group of measured rows by generalised least squares.

    RSSI at a receiver is its path-loss model, plus a Gaussian process of the position, plus the offset of the row's group,
    plus noise. An offset is the same at all receivers.

    Args:
        train: Training rows with groups.
        reference: Group with offset 0. Defaults to the most frequent one.
        relative_length: Correlation length of the process relative to the extent of the positions. Not studied.
        prior_precision: Prior precision of an offset relative to the variance of the field: a standard deviation of 10 dB
            for a usual field. Not studied.

    Raises:
        InputError: Rows without a group, one group only, or an unknown reference.

    Example:
        >>> import swiftwrf
        >>> room = swiftwrf.rssi_room(n=100)
        >>> table = room.to_frame().rename(columns={"x_m": "x", "y_m": "y", "z_m": "z"}).reset_index(drop=True)
        >>> table.iloc[::2, 3:] -= 8.0
        >>> table["phone"] = ["old", "new"] * 50
        >>> offsets = estimate_offsets(swiftwrf.Rssi.from_frame(table, offset_by="phone"), "new")
        >>> -9 < offsets.offset_db["old"] < -7
        True
    """
    groups = train.groups
    if groups is None:
        raise InputError(f"{train.name} has no groups; read it with offset_by")
    if groups.isna().any():
        row = int(groups.isna().to_numpy().argmax())
        raise InputError(f"{train.name} has no {groups.name} in row {row}; name the group of each row, or leave it out")
    names, code = groups.cat.categories.tolist(), torch.tensor(groups.cat.codes.to_numpy()).long()
    frequency = code.bincount(minlength=len(names))
    if int((frequency > 0).sum()) < 2:
        raise InputError(
            f"column {groups.name} has one value in the training rows, so there are no offsets to estimate"
        )
    chosen = names[int(frequency.argmax())] if reference is None else reference
    if chosen not in names:
        raise InputError(f"column {groups.name} has no value {chosen!r}; there are {listed(names)}")
    position = train.transmitter_position
    extent = float((position.amax(dim=0) - position.amin(dim=0)).max()) or 1.0
    kernel = Kernel(relative_length * extent, matern12_weight=1.0, noise=1.0)  # fading is as large as shadowing
    distance = log_distance(position, train.receiver_position)
    member = torch.nn.functional.one_hot(code, len(names)).double()
    gram = torch.zeros(len(names) + 1, len(names) + 1, dtype=torch.float64)  # of members and RSSI
    generator = torch.Generator().manual_seed(0)
    for r, rssi in enumerate(train.as_measured().rssi_dbm.T):
        rows = (~rssi.isnan()).nonzero()[:, 0]
        # the time grows with the cube of the number of rows, and evenly spaced ones may be of one group
        rows = rows[torch.randperm(len(rows), generator=generator)[:300]]
        if not len(rows):
            continue
        free = torch.stack([torch.ones_like(distance[rows, r]), distance[rows, r]], dim=1)
        # level and slope over log10 distance are fitted with the offsets, by a linear kernel
        weight = torch.linalg.inv(kernel.covariance(position[rows]) + 1e6 * free @ free.T)
        values = torch.cat([member[rows], rssi[rows, None]], dim=1)
        gram += values.T @ weight @ values
    normal, right, total = gram[:-1, :-1], gram[:-1, -1], float(gram[-1, -1])
    others = torch.tensor([name != chosen for name in names])
    prior = prior_precision * torch.eye(int(others.sum()), dtype=torch.float64)
    precision = normal[others][:, others] + prior
    offset = torch.zeros(len(names), dtype=torch.float64)
    offset[others] = torch.linalg.solve(precision, right[others])
    explained = float(right @ offset) / total if total > 0 else 0.0
    estimates = zip(names, offset.tolist(), frequency.tolist(), strict=True)
    known = {name: db for name, db, count in estimates if count or name == chosen}
    return Offsets(str(groups.name), chosen, known, explained)
