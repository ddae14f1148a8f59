"""A page to explore a fitted model in the browser, served on this machine."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from swiftwrf import InputError
from tasks.configs import ViewConfig
from tasks.view.followed import FollowedView
from tasks.view.rssi import RssiView
from tasks.view.sources import open_source
from tasks.view.spectra import SpectraView


def run(config: ViewConfig) -> None:
    """Serve the page until the process is interrupted.

    Raises:
        InputError: The source holds no model, the port is in use, or the optional extra is not installed.
    """
    try:
        from tasks.view.followed_page import FollowedPage
        from tasks.view.page import free_port, serve
        from tasks.view.rssi_page import RssiPage
        from tasks.view.spectra_page import SpectraPage
    except ModuleNotFoundError as error:
        if error.name != "nicegui":
            raise
        raise InputError("swiftwrf view needs the optional extra: pip install 'swiftwrf-tasks[view]'") from None
    port = free_port(config.host, config.port)
    view = open_source(Path(config.source))
    page: Any = {SpectraView: SpectraPage, RssiView: RssiPage, FollowedView: FollowedPage}[type(view)]
    serve(view.title, lambda: page(view), config.host, port, config.open)
