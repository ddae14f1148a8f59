"""Findings on array snapshots: their size, and whether the array is calibrated."""

from __future__ import annotations

from swiftwrf import InputError
from swiftwrf.data import Snapshots
from swiftwrf.diagnostics.calibration import calibrate
from tasks.inspect.findings.base import Findings
from tasks.inspect.findings.positions import ROUGH

MIN_GAIN = 0.1  # of a recommended calibration, in the fraction of the power along the line of sight


def check_snapshots(data: Snapshots, findings: Findings) -> None:
    """Report number, spacing and times of snapshots."""
    count, elements = data.channel.shape[1:]
    spacing = data.array.spacing_wavelengths
    findings.add(
        f"{len(data)} array snapshots of {count} subcarriers or packets x {elements} elements, {spacing:.2f} wavelengths "
        f"apart, at {data.array.frequency_hz / 1e9:.4g} GHz.",
        snapshots=count,
        elements=elements,
        spacing_wavelengths=spacing,
    )
    if spacing > ROUGH + 0.01:
        findings.warn(
            "Elements are more than half a wavelength apart, so spectra have several peaks for one direction."
        )
    if data.time is not None and len(data) > 1:
        step = data.time.diff()
        findings.add(
            f"Taken over {float(data.time.max() - data.time.min()):.1f} s, {float(step.median()):.3f} s apart (median)."
        )
        if bool((step < 0).any()):
            findings.warn("Times are not in order; a block split by position does not mind.")


def check_calibration(data: Snapshots, findings: Findings) -> None:
    """Report whether the array needs a calibration."""
    try:
        found = calibrate(data)
    except InputError as error:
        findings.add(f"No calibration: {error}.")
        return
    gain = f"from {found.before:.0%} to {found.after:.0%} of the received power, at held-out positions"
    text = f"a calibration of phases and orientation changes the part along the line of sight {gain}"
    if found.after - found.before >= MIN_GAIN:
        findings.warn(
            f"The array is not calibrated: {text} (turned by {float(found.turn.rad2deg().norm()):.1f} degrees). Use "
            "python -m tasks.convert SOURCE OUT --calibrate.",
            calibration=found.to_json(),
        )
    else:
        findings.add(f"The array needs no calibration: {text}.", calibration=found.to_json())
