"""Placement of a next array: the pose that lowers the expected position error most, by the rooms that were found."""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from augment.choices import MAX_STATIONS
from swiftwrf import ArrayPose, InputError, MatchedField
from swiftwrf.locate.matched_field import MatchedFieldConfig
from swiftwrf.models.geometry import GeometryModel, Plane
from swiftwrf.runtime.validation import PositiveInt, checked

N_BOOTSTRAP = 500  # samples of positions that determine standard errors
FEW_CELLS = MatchedFieldConfig(spacing=0.25, max_cells=20_000, n_best=100, n_background=30)


@dataclass(frozen=True, eq=False)
class StationSuggestion:
    """Poses of a next array, the best first.

    Args:
        pose: Poses of an array.
        error_m: Expected median position error with an array in each pose, (n,) [m].
        gain_m: Difference of the expected error of the existing arrays alone and of `error_m`, (n,) [m].
        gain_std_m: Standard error of the gain, by a bootstrap of positions, (n,) [m].
        position: Positions of the arrays there are, (A, 3) [m].
    """

    pose: tuple[ArrayPose, ...]
    error_m: Tensor
    gain_m: Tensor
    gain_std_m: Tensor
    position: Tensor

    @property
    def normal(self) -> Tensor:
        """Unit vectors that the arrays face, (n, 3)."""
        return torch.stack([pose.rotation[:, 2] for pose in self.pose])

    @property
    def before_m(self) -> float:
        """Expected median position error of the existing arrays alone [m]."""
        return float(self.error_m[0] + self.gain_m[0])


@checked
def suggest_station(
    locator: MatchedField,
    count: PositiveInt = 1,
    candidates: Sequence[ArrayPose] | None = None,
    *,
    n_positions: PositiveInt = 80,
    config: MatchedFieldConfig = FEW_CELLS,
    seed: int = 0,
) -> StationSuggestion:
    """Return the poses in which a further array lowers the median position error most, by the rooms that were found.

    Spectra of all arrays are simulated at random positions of the region, by the room of each array and path gains that
    vary as at held-out positions, and located by all arrays. An array in a candidate pose has the room and the errors of the
    existing array with the largest weights. A new array has not measured anything, so what the others measured at positions
    is left out. Expected errors are therefore larger than those of the locator; compare them with one another.

    Args:
        locator: Locator of one array or several.
        count: Number of poses, 1 to 24.
        candidates: Poses to compare. Defaults to `wall_poses`.
        n_positions: Number of positions of the transmitter.
        config: Options of the search for these positions. Defaults to a coarse search.
        seed: Seed of positions and path gains.

    Raises:
        InputError: A number outside its range, fewer candidates, or no candidates and a room without walls.

    Example:
        >>> import swiftwrf
        >>> spectra = swiftwrf.simulated_room(n=30, grid=swiftwrf.AngularGrid.hemisphere(8, 32))
        >>> wall = Plane((0.0, -1.0, 0.0), offset_m=0.0, gain=-0.6)
        >>> room = GeometryModel.of_planes(spectra, [wall])
        >>> locator = MatchedField(spacing=0.5, max_cells=1000).fit(spectra, room=room)
        >>> found = suggest_station(locator, n_positions=5, config=MatchedFieldConfig(max_cells=500, n_best=20))
        >>> round(found.pose[0].position[1], 1), found.gain_std_m.shape
        (0.1, torch.Size([1]))
    """
    like = _most_weighted(locator)
    own = {name: (name, room) for name, room in locator.rooms.items()}
    room = locator.rooms[like]
    if count > MAX_STATIONS:
        raise InputError(f"at most {MAX_STATIONS} poses of an array can be suggested, not {count}")
    poses = wall_poses(locator, count) if candidates is None else list(candidates)
    if len(poses) < count:
        raise InputError(f"{count} poses cannot be chosen among {len(poses)} candidates; give more")
    position = _positions(locator, n_positions, seed)

    def errors(pose: ArrayPose | None) -> Tensor:
        added = {} if pose is None else {"": (like, _placed(room, pose))}
        posterior = locator.elsewhere(own | added, config).located_samples(position, seed)
        error: Tensor = (posterior.median - position).norm(dim=1)
        return error

    before, after = errors(None), torch.stack([errors(pose) for pose in poses])
    drawn = torch.randint(n_positions, (N_BOOTSTRAP, n_positions), generator=torch.Generator().manual_seed(seed))
    spread = (before[drawn].median(dim=1).values - after[:, drawn].median(dim=2).values).std(dim=1)
    error = after.median(dim=1).values
    best = error.argsort(stable=True)[:count]
    fixed = torch.stack([each.fixed_position for _, each in own.values()])
    gain = before.median() - error[best]
    return StationSuggestion(tuple(poses[i] for i in best.tolist()), error[best], gain, spread[best], fixed)


