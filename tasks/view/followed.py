"""A followed run as it grows: the computations behind its page."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from threading import Lock

from swiftwrf import InputError
from tasks.page.figures import as_svg, for_page
from tasks.records import Row
from tasks.update.page import error_plot, map_plot
from tasks.update.record import SUMMARY, TABLE, Record

LAST_ROWS = 20
Version = tuple[tuple[int, int], ...]  # time of change [ns] and size of each file


@dataclass(frozen=True, eq=False)
class Snapshot:
    """A record at one moment.

    Args:
        version: Version of the files.
        sentences: Results.
        rows: The last rows, newest first.
        figures: Running error and map of changes as SVG, by their names; none without measurements.
    """

    version: Version
    sentences: list[str]
    rows: list[Row]
    figures: dict[str, str]


class FollowedView:
    """Directory of an update, which may still grow.

    Args:
        folder: The directory.

    Raises:
        InputError: It holds no record.
    """

    def __init__(self, folder: Path) -> None:
        if not (folder / SUMMARY).exists():
            raise InputError(f"{folder} holds no record of an update: it has no {SUMMARY}")
        self.title, self.folder = folder.name, folder
        self._last: Snapshot | None = None
        self._lock = Lock()

    @property
    def version(self) -> Version:
        """Version of the files, which changes when a measurement is learnt."""
        found = [file.stat() for name in (TABLE, SUMMARY) if (file := self.folder / name).exists()]
        return tuple((stat.st_mtime_ns, stat.st_size) for stat in found)

    def snapshot(self) -> Snapshot:
        """Return the record as it is now; several visitors share it.

        Raises:
            InputError: The record is damaged.
        """
        with self._lock:
            version = self.version
            if self._last is None or self._last.version != version:
                self._last = _read(self.folder, version)
            return self._last


def _read(folder: Path, version: Version) -> Snapshot:
    record = Record.read(folder)
    if not record.rows:
        return Snapshot(version, ["no measurement yet"], [], {})
    plots = {"error": error_plot(record), "changes": map_plot(record)}
    svg = {name: for_page(as_svg(plot.panels[0], plot.caption), name) for name, plot in plots.items()}
    return Snapshot(version, record.sentences(), record.rows[: -LAST_ROWS - 1 : -1], svg)
