"""Findings on spectra: their size and range, and whether their frames match."""

from __future__ import annotations

import torch

from swiftwrf.data import Spectra
from swiftwrf.diagnostics.frames import MIN_CLEAR_POSITIONS, check_frames
from tasks.inspect.findings.base import Findings
from tasks.inspect.findings.positions import check_positions, say_splits


def check_spectra(data: Spectra, findings: Findings) -> None:
    """Report number, grid, positions and range of spectra."""
    rows, columns = data.grid.shape
    findings.say(
        f"{len(data)} spectra of {rows} elevations x {columns} azimuths; the {data.moving} moves.",
        kind="spectra",
        grid=[rows, columns],
        moving=data.moving,
    )
    check_positions(data.position, findings, data.array.wavelength if data.array else None)
    free = float(data.line_of_sight.double().mean())
    findings.say(
        f"{free:.0%} of the positions have line of sight, or are not known to lack it.", line_of_sight_share=free
    )
    if data.array is None:
        findings.say(
            "The antenna array and its carrier are not described (give them with --array); coarray and geometry need them."
        )
    least, peak = torch.cat([torch.stack(part.flatten(1).aminmax(dim=1)) for part in data.store.batches()], dim=1)
    if float(peak.min()) < 0.05:
        findings.warn(f"{int((peak < 0.05).sum())} spectra are nearly empty, below 0.05 everywhere.")
    if bool((least == peak).any()):
        findings.warn("Some spectra have one value everywhere.")
    say_splits(data, findings)


def check_peaks(data: Spectra, findings: Findings) -> None:
    """Report whether the peaks of the spectra follow the lines of sight."""
    report = check_frames(data)
    if report is None:
        findings.warn(
            "Frames cannot be checked: that needs the fixed end, the orientation and "
            f"{MIN_CLEAR_POSITIONS} positions with line of sight."
        )
        return
    numbers = {
        "peak_to_line_of_sight_deg": report.angle_deg,
        "agreement": report.agreement,
        "agreement_by_chance": report.chance,
        "frame": "fits" if report.fits else "explained" if report.explanations or report.turn_deg else "undecided",
        "explanations": list(report.explanations),
        "turn_deg": report.turn_deg,
    }
    text = f"Peaks are {report.angle_deg:.1f} degrees beside the line of sight (median)"
    if report.explanations:
        findings.warn(f"{text}. That would fit if {'; or if '.join(report.explanations)}.", **numbers)
    elif report.turn_deg:
        angle = sum(a * a for a in report.turn_deg) ** 0.5
        axis = ", ".join(f"{a / angle:.2f}" for a in report.turn_deg)
        findings.warn(
            f"{text}. A constant rotation of {angle:.0f} degrees about ({axis}) in array coordinates would mend most of it: "
            "is the orientation right?",
            **numbers,
        )
    elif report.fits:
        findings.say(f"{text} and follow it: positions, orientation and angles are in one frame.", **numbers)
    elif report.chance >= report.agreement - 0.05 and report.chance > 0.2:
        findings.warn(
            f"{text}; all positions lie in nearly one direction from the array, so frames cannot be checked.", **numbers
        )
    else:
        findings.warn(
            f"{text} and do not follow it in any frame that was tried: reflections are stronger, or the elements' phases "
            "are not calibrated.",
            **numbers,
        )
