"""Triangulation: the position whose lines of bearing from several stations are closest, by least squares."""

from __future__ import annotations

import torch
from torch import Tensor

from swiftwrf.array.angles import to_direction
from swiftwrf.data.spectra import Spectra
from swiftwrf.data.stations import Stations
from swiftwrf.errors import InputError


def triangulated(origin: Tensor, direction: Tensor, start: Tensor, start_weight: float = 1e-6) -> Tensor:
    """Return the positions of the smallest sum of squared distances to lines of bearing.

        x = argmin sum_a w_a |(I - d_a d_a^T) (x - o_a)|^2 + s |x - start|^2

    Args:
        origin: Points on the lines, (A, 3) [m].
        direction: Unit vectors along the lines of n transmissions, (n, A, 3), nan where a station has none.
        start: Position that decides where the lines do not, e.g. for a single line, (3,) [m].
        start_weight: Weight s of that position. Not studied: it only has to be small.

    Returns:
        Positions, float64 (n, 3) [m].

    Example:
        >>> origin = torch.tensor([[0.0, 0, 0], [4.0, 0, 0]])
        >>> direction = torch.nn.functional.normalize(torch.tensor([[[1.0, 1, 0], [-1.0, 1, 0]]]), dim=-1)
        >>> triangulated(origin, direction, torch.zeros(3)).round(decimals=3).tolist()
        [[2.0, 2.0, 0.0]]
    """
    origin, direction, start = origin.double(), direction.double(), start.double()
    has_line = direction.isfinite().all(dim=-1)
    unit = direction.nan_to_num(0.0)
    across = torch.eye(3, dtype=torch.float64) - unit[..., :, None] * unit[..., None, :]
    across = across * has_line[..., None, None]
    system = across.sum(dim=1) + start_weight * torch.eye(3, dtype=torch.float64)
    target = (across @ origin[:, :, None])[..., 0].sum(dim=1) + start_weight * start
    found: Tensor = torch.linalg.solve(system, target)
    return found


def bearings(data: Stations, direction: dict[str, Tensor], towards: Tensor) -> tuple[Tensor, Tensor]:
    """Return the lines of bearing of the moving end in world coordinates.

    A planar array does not distinguish directions that mirror in its plane, so known positions decide the side.

    Args:
        data: Transmissions, whose stations have a fixed end and an orientation.
        direction: Azimuth and elevation [rad] of the transmitter in the coordinates of each station's array, (m, 2) for the
            m transmissions that it received.
        towards: Mean of known positions of the moving end, (3,) [m].

    Returns:
        Positions of the stations, (A, 3) [m], and unit vectors along the lines, (n, A, 3), nan where nothing was received.

    Raises:
        InputError: A station without position or orientation.
    """
    origin, line = station_positions(data), torch.full((len(data), len(data.names), 3), torch.nan, dtype=torch.float64)
    for number, ((name, spectra), fixed) in enumerate(zip(data.spectra.items(), origin, strict=True)):
        if spectra.rotation is None:
            raise InputError(f"station {name} of {data.name} has no orientation, which bearings need")
        sign = 1.0 if data.moving == "transmitter" else -1.0  # from the fixed end to the moving one
        unit = to_direction(*direction[name].double().unbind(-1)) * sign
        side = (towards.double() - fixed) @ spectra.rotation[:, 2]
        unit[:, 2] = torch.where(side < 0, -1.0, 1.0) * unit[:, 2].abs()
        line[data.received[:, number], number] = unit @ spectra.rotation.T
    return origin, line


def station_positions(data: Stations) -> Tensor:
    """Return the positions of the fixed ends of all stations, (A, 3) [m].

    Raises:
        InputError: A station whose position is unknown.
    """
    fixed = {name: spectra.fixed_position for name, spectra in data.spectra.items()}
    if unknown := [name for name, position in fixed.items() if position is None]:
        raise InputError(f"the position of station {unknown[0]} of {data.name} is unknown")
    return torch.stack([position for position in fixed.values() if position is not None])


def peak_directions(data: Stations) -> dict[str, Tensor]:
    """Return azimuth and elevation (m, 2) [rad] of the strongest direction of each station's m spectra."""

    def peaks(spectra: Spectra) -> Tensor:
        return spectra.peak_direction(torch.arange(len(spectra)))

    return {name: peaks(data.of(name)[1]) for name in data.names}