def wall_poses(locator: MatchedField, count: int = 1, distance_m: float = 0.1) -> list[ArrayPose]:
    """Return poses on the walls of the rooms that were found, facing inwards, at the mean height of the arrays.

    Args:
        locator: Locator of one array or several.
        count: Number of poses at least. There are two or more on each wall.
        distance_m: Distance of the arrays from the wall [m].

    Raises:
        InputError: A room without walls.
    """
    room = locator.rooms[_most_weighted(locator)]
    walls = [plane for plane in room.planes if abs(plane.normal[2]) < 0.5]
    if not walls:
        raise InputError("the room that was found has no walls; give candidate poses of the next array")
    height = float(torch.stack([each.fixed_position for each in locator.rooms.values()])[:, 2].mean())
    parts = max(2, math.ceil(count / len(walls)))
    return [_on_wall(room, wall, (i + 1) / (parts + 1), height, distance_m) for wall in walls for i in range(parts)]


def _on_wall(room: GeometryModel, wall: Plane, fraction: float, height: float, distance_m: float) -> ArrayPose:
    """Return the pose on a wall at a fraction of its length in the room."""
    normal = torch.tensor(wall.normal, dtype=torch.float64)
    _, low, high = room.region()
    along = torch.linalg.cross(torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64), normal)
    x, y, _ = (low + (high - low) * (fraction if float(along.sum()) > 0 else 1 - fraction)).tolist()
    at = torch.tensor([x, y, height], dtype=torch.float64)
    at = at + (wall.offset_m - distance_m - at @ normal) * normal
    inwards = (-normal).tolist()
    return ArrayPose.facing(tuple(at.tolist()), tuple(inwards))


def _most_weighted(locator: MatchedField) -> str:
    """Return the name of the station whose likelihoods have the largest sum of weights."""
    weights = locator.weight.split([len(each.start) for each in locator.likelihoods])
    return max(zip(locator.stations, weights, strict=True), key=lambda pair: float(pair[1].sum()))[0]


def _placed(room: GeometryModel, pose: ArrayPose) -> GeometryModel:
    """Return the room of an array in another pose. A moving array keeps its orientation."""
    found = copy(room)
    fixed = torch.tensor(pose.position, dtype=torch.float64)
    rotation = pose.rotation if room.moving == "transmitter" else room.rotation
    found.link = replace(room.link, fixed_position=fixed, rotation=rotation)
    return found


def _positions(locator: MatchedField, n: int, seed: int) -> Tensor:
    """Return random positions (n, 3) of the region near the training positions."""
    cells = locator.cells.position
    cells = cells[locator.region.is_near(cells)]
    generator = torch.Generator().manual_seed(seed)
    chosen = cells[torch.randint(len(cells), (n,), generator=generator)]
    edge = locator.cells.edge
    return chosen + (torch.rand(n, len(edge), dtype=torch.float64, generator=generator) - 0.5) @ edge
