"""Spectra in the type of their source, and as float32 by the batch.

100,000 spectra of 90 x 360 pixels are 3 GB in the eight bits of images and 13 GB in float32, which no step of a fit needs at
once. They keep the type of their source, few in memory and many in a memory-mapped file of the cache, and are converted to
float32 in batches.
"""

from __future__ import annotations

import hashlib
import math
import os
import shutil
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.lib.format import dtype_to_descr, write_array_header_2_0
from torch import Tensor
from torch.nn import functional

from swiftwrf.errors import InputError
from swiftwrf.runtime.durable import cache_folder, refusing_unwritable, replacing
from swiftwrf.runtime.progress import progress_bar

MIN_FILE_SPECTRA = 20_000  # from which on spectra are stored in a file
MAX_MEMORY_PIXELS = 2**29  # 2 GiB of float32
MAX_FILE_PIXELS, MAX_FINE_PIXELS = 2**34, 2**20  # of all spectra, and of each where they exceed the memory
BATCH_PIXELS = 2**26  # converted to float32 at a time: 256 MiB
TYPES = {torch.uint8: np.uint8, torch.float16: np.float16, torch.float32: np.float32}


class Store:
    """n spectra (n, H, W). Indexing converts to float32 magnitudes in [0, 1]; nothing is converted or copied before.

    Args:
        values: Bytes, of which 255 stands for 1, or magnitudes in floating point, (m, H, W), in memory or memory-mapped.
        rows: Rows of the values that belong to the store, in order, int64 (n,). Defaults to all.
        factor: Spectra are averaged over squares of factor x factor pixels.

    Example:
        >>> Store(torch.full((3, 2, 4), 255, dtype=torch.uint8))[:].shape
        torch.Size([3, 2, 4])
    """

    def __init__(self, values: Tensor, rows: Tensor | None = None, factor: int = 1) -> None:
        self.values, self.rows, self.factor = values.cpu(), rows, factor

    def __len__(self) -> int:
        return len(self.values if self.rows is None else self.rows)

    @property
    def shape(self) -> tuple[int, int, int]:
        """Number of spectra, of rows and of columns (n, H, W)."""
        rows, columns = self.values.shape[1:]
        return len(self), rows // self.factor, columns // self.factor

    def __getitem__(self, rows: Tensor | slice) -> Tensor:
        """Return some of the spectra as float32, or as float64 if the values are float64."""
        measured = self.measured(rows)
        spectrum = measured if measured.dtype == torch.float64 else measured.float()
        if measured.dtype == torch.uint8:
            spectrum = spectrum / 255
        return spectrum if self.factor == 1 else functional.avg_pool2d(spectrum[:, None], self.factor)[:, 0]

    def measured(self, rows: Tensor | slice) -> Tensor:
        """Return some of the spectra in the type of the values, before averaging."""
        return self.values[rows if self.rows is None else self.rows[rows]]

    def exact(self) -> tuple[torch.dtype, Iterator[Tensor]]:
        """Return the smallest type that keeps all digits, and all spectra in order in that type, by the batch."""
        if self.factor == 1 and self.values.dtype in TYPES:
            return self.values.dtype, (self.measured(rows) for rows in self.parts())
        return torch.float32, (batch.float() for batch in self.batches())

    def subset(self, rows: Tensor) -> Store:
        """Return the given rows in the given order."""
        if rows.dtype == torch.bool:
            rows = rows.nonzero()[:, 0]
        return Store(self.values, rows if self.rows is None else self.rows[rows], self.factor)

    def joined(self, other: Store) -> Store:
        """Return the spectra of both stores in memory, in the type of this one if the other has it, too."""
        if self.factor == other.factor == 1 and self.values.dtype == other.values.dtype:
            return Store(torch.cat([self.measured(slice(None)), other.measured(slice(None))]))
        return Store(torch.cat([self[:], other[:]]))

    def coarsen(self, factor: int) -> Store:
        """Return the spectra averaged over squares of factor x factor pixels."""
        return Store(self.values, self.rows, self.factor * factor)

    def parts(self) -> Iterator[slice]:
        """Yield slices of rows that are converted at a time."""
        step = max(1, BATCH_PIXELS // math.prod(self.values.shape[1:]))
        return (slice(start, min(start + step, len(self))) for start in range(0, len(self), step))

    def batches(self) -> Iterator[Tensor]:
        """Yield all spectra in order as float32, in the slices of `parts`."""
        return (self[rows] for rows in self.parts())

    def mean(self) -> Tensor:
        """Return the mean of all spectra, (H, W)."""
        if len(parts := list(self.parts())) == 1:
            return self[:].mean(dim=0)
        total = sum(
            (self[rows].sum(dim=0, dtype=torch.float64) for rows in parts), torch.zeros((), dtype=torch.float64)
        )
        return (total / len(self)).float()

    def digest(self) -> str:
        """Return a digest of the values, wherever they are stored, of the rows and of the averaging."""
        digest = hashlib.sha256(repr((str(self.values.dtype), self.shape, self.factor)).encode())
        for rows in self.parts():
            digest.update(self.measured(rows).contiguous().numpy().data)
        return digest.hexdigest()


def stored(
    shape: tuple[int, int, int], dtype: torch.dtype, key: Callable[[], str], make: Callable[[], Iterable[Tensor]]
) -> Store:
    """Return a store of spectra that are made in batches: in memory, or in a file from 20,000 spectra on.

    The file lies in the cache directory, `$XDG_CACHE_HOME/swiftwrf` or `~/.cache/swiftwrf`. Its name is the digest of its
    content, so that the same data are read or computed once. It is deleted after a month without use.

    Args:
        shape: Shape of all spectra, (n, H, W).
        dtype: Type of the batches: uint8, float16 or float32.
        key: Returns a digest of the source of the spectra; called if they are stored in a file.
        make: Returns the batches in order; called if the file does not exist.

    Raises:
        InputError: The cache directory cannot be written or has too little room.
    """
    if shape[0] < MIN_FILE_SPECTRA and math.prod(shape) <= MAX_MEMORY_PIXELS:
        values, start = torch.empty(shape, dtype=dtype), 0
        for batch in make():
            values[start : start + len(batch)] = batch
            start += len(batch)
        return Store(values)
    owner = hashlib.sha256(f"{key()} {shape} {dtype}".encode()).hexdigest()
    file = cache_folder() / f"spectra-{owner}.npy"
    if (mapped := _mapped(file, shape, dtype)) is None:
        with refusing_unwritable(file.parent):
            file.parent.mkdir(parents=True, exist_ok=True)
            for other in file.parent.glob("*spectra-*"):  # without use for a month, or unfinished by killed processes
                with suppress(OSError):  # another process may be faster
                    if time.time() - other.stat().st_mtime > 30 * 86_400:
                        other.unlink()
            size, free = math.prod(shape) * dtype.itemsize, shutil.disk_usage(file.parent).free
            if size > free:
                raise InputError(
                    f"{shape[0]} spectra take {size / 1e9:.1f} GB in {file.parent}, where {free / 1e9:.1f} GB are free; set "
                    "XDG_CACHE_HOME to a directory with room"
                )
            # written without a map, because a full disk under a map ends the process by a signal
            with replacing(file) as temporary, temporary.open("wb") as stream, progress_bar() as bar:
                task = bar.add_task("storing spectra", total=shape[0])
                write_npy(stream, shape, dtype, make(), lambda count: bar.advance(task, count))
        mapped = _mapped(file, shape, dtype)
    assert mapped is not None
    return Store(mapped)


def _mapped(file: Path, shape: tuple[int, int, int], dtype: torch.dtype) -> Tensor | None:
    """Return the memory-mapped spectra of a file, None if it is missing or incomplete."""
    try:
        values = np.load(file, mmap_mode="c")  # copy on write, because torch has no read-only memory
        os.utime(file)
    except (OSError, ValueError, EOFError):
        return None
    return torch.from_numpy(values) if values.shape == shape and values.dtype == TYPES[dtype] else None


def write_npy(
    stream: Any,
    shape: tuple[int, int, int],
    dtype: torch.dtype,
    batches: Iterable[Tensor],
    advance: Callable[[int], None] = lambda count: None,
) -> None:
    """Write an npy file of spectra (n, H, W) in batches; call `advance` with the size of each."""
    header = {"shape": shape, "fortran_order": False, "descr": dtype_to_descr(np.dtype(TYPES[dtype]))}
    write_array_header_2_0(stream, header)
    for batch in batches:
        stream.write(batch.contiguous().numpy().data)
        advance(len(batch))
