"""The page of a followed run, which shows each measurement as it is learnt."""

from __future__ import annotations

from nicegui import run, ui

from swiftwrf import InputError
from tasks.environment import command
from tasks.records import Row, rounded
from tasks.update.record import FollowedView, Version, snapshot
from tasks.view.page import NewestOnly, header

PERIOD_S = 1.0  # between two looks at the files
LAST_ROWS = 20
COLUMNS = {
    "index": "measurement",
    "x_m": "x [m]",
    "y_m": "y [m]",
    "z_m": "z [m]",
    "error": "error",
    "running_error": "running error",
    "innovation": "innovation",
    "alarm": "alarm",
}


class FollowedPage:
    """The page for one visitor."""

    def __init__(self, view: FollowedView) -> None:
        self._view, self._shown, self._requests = view, Version(), NewestOnly(self._show)
        header(view.title, [])
        self._sentences = ui.label().classes("numbers").props('id="sentence"').style("white-space: pre-line")
        self._figures = {}
        with ui.row().classes("w-full items-start gap-8"):
            for name in ("error", "changes"):
                box = ui.html("", sanitize=False).classes("figure").props(f'id="{name}"')
                self._figures[name] = box.style("width: 620px; max-width: 100%")
        columns = [{"name": key, "label": label, "field": key, "align": "left"} for key, label in COLUMNS.items()]
        self._table = ui.table(rows=[], columns=columns, row_key="index", title="Last measurements")
        self._table.props('dense flat id="rows"').classes("w-full")
        ui.label(
            f"Maps and spectra of the newest model: {command('view', str(view.folder / 'model.safetensors'))}"
        ).classes("quiet")
        ui.timer(PERIOD_S, self._look)

    def _look(self) -> None:
        if self._view.version != self._shown:
            self._requests.submit()

    async def _show(self) -> None:
        version = self._view.version
        try:
            found = await run.io_bound(snapshot, self._view, version)
        except InputError as error:
            self._sentences.set_text(str(error))
            return
        if found is None:  # the server is being ended
            return
        (record, svg), self._shown = found, version
        self._sentences.set_text("\n".join(record.sentences()) if record.rows else "no measurement yet")
        for name, box in self._figures.items():
            box.set_content(svg.get(name, ""))
        self._table.rows = [_cells(row) for row in record.rows[: -LAST_ROWS - 1 : -1]]
        self._table.update()


def _cells(row: Row) -> Row:
    row = rounded([row])[0]
    return {key: row[key] if isinstance(row[key], int | str) else f"{row[key]:.4g}" for key in COLUMNS}
