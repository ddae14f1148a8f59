"""A page to look around in a fitted field, served on this machine."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from swiftwrf import InputError
from tasks.view.opening import opened

MOST_PORT = 65535


@dataclass(frozen=True)
class ViewConfig:
    """A page to look around in a fitted field: drag the moving end and see its spectrum, or hover over a map of RSSI.

    Needs the optional extra: pip install 'swiftwrf-tasks[view]'. Ctrl-C ends it.
    """

    source: Annotated[str, tyro.conf.Positional]
    """directory of a run of tasks.aoa or tasks.rssi, or a saved model"""
    port: int = 8080
    """of the page; 0 takes any that is free"""
    host: str = "127.0.0.1"
    """address to listen on; other machines see the page, without a password, at any but this"""


def run(config: ViewConfig) -> None:
    """Serves the page until it is interrupted.

    Raises:
        InputError: nothing there to be looked at, a port that is in use, or the optional extra is not installed.
    """
    if not 0 <= config.port <= MOST_PORT:
        raise InputError(f"--port must be from 0 to {MOST_PORT}, got {config.port}")
    try:
        from tasks.view.server import free_port, serve
    except ModuleNotFoundError as error:
        if error.name != "nicegui":
            raise
        raise InputError("tasks.view needs the optional extra: pip install 'swiftwrf-tasks[view]'") from None
    port = free_port(config.host, config.port)
    serve(opened(Path(config.source)), config.host, port)
