"""Findings on frames: whether peaks follow the lines of sight, and what explains it if not."""

from __future__ import annotations

from typing import Literal

from swiftwrf.array.beamforming import PHASE
from swiftwrf.data import Snapshots, Spectra
from swiftwrf.diagnostics.elements import flipping_elements, phases_are_constant
from swiftwrf.diagnostics.frames import MIN_CLEAR_POSITIONS, FrameReport, check_frames
from swiftwrf.errors import ranges
from tasks.inspect.findings.base import Findings
from tasks.inspect.findings.positions import normalised

MIN_BEHIND = 0.01  # share of the lines of sight behind the array that is reported
Frame = Literal["unknown", "fits", "in part", "explained", "turned", "undecided"]


def check_peaks(
    data: Spectra, findings: Findings, snapshots: Snapshots | None = None, beamformer: str = PHASE
) -> Frame:
    """Report whether the peaks of the spectra follow the lines of sight, and return the result in a word.

    Args:
        data: Spectra.
        findings: Findings to add to.
        snapshots: Snapshots that the spectra were computed from.
        beamformer: Beamformer of those spectra.
    """
    report = check_frames(data, snapshots, beamformer)
    if report is None:
        findings.warn(
            "Frames cannot be checked: that needs the fixed end, the orientation and "
            f"{MIN_CLEAR_POSITIONS} positions with line of sight."
        )
        return "unknown"
    frame, text = _error(data, report, snapshots) or _without_error(report)
    if frame != "explained":
        _add_behind(data, report, findings)
    linear = data.array is not None and data.array.axis is not None
    by = ", by the angle to the array's axis" if linear else ""
    add = findings.add if frame in ("fits", "in part") else findings.warn
    add(
        f"Peaks are {report.angle_deg:.1f} degrees beside the line of sight (median{by}){text}.",
        peak_to_line_of_sight_deg=report.angle_deg,
        agreement=report.agreement,
        agreement_by_chance=report.chance,
        behind_share=report.behind,
        frame=frame,
        explanations=list(report.explanations),
        turn_deg=report.turn_deg,
    )
    return frame


def _error(data: Spectra, report: FrameReport, snapshots: Snapshots | None) -> tuple[Frame, str] | None:
    """Return the error that explains the peaks, in words, or None."""
    if not report.fits and (filled := normalised(data.position)):
        return "explained", f". All coordinates fill {filled} exactly, so positions look normalised; give metres"
    if report.explanations:
        return "explained", f". That would fit if {'; or if '.join(report.explanations)}"
    if snapshots is not None and (flipping := flipping_elements(snapshots)):
        elements = f"{'element' if len(flipping) == 1 else 'elements'} {ranges(flipping)}"
        return "explained", f". The phase of {elements} jumps by half a turn from measurement to measurement"
    if snapshots is not None and phases_are_constant(snapshots):
        return "explained", (
            ". Phases between elements hardly depend on the position: the delay to each element may be missing in them, or "
            "the elements may be another axis"
        )
    if report.turn_deg:
        angle = sum(a * a for a in report.turn_deg) ** 0.5
        axis = ", ".join(f"{a / angle:.2f}" for a in report.turn_deg)
        return "turned", (
            f". A constant rotation of {angle:.0f} degrees about ({axis}) in array coordinates would mend most of it: "
            "is the orientation right?"
        )
    return None


def _without_error(report: FrameReport) -> tuple[Frame, str]:
    """Return how far peaks and lines of sight agree in the declared frame, in words."""
    if report.fits:
        return "fits", " and follow it: positions, orientation and angles are in one frame"
    if report.narrow:
        return "undecided", (
            f". All lines of sight have nearly one direction ({report.span_deg:.1f} degrees between two, median), so frames "
            "cannot be checked"
        )
    if report.steady:
        return "undecided", (
            f". The spectra hardly differ: two peaks are {report.peak_span_deg:.1f} degrees apart, two lines of sight "
            f"{report.span_deg:.1f} degrees (medians)"
        )
    if report.follows:
        return "in part", (
            ". They follow it at a part of the positions, and no other frame that was tried explains more: elsewhere "
            "reflections are stronger"
        )
    return "undecided", (
        " and do not follow it in any frame that was tried: reflections are stronger, or the elements' phases are not "
        "calibrated"
    )


def _add_behind(data: Spectra, report: FrameReport, findings: Findings) -> None:
    """Report lines of sight behind a planar array, whose directions are folded to its front."""
    if report.behind < MIN_BEHIND:
        return
    where = "of the positions lie" if data.moving == "transmitter" else "of the positions have the transmitter"
    text = f"{report.behind:.0%} {where} behind the array, and their directions are folded to its front"
    if report.behind > 1 - MIN_BEHIND:
        findings.add(f"{text}.")
    else:
        findings.warn(f"{text}: two places share one label.")
