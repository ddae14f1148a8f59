"""A page to explore a fitted model in the browser, served on this machine."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from swiftwrf import InputError
from tasks.view.sources import open_source
from tasks.view.spectra import SpectraView

MAX_PORT = 65535


@dataclass(frozen=True)
class ViewConfig:
    """A page to explore a fitted model: drag the moving end and see its spectrum, or hover over a map of RSSI.

    Needs the optional extra: pip install 'swiftwrf-tasks[view]'. Ctrl-C ends it.
    """

    source: Annotated[str, tyro.conf.Positional]
    """directory of a run of tasks.aoa, tasks.rssi or tasks.locate, or a saved model"""
    port: int = 8080
    """port of the page; 0 takes any free port"""
    host: str = "127.0.0.1"
    """address to listen on; with any other address, other machines see the page without a password"""


def run(config: ViewConfig) -> None:
    """Serve the page until the process is interrupted.

    Raises:
        InputError: The source holds no model, the port is in use, or the optional extra is not installed.
    """
    if not 0 <= config.port <= MAX_PORT:
        raise InputError(f"--port must be from 0 to {MAX_PORT}, got {config.port}")
    try:
        from tasks.view.page import free_port, serve
        from tasks.view.rssi_page import RssiPage
        from tasks.view.spectra_page import SpectraPage
    except ModuleNotFoundError as error:
        if error.name != "nicegui":
            raise
        raise InputError("tasks.view needs the optional extra: pip install 'swiftwrf-tasks[view]'") from None
    port = free_port(config.host, config.port)
    view = open_source(Path(config.source))
    build = (lambda: SpectraPage(view)) if isinstance(view, SpectraView) else (lambda: RssiPage(view))
    serve(view.title, build, config.host, port)
