"""Findings on measurements, in sentences: what they hold, and what may be wrong."""

from __future__ import annotations

from swiftwrf.array.beamforming import PHASE
from swiftwrf.data import ReadOptions, Rssi, Snapshots, Spectra
from tasks.inspect.findings.base import Findings
from tasks.inspect.findings.frames import check_peaks
from tasks.inspect.findings.rssi import check_rssi
from tasks.inspect.findings.snapshots import check_calibration, check_snapshots
from tasks.inspect.findings.spectra import check_spectra


def inspect(data: Spectra | Snapshots | Rssi, options: ReadOptions) -> tuple[Findings, Spectra | Rssi]:
    """Return the findings, and the spectra of snapshots."""
    findings = Findings()
    for note in data.notes:
        findings.add(f"{note[0].upper()}{note[1:]}.")
    if isinstance(data, Rssi):
        check_rssi(data, findings)
        return findings, data
    if isinstance(data, Spectra):
        check_spectra(data, findings)
        check_peaks(data, findings)
        return findings, data
    beamformer = options.beamformer or PHASE
    spectra = data.spectra(options.grid, beamformer)
    check_snapshots(data, findings)
    check_spectra(spectra, findings)
    if check_peaks(spectra, findings, data, beamformer) != "explained":
        check_calibration(data, findings)
    return findings, spectra
