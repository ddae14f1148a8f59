"""Constant offsets of RSSI between devices, channels or other groups of rows, estimated jointly with the field."""

from __future__ import annotations

import torch
from torch import Tensor

from swiftwrf.data.groups import Offsets
from swiftwrf.data.rssi import Rssi
from swiftwrf.errors import InputError, listed
from swiftwrf.gp import Kernel
from swiftwrf.rssi.path_loss import log_distance
from swiftwrf.runtime.threads import single_thread

MAX_ROWS = 300  # of a receiver; the cost grows with their cube
PRIOR_PRECISION = 0.05  # of an offset relative to the field: a standard deviation of about 10 dB
LENGTH_SHARE = 0.25  # correlation length of the field relative to the extent
RELATIVE_NOISE = 1.0  # variance of a packet relative to that of the field


@single_thread()
def estimate_offsets(train: Rssi, reference: str | None = None) -> Offsets:
    """Estimate the offset of each group of rows by generalised least squares.

    RSSI at a receiver is its path-loss model, plus a Gaussian process of the position, plus the offset of the row's group,
    plus noise. An offset is the same at all receivers.

    Args:
        train: Training rows with groups.
        reference: Group with offset 0. Defaults to the most frequent one.

    Raises:
        InputError: Rows without groups, one group only, or an unknown reference.

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
    frequency = groups.code.bincount(minlength=len(groups.names))
    if int((frequency > 0).sum()) < 2:
        raise InputError(
            f"column {groups.column} has one value in the training rows, so there are no offsets to estimate"
        )
    chosen = groups.names[int(frequency.argmax())] if reference is None else reference
    if chosen not in groups.names:
        raise InputError(f"column {groups.column} has no value {chosen!r}; there are {listed(groups.names)}")
    position = train.transmitter_position
    extent = float((position.amax(dim=0) - position.amin(dim=0)).max()) or 1.0
    kernel = Kernel(LENGTH_SHARE * extent, matern12_weight=1.0, noise=RELATIVE_NOISE)
    distance = log_distance(position, train.receiver_position)
    member = torch.nn.functional.one_hot(groups.code, len(groups.names)).double()
    normal = torch.zeros(len(groups.names), len(groups.names), dtype=torch.float64)
    right, total = torch.zeros(len(groups.names), dtype=torch.float64), 0.0
    generator = torch.Generator().manual_seed(0)
    for r, rssi in enumerate(train.rssi_dbm.T):
        rows = (~rssi.isnan()).nonzero()[:, 0]
        rows = rows[torch.randperm(len(rows), generator=generator)[:MAX_ROWS]]  # evenly spaced rows may be of one group
        if not len(rows):
            continue
        weight = _residual_precision(kernel.covariance(position[rows]), distance[rows, r])
        normal += member[rows].T @ weight @ member[rows]
        right += member[rows].T @ weight @ rssi[rows]
        total += float(rssi[rows] @ weight @ rssi[rows])
    free = torch.tensor([name != chosen for name in groups.names])
    precision = normal[free][:, free] + PRIOR_PRECISION * torch.eye(int(free.sum())).double()
    offset = torch.zeros(len(groups.names), dtype=torch.float64)
    offset[free] = torch.linalg.solve(precision, right[free])
    explained = float(right @ offset) / total if total > 0 else 0.0
    estimates = dict(zip(groups.names, offset.tolist(), strict=True))
    known = {name: db for name, db in estimates.items() if frequency[groups.names.index(name)] > 0 or name == chosen}
    return Offsets(groups.column, chosen, known, explained)


def _residual_precision(covariance: Tensor, distance: Tensor) -> Tensor:
    """Return the precision of noisy values with covariance (m, m) after a fit of level and slope over log10 distance."""
    precision = torch.linalg.inv(covariance)
    free = torch.stack([torch.ones_like(distance), distance], dim=1)
    weighted = precision @ free
    projected: Tensor = precision - weighted @ torch.linalg.pinv(free.T @ weighted, hermitian=True) @ weighted.T
    return projected
