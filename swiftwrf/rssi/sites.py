"""Many measurements as at most so many sites: an exact Gaussian process costs the cube of their number."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from swiftwrf.data.rssi import Rssi

MAX_SITES = 1500


@dataclass(frozen=True)
class Sites:
    """Measurements gathered by place.

    Args:
        position: mean of the positions at each site [m], float64 (n, 3).
        rssi: mean of what each receiver heard there, (n, R) [dBm], nan where nothing.
        count: measurements behind each mean, float64 (n, R).
        of_row: index of the site of each row, (rows,).
    """

    position: Tensor
    rssi: Tensor
    count: Tensor
    of_row: Tensor


def gather(rows: Rssi, limit: int = MAX_SITES) -> Sites:
    """Each row a site, or, where there are more than the limit, the cubes of a grid just coarse enough.

    Args:
        rows: measurements.
        limit: of the number of sites.
    """
    position = rows.transmitter_position
    cell = torch.arange(len(position))
    if len(position) > limit:
        local = position - position.min(dim=0).values
        fine, coarse = 0.0, float(local.max()) or 1.0
        for _ in range(20):  # halves the interval of the cubes' edge: to a millionth of the extent
            edge = (fine + coarse) / 2
            number = torch.unique((local / edge).floor().long(), dim=0, return_inverse=True)[1]
            if int(number.max()) < limit:
                coarse, cell = edge, number
            else:
                fine = edge
    n = int(cell.max()) + 1

    def mean(values: Tensor) -> tuple[Tensor, Tensor]:
        known = (~values.isnan()).double()
        total, count = (
            torch.zeros(n, values.shape[1], dtype=torch.float64).index_add(0, cell, x)
            for x in (values.nan_to_num(), known)
        )
        return total / count, count  # 0 / 0 is nan: not heard

    rssi, count = mean(rows.rssi_dbm.double())
    return Sites(mean(position.double())[0], rssi, count, cell)
