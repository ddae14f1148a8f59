"""Search for the posterior: all cells of a region, then ever smaller cells where the posterior is high."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable

import torch
from torch import Tensor

from swiftwrf.locate.region import Cells

Evaluate = Callable[[Tensor], Tensor]  # candidates (n, m, 3) to log-likelihoods (n, m)


def best_cells(cells: Cells, misfit: Tensor, most: int, others: int, generator: torch.Generator) -> Cells:
    """Return, for each observation, the cells of smallest misfit and a sample that represents all others.

    Args:
        cells: Cells (m,) of the region.
        misfit: Misfit (n, m), any decreasing function of the likelihood.
        most: Number of cells of smallest misfit.
        others: Number of cells drawn among the others, whose volume they share.
        generator: Source of randomness.
    """
    n, m = misfit.shape
    most = min(most, m)
    best = misfit.topk(most, dim=1, largest=False).indices
    position, volume, level = cells.position[best], cells.log_volume[best], cells.level[best]
    left = m - most
    if left <= 0 or others <= 0:
        return Cells(position, volume, cells.edge, level)
    drawn = torch.randint(m, (n, others), generator=generator)
    # a cell that is among the best already stands for nothing else
    is_best = torch.zeros(n, m, dtype=torch.bool).scatter_(1, best, True).gather(1, drawn)
    kept = (~is_best).sum(dim=1, keepdim=True).clamp_min(1)
    share = math.log(left) - kept.double().log()
    extra = (cells.log_volume[drawn] + share).masked_fill(is_best, -torch.inf)
    return Cells(
        torch.cat([position, cells.position[drawn]], dim=1),
        torch.cat([volume, extra], dim=1),
        cells.edge,
        torch.cat([level, cells.level[drawn]], dim=1),
    )


def refined(cells: Cells, log_mass: Tensor, values: Tensor, evaluate: Evaluate, split: int) -> tuple[Cells, Tensor]:
    """Split the cells of largest mass along every edge and evaluate their parts.

    Args:
        cells: Cells (n, m) of each observation, all of the size of `cells.edge` or smaller.
        log_mass: Logarithms of their masses under the present posterior, (n, m).
        values: Log-likelihoods (k, n, m) of k models.
        evaluate: Gives values (k, n, s) at positions (n, s, 3).
        split: Number of cells of each observation that are split.

    Returns:
        Cells (n, m) with the split ones replaced by their parts, the lightest left out, and their values.
    """
    n, m = log_mass.shape
    split = min(split, m)
    chosen = log_mass.topk(split, dim=1).indices
    d = len(cells.edge)
    signs = torch.tensor(list(itertools.product((-0.25, 0.25), repeat=d)), dtype=torch.float64).reshape(-1, d)
    parent = cells.position.gather(1, chosen[..., None].expand(-1, -1, 3))
    level = cells.level.gather(1, chosen)
    part = (parent[:, :, None] + 2.0 ** -level[..., None, None] * (signs @ cells.edge)).reshape(n, -1, 3)

    def repeated(value: Tensor) -> Tensor:
        return value[..., None].expand(-1, -1, len(signs)).reshape(n, -1)

    part_volume = repeated(cells.log_volume.gather(1, chosen) - math.log(len(signs)))
    part_values = evaluate(part)
    rest = log_mass.scatter(1, chosen, -torch.inf).argsort(dim=1, descending=True)[:, : m - split]
    position = torch.cat([part, cells.position.gather(1, rest[..., None].expand(-1, -1, 3))], dim=1)
    volume = torch.cat([part_volume, cells.log_volume.gather(1, rest)], dim=1)
    levels = torch.cat([repeated(level + 1), cells.level.gather(1, rest)], dim=1)
    kept = values.gather(2, rest.expand(len(values), -1, -1))
    return Cells(position, volume, cells.edge, levels), torch.cat([part_values, kept], dim=2)
