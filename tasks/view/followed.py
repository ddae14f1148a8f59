"""A followed run as it grows: the computations behind its page."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

from swiftwrf import InputError
from tasks.page.figures import as_svg, for_page
from tasks.records import Row
from tasks.update.record import SUMMARY, TABLE, Record, error_plot, map_plot

LAST_ROWS = 20
Version = tuple[tuple[int, int], ...]  # time of change [ns] and size of each file


class Snapshot(NamedTuple):
    """Results in sentences, the last rows, newest first, and figures as SVG by name; no figures without measurements."""

    sentences: list[str]
    rows: list[Row]
    figures: dict[str, str]


@dataclass(frozen=True)
class FollowedView:
    """Directory of an update, which may still grow.

    Raises:
        InputError: It holds no record.
    """

    folder: Path

    def __post_init__(self) -> None:
        if not (self.folder / SUMMARY).exists():
            raise InputError(f"{self.folder} holds no record of an update: it has no {SUMMARY}")

    @property
    def title(self) -> str:
        """Title of the page."""
        return self.folder.name

    @property
    def version(self) -> Version:
        """Version of the files, which changes when a measurement is learnt."""
        found = [file.stat() for name in (TABLE, SUMMARY) if (file := self.folder / name).exists()]
        return tuple((stat.st_mtime_ns, stat.st_size) for stat in found)


@lru_cache(maxsize=1)
def snapshot(view: FollowedView, version: Version) -> Snapshot:
    """Return the record at a version of its files; several visitors share it.

    Raises:
        InputError: The record is damaged.
    """
    record = Record.read(view.folder)
    if not record.rows:
        return Snapshot(["no measurement yet"], [], {})
    plots = {"error": error_plot(record), "changes": map_plot(record)}
    svg = {name: for_page(as_svg(plot.panels[0], plot.caption), name) for name, plot in plots.items()}
    return Snapshot(record.sentences(), record.rows[: -LAST_ROWS - 1 : -1], svg)
