"""What both pages are made of."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import Generic, TypeVar

from markupsafe import escape
from matplotlib import colormaps
from matplotlib.colors import to_hex
from nicegui import background_tasks, ui

from tasks.view.plan import Plan

Wanted = TypeVar("Wanted")
STYLE = """
.nicegui-content { padding: 12px 20px; }
.outside svg { overflow: visible; }
.drag { touch-action: none; cursor: crosshair; user-select: none; }
.pixels img { image-rendering: pixelated; }
.numbers { font-variant-numeric: tabular-nums; }
.quiet { opacity: 0.75; font-size: 0.85rem; }
"""


class Latest(Generic[Wanted]):
    """Does the newest of what is asked for, one at a time: what is out of date when its turn comes is left out, so that a
    slow model follows the pointer instead of trailing behind it.

    Args:
        do: what is asked for.
    """

    def __init__(self, do: Callable[[Wanted], Awaitable[None]]) -> None:
        self._do, self._busy = do, False
        self._wanted: list[Wanted] = []

    def ask(self, wanted: Wanted) -> None:
        """Asks for something, in place of what has not begun."""
        self._wanted = [wanted]
        if not self._busy:
            background_tasks.create(self._work())

    async def _work(self) -> None:
        self._busy = True
        try:
            while self._wanted:
                await self._do(self._wanted.pop())
        finally:
            self._busy = False


def header(title: str, notes: list[str]) -> ui.row:
    """Title, notes and the switch between light and dark; returns the row for further choices."""
    ui.add_css(STYLE)
    dark = ui.dark_mode(None)
    with ui.row().classes("w-full items-center no-wrap"):
        ui.label(title).classes("text-h6 ellipsis").style("max-width: 40%")
        row = ui.row().classes("items-center gap-6 grow no-wrap")
        ui.toggle({None: "auto", False: "light", True: "dark"}, value=None).props("dense no-caps flat").bind_value_to(
            dark
        )
    for note in notes:
        ui.label(note).classes("quiet")
    return row


def canvas(plan: Plan, name: str) -> ui.interactive_image:
    """A picture of the size of a plan, a pixel of the page for each of its own, which tells where the pointer is."""
    events = ["pointerdown", "pointermove", "pointerup", "pointerleave"]
    picture = ui.interactive_image(size=plan.size, events=events, sanitize=False)
    picture.style(f"width: {plan.size[0]}px; margin: 24px 10px 34px 48px")
    return picture.classes("outside drag").props(f'id="{name}"')


def colour_bar(colours: str, low: float, high: float, label: str) -> str:
    """A legend of a colour map as SVG."""
    steps = [to_hex(colormaps[colours](i / 8)) for i in range(9)]
    stops = "".join(f'<stop offset="{i / 8:g}" stop-color="{step}"/>' for i, step in enumerate(steps))
    numbers = "".join(
        f'<text x="{x}" y="30" text-anchor="{anchor}" font-size="12" fill="currentColor">{value:.3g}</text>'
        for x, anchor, value in ((0, "start", low), (130, "middle", (low + high) / 2), (260, "end", high))
    )
    return (
        f'<svg width="520" height="34"><defs><linearGradient id="bar-{colours}">{stops}</linearGradient></defs>'
        f'<rect width="260" height="14" fill="url(#bar-{colours})"/>{numbers}'
        f'<text x="272" y="12" font-size="13" fill="currentColor">{escape(label)}</text></svg>'
    )
