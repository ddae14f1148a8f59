"""Training and test rows of measurements: named splits from files, seeded random and block splits, and folds."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from swiftwrf.data.files import read_text
from swiftwrf.errors import InputError
from swiftwrf.positions import nearest
from swiftwrf.runtime.validation import PositiveInt, checked

MIN_TRAINING = 10  # measurements
MIN_SPLIT_ROWS = 13  # of RSSI, below which places are held out one at a time
MIN_PLACES = 5  # different positions that are held out one at a time
MAX_REPEATED = 0.1  # fraction of test rows at training positions, beyond which a split tests look-up
FOLDS = 5

Validation = Literal["random", "block", "session"]


def split_names(folder: Path) -> list[str]:
    """Return the names of the splits in a folder: `train_index_NAME.txt` is NAME, `train_index.txt` is random."""
    files = [*folder.glob("train_index.txt"), *sorted(folder.glob("train_index_?*.txt"))]
    return [file.stem.removeprefix("train_index").removeprefix("_") or "random" for file in files]


def read_splits(folder: Path, n: int, first: int) -> dict[str, tuple[Tensor, Tensor]]:
    """Return training and test rows of all splits in a folder, int64, in file order and counted from 0.

    Files are `train_index[_NAME].txt` and `test_index[_NAME].txt`. The first of n measurements has the number `first`:
    1 for spectra, 0 for RSSI.

    Raises:
        InputError: A missing file, a value that is no whole number, an index out of range, twice in a part or in both parts.
    """
    splits = {}
    for name in split_names(folder):
        named = name != "random" or (folder / "train_index_random.txt").is_file()
        suffix = f"_{name}" if named else ""
        train, test = (_read_indices(folder / f"{part}_index{suffix}.txt", n, first) for part in ("train", "test"))
        if both := sorted(set(train) & set(test)):
            raise InputError(
                f"split {name!r} in {folder} has index {both[0] + first} in both its training and its test part "
                f"({len(both)} such); take them out of one"
            )
        splits[name] = torch.tensor(train, dtype=torch.int64), torch.tensor(test, dtype=torch.int64)
    return splits


def _read_indices(file: Path, n: int, first: int) -> list[int]:
    if not file.is_file():
        raise InputError(f"split file {file} is missing; a split needs both its train_index and its test_index file")
    rows: dict[int, None] = {}
    for line, text in enumerate(read_text(file).split(), start=1):
        digits = text.lstrip("0") or "0"
        if not (text.isascii() and text.isdecimal() and len(digits) <= 18):
            raise InputError(f"{file} entry {line} is {text!r}; expected a whole number, {first} to {n - 1 + first}")
        row = int(digits) - first
        if not 0 <= row < n:
            raise InputError(
                f"{file} entry {line} is {text}; expected {first} to {n - 1 + first}, the measurements there are"
            )
        if row in rows:
            raise InputError(f"{file} lists index {text} twice; each measurement belongs to a part once")
        rows[row] = None
    if not rows:
        raise InputError(f"{file} is empty; expected one index a line")
    return list(rows)


def kept_splits(splits: dict[str, tuple[Tensor, Tensor]], kept: Tensor, n: int) -> dict[str, tuple[Tensor, Tensor]]:
    """Return splits of n rows as splits of those that are kept, given by their numbers.

    Example:
        >>> kept_splits({"days": (torch.tensor([0, 1]), torch.tensor([2]))}, torch.tensor([1, 2]), 3)
        {'days': (tensor([0]), tensor([1]))}
    """
    number = torch.full((n,), -1).scatter(0, kept, torch.arange(len(kept)))
    parts = {name: (number[train], number[test]) for name, (train, test) in splits.items()}
    return {name: (train[train >= 0], test[test >= 0]) for name, (train, test) in parts.items()}


def places(position: Tensor, n_parts: int = 1, radius: float = 0.05) -> Tensor:
    """Return the number of the place of each row (n, 3), int64 (n,).

    Robots, motion capture and satellite receivers report other coordinates each time they return to a place. So a place is
    a ball, whose centre is the position with most others within the radius, outside all balls before. The order of the rows
    has no effect. Each row is a place of its own if there are fewer places than parts.

    Args:
        position: Positions, (n, 3) [m].
        n_parts: Number of parts that places are divided into.
        radius: Radius of the balls in mean spacings of places: sqrt(area / places), or length / places along a line. Repeats
            by motion capture lie within 0.03.

    Example:
        >>> places(torch.tensor([[5.0, 0, 0], [0.0, 0, 0], [5.001, 0, 0]]))
        tensor([0, 1, 0])
    """
    spots, spot = position.double().unique(dim=0, return_inverse=True)
    length, width, _ = (spots.amax(dim=0) - spots.amin(dim=0)).sort(descending=True).values.tolist()
    tree, number, last = cKDTree(spots.numpy()), torch.arange(len(spots)), len(spots) + 1
    while (count := int(number.max()) + 1) < last:  # fewer places are farther apart
        number, last = _balls(tree, radius * max((length * width / count) ** 0.5, length / count)), count
    return number[spot] if count >= n_parts else torch.arange(len(position))


def _balls(tree: cKDTree, radius: float) -> Tensor:
    """Return the number of the ball that contains each point of a tree: around the points with most others nearby first."""
    number, count, size = np.full(tree.n, -1), 0, tree.query_ball_point(tree.data, radius, return_length=True)
    for row in np.argsort(-size, kind="stable"):
        if number[row] < 0:
            inside = np.array([row] if size[row] == 1 else tree.query_ball_point(tree.data[row], radius))
            number[inside[number[inside] < 0]] = count
            count += 1
    return torch.from_numpy(number)


def centres(position: Tensor, place: Tensor) -> Tensor:
    """Return the mean position of each place, float64 (P, 3), given the place of each position (n, 3)."""
    total = torch.zeros(int(place.max()) + 1, 3, dtype=torch.float64).index_add(0, place, position.double())
    return total / place.bincount()[:, None]


def random_rows(position: Tensor, n: int, seed: int) -> Tensor:
    """Return at most n random rows, ascending, that share no place with the others. Exactly n if no place repeats.

    If every place has more than n rows, those of one with the fewest are returned.
    """
    place = places(position, 2)
    size, rank = place.bincount(), torch.randperm(len(place), generator=torch.Generator().manual_seed(seed)).argsort()
    order = rank[np.unique(place.numpy(), return_index=True)[1]].argsort()  # of places, by the rank of their first row
    chosen = torch.zeros(len(size), dtype=torch.bool)
    left = n
    for number, rows in zip(order.tolist(), size[order].tolist(), strict=True):
        if rows <= left:
            chosen[number], left = True, left - rows
    if n and left == n:
        chosen[size.argmin()] = True
    return chosen[place].nonzero()[:, 0]


def some_rows(n: int, most: int) -> Tensor:
    """Return the numbers of at most `most` of n rows, equally spaced."""
    return torch.linspace(0, n - 1, min(most, n)).round().long()


def random_split(position: Tensor, seed: int, fraction: float = 0.2) -> tuple[Tensor, Tensor]:
    """Return training rows and a random fraction as test rows, both ascending. Rows at one place are in one part.

    Suits positions drawn independently.
    """
    test = random_rows(position, round(fraction * len(position)), seed)
    is_test = torch.zeros(len(position), dtype=torch.bool).index_fill(0, test, value=True)
    return (~is_test).nonzero()[:, 0], test


def repeated_fraction(train: Tensor, test: Tensor) -> float:
    """Return the fraction of test positions (n, 3) at a place of the training positions (m, 3).

    Example:
        >>> repeated_fraction(torch.zeros(1, 3), torch.tensor([[0.0, 0, 0], [1, 0, 0]]))
        0.5
    """
    if not len(test):
        return 0.0
    known, asked = places(torch.cat([train, test])).split([len(train), len(test)])
    return float(torch.isin(asked, known).double().mean())


def slabs(position: Tensor, n_slabs: int) -> Tensor:
    """Return the slab of each position (n, 3), 0 to n_slabs - 1, across the direction of the largest extent.

    Slabs hold equal numbers of positions. Neighbours and repeated measurements at one place share a slab, so holding out a
    slab holds out a region. The order of the rows has no effect.
    """
    place = places(position)
    at, size = centres(position, place), place.bincount()
    centred = at - (size[:, None] * at).sum(dim=0) / len(position)
    direction = torch.linalg.svd(size.sqrt()[:, None] * centred, full_matrices=False).Vh[0]
    order = (centred @ direction).argsort(stable=True)
    middle = size[order].cumsum(dim=0) - (size[order] + 1) // 2  # rank of the middle row of each place
    slab: Tensor = middle[order.argsort()][place] * n_slabs // len(position)
    if len(slab.unique()) < n_slabs:  # few places cannot be held out whole
        slab = order.argsort()[place].argsort(stable=True).argsort() * n_slabs // len(position)
    return slab


def block_split(position: Tensor, seed: int, n_slabs: int = 5) -> tuple[Tensor, Tensor]:
    """Return training rows and one slab of several as test rows, chosen by the seed, both ascending."""
    held_out = slabs(position, n_slabs) == seed % n_slabs
    return (~held_out).nonzero()[:, 0], held_out.nonzero()[:, 0]


@checked
def folds(
    position: Tensor, validation: Validation, seed: int, number: PositiveInt = FOLDS, session: Tensor | None = None
) -> Tensor:
    """Return the fold of each training position, counted from 0. Rows at one place, or of one session, share a fold.

    The order of the rows has no effect.

    Args:
        position: Training positions, (n, 3) [m].
        validation: "random" for random folds, "block" for slabs, "session" for whole sessions. A single session has random
            folds.
        seed: Seed of random folds.
        number: Number of folds.
        session: Session of each row, int64 (n,).

    Raises:
        InputError: Another `validation`, or "session" without sessions.

    Example:
        >>> folds(torch.rand(20, 3), "random", seed=0).bincount().tolist()
        [4, 4, 4, 4, 4]
    """
    if validation == "session":
        if session is None:
            raise InputError('validation="session" needs measurements with sessions, see docs/formats.md')
        _, number_of_session, size = session.unique(return_inverse=True, return_counts=True)
        if len(size) > 1:  # whole sessions in folds of nearly equal size
            fold, filled = torch.zeros_like(size), torch.zeros(min(number, len(size)), dtype=torch.int64)
            for which in size.argsort(descending=True, stable=True).tolist():
                fold[which] = filled.argmin()
                filled[fold[which]] += size[which]
            return fold[number_of_session]
    if validation == "block":
        return slabs(position, number)
    place = places(position, number)
    order = torch.randperm(len(place.unique()), generator=torch.Generator().manual_seed(seed))
    return (order % number)[place]


def matching_validation(train: Tensor, test: Tensor, n_quantiles: int = 200) -> Validation:
    """Return the kind of folds whose held-out distances resemble those of the test positions.

    A distance is that to the nearest training position (C. Mila et al., Methods in Ecology and Evolution 13, 2022). Two sets
    of distances are compared at their quantiles.

    Example:
        >>> line = torch.linspace(0, 99, 100)[:, None] * torch.tensor([1.0, 0.0, 0.0])
        >>> matching_validation(line, line + 0.5), matching_validation(line, line + 50)
        ('random', 'block')
    """
    level = (torch.arange(n_quantiles, dtype=torch.float64) + 0.5) / n_quantiles

    def quantiles(pairs: Iterable[tuple[Tensor, Tensor]]) -> Tensor:
        distance = torch.cat([nearest(other, known, 1)[0][:, 0] for known, other in pairs])
        return distance.double().quantile(level)

    def misfit(validation: Validation) -> float:
        held_out = quantiles((train[kept], train[out]) for out, kept in each_fold(folds(train, validation, 0)))
        return float((held_out - of_test).abs().mean())

    of_test = quantiles([(train, test)])
    kinds: tuple[Validation, Validation] = ("random", "block")
    return min(kinds, key=misfit)


def each_fold(fold: Tensor, rows: Tensor | None = None) -> Iterator[tuple[Tensor, Tensor]]:
    """Yield the numbers of the rows that are held out with each fold, and of all rows in other folds, int64.

    Args:
        fold: Fold of each row, (n,).
        rows: Numbers of the rows to hold out, in the order in which they are yielded. Defaults to all, ascending.

    Example:
        >>> [(out.tolist(), kept.tolist()) for out, kept in each_fold(torch.tensor([1, 0, 1]))]
        [([1], [0, 2]), ([0, 2], [1])]
    """
    rows = torch.arange(len(fold)) if rows is None else rows
    for number in fold[rows].unique():
        yield rows[fold[rows] == number], (fold != number).nonzero()[:, 0]
