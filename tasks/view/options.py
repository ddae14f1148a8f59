"""Options of python -m tasks.view, and their checks."""

from __future__ import annotations

from typing import Annotated

import tyro
from annotated_types import Ge, Le

from tasks.options import Options, options


@options
class ViewConfig(Options):
    """A page to explore a fitted model: drag the moving end and see its spectrum, or hover over a map of RSSI.

    Needs the optional extra: pip install 'swiftwrf-tasks[view]'. Ctrl-C ends it.

    Example: swiftwrf view runs/aoa/first
    """

    source: Annotated[str, tyro.conf.Positional]
    """directory of a run of tasks.aoa, tasks.rssi, tasks.locate or tasks.update, or a saved model; an update that is being
    followed is shown as it grows"""
    port: Annotated[int, Ge(0), Le(65535)] = 8080
    """port of the page; 0 takes any free port"""
    host: str = "127.0.0.1"
    """address to listen on; with an address of the network, others can see the page and change the floor plan, without a
    password"""
    open: bool = False
    """open the page in the browser"""
