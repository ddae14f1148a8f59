"""The page of RSSI: maps to hover over, coverage, and who hears best."""

from __future__ import annotations


from tasks.view.rssi import RssiScene


def show(scene: RssiScene) -> None:
    """Builds the page."""
