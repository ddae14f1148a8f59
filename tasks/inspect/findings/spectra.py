"""Findings on spectra: their size and range."""

from __future__ import annotations

import torch

from swiftwrf.data import Spectra
from tasks.inspect.findings.base import Findings
from tasks.inspect.findings.positions import add_splits, check_positions


def check_spectra(data: Spectra, findings: Findings) -> None:
    """Report number, grid, positions and range of spectra."""
    rows, columns = data.grid.shape
    findings.add(
        f"{len(data)} spectra of {rows} elevations x {columns} azimuths; the {data.moving} moves.",
        kind="spectra",
        grid=[rows, columns],
        moving=data.moving,
    )
    check_positions(data.position, findings, data.array.wavelength if data.array else None)
    free = float(data.line_of_sight.double().mean())
    findings.add(
        f"{free:.0%} of the positions have line of sight, or are not known to lack it.", line_of_sight_share=free
    )
    if data.array is None:
        findings.add(
            "The antenna array and its carrier are not described (give them with --array); coarray and geometry need them."
        )
    least, peak = torch.cat([torch.stack(part.flatten(1).aminmax(dim=1)) for part in data.store.batches()], dim=1)
    if float(peak.min()) < 0.05:
        findings.warn(f"{int((peak < 0.05).sum())} spectra are nearly empty, below 0.05 everywhere.")
    if bool((least == peak).any()):
        findings.warn("Some spectra have one value everywhere.")
    add_splits(data, findings)
