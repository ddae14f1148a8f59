"""Which measurements train a model and which test it: named splits from files, seeded random and blocked ones."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import torch
from torch import Tensor

from swiftwrf.data.files import read_text
from swiftwrf.errors import InputError

TEST_SHARE = 0.2
MIN_TRAINING = 10
MOST_DIGITS = 18  # of an index
FOLDS = 5  # parts of the training rows that are held out in turn to choose settings

Validation = Literal["random", "block"]


def split_names(folder: Path) -> list[str]:
    """Names of the splits that a folder offers: `train_index_NAME.txt` is NAME, `train_index.txt` is random."""
    files = [*folder.glob("train_index.txt"), *sorted(folder.glob("train_index_?*.txt"))]
    return [file.stem.removeprefix("train_index").removeprefix("_") or "random" for file in files]


def read_split(folder: Path, name: str, n: int, first: int) -> tuple[Tensor, Tensor]:
    """Rows of the training and of the test part, int64, in file order and counted from 0.

    Args:
        folder: where `train_index[_NAME].txt` and `test_index[_NAME].txt` lie.
        name: of the split; `random` also stands for files without a name.
        n: number of measurements.
        first: what the files call the first measurement (spectra count from 1, RSSI rows from 0).

    Raises:
        InputError: a file that is missing or holds something else than whole numbers; an index out of range, twice in a
            part or in both parts.
    """
    named = name != "random" or (folder / "train_index_random.txt").is_file()
    suffix = f"_{name}" if named else ""
    train, test = (_read_indices(folder / f"{part}_index{suffix}.txt", n, first) for part in ("train", "test"))
    both = sorted(set(train) & set(test))
    if both:
        raise InputError(
            f"split {name!r} in {folder} has index {both[0] + first} in both its training and its test part "
            f"({len(both)} such); take them out of one"
        )
    return torch.tensor(train, dtype=torch.int64), torch.tensor(test, dtype=torch.int64)


def _read_indices(file: Path, n: int, first: int) -> list[int]:
    if not file.is_file():
        raise InputError(f"split file {file} is missing; a split needs both its train_index and its test_index file")
    rows: list[int] = []
    seen: set[int] = set()
    for line, text in enumerate(read_text(file).split(), start=1):
        digits = text.lstrip("0") or "0"
        if not (text.isascii() and text.isdecimal() and len(digits) <= MOST_DIGITS):
            raise InputError(f"{file} entry {line} is {text!r}; expected a whole number, {first} to {n - 1 + first}")
        row = int(digits) - first
        if not 0 <= row < n:
            raise InputError(
                f"{file} entry {line} is {text}; expected {first} to {n - 1 + first}, the measurements there are"
            )
        if row in seen:
            raise InputError(f"{file} lists index {text} twice; each measurement belongs to a part once")
        seen.add(row)
        rows.append(row)
    if not rows:
        raise InputError(f"{file} is empty; expected one index a line")
    return rows


def random_split(n: int, seed: int) -> tuple[Tensor, Tensor]:
    """A random fifth for testing; both parts ascending. Honest only where positions are independent draws."""
    order = torch.randperm(n, generator=torch.Generator().manual_seed(seed))
    n_test = round(TEST_SHARE * n)
    return order[n_test:].sort().values, order[:n_test].sort().values


def slabs(position: Tensor, n_slabs: int) -> Tensor:
    """Number of the slab, 0 to n_slabs - 1, of each position (n, 3): equally many positions in each, cut across the
    direction in which the positions extend most. Neighbours share a slab, and repeats at one place do, so a slab held out
    is a place held out."""
    centred = position.double() - position.double().mean(dim=0)
    direction = torch.linalg.svd(centred, full_matrices=False).Vh[0]
    rank = (centred @ direction).argsort(stable=True).argsort()
    _, spot, times = position.unique(dim=0, return_inverse=True, return_counts=True)
    middle = torch.zeros_like(times).index_add_(0, spot, rank) // times
    slab: Tensor = middle[spot] * n_slabs // len(position)
    if len(slab.unique()) < n_slabs:  # few places cannot be held out whole
        slab = rank * n_slabs // len(position)
    return slab


def block_split(position: Tensor, seed: int) -> tuple[Tensor, Tensor]:
    """One slab out of five for testing, chosen by the seed; both parts ascending."""
    n_slabs = round(1 / TEST_SHARE)
    held_out = slabs(position, n_slabs) == seed % n_slabs
    return (~held_out).nonzero()[:, 0], held_out.nonzero()[:, 0]


def folds(position: Tensor, validation: Validation, seed: int, number: int = FOLDS) -> Tensor:
    """Return the fold of each training position (n, 3), counted from 0: drawn at random, or slabs."""
    if validation == "block":
        return slabs(position, number)
    order = torch.randperm(len(position), generator=torch.Generator().manual_seed(seed))
    return order % number


def validation_for(split: str) -> Validation:
    """How training rows are held out so that it is like the split: single rows where test rows lie among training rows,
    whole regions where the test part is a place of its own or its making is unknown."""
    return "random" if split == "random" else "block"


def choose_split(
    name: str, seed: int, position: Tensor, named: dict[str, tuple[Tensor, Tensor]], data: str
) -> tuple[Tensor, Tensor]:
    """Training and test rows of the split `name`: one that came with the data, or else a seeded `random` or `block`.

    Raises:
        InputError: a name that the data does not have; fewer than 10 training measurements.
    """
    if name in named:
        train, test = named[name]
    elif name == "random":
        train, test = random_split(len(position), seed)
    elif name == "block":
        train, test = block_split(position, seed)
    else:
        raise InputError(
            f"{data} has no split {name!r}; choose one of {', '.join(sorted({*named, 'random', 'block'}))}"
        )
    if len(train) < MIN_TRAINING:
        raise InputError(
            f"split {name!r} of {data} has {len(train)} training measurements, too few to fit anything; "
            f"at least {MIN_TRAINING} are needed"
        )
    return train, test
