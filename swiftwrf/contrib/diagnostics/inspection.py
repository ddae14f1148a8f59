"""Inspection of measurements before a model is fitted: what they contain, and what may be wrong, in sentences."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal

import torch
from torch import Tensor

from swiftwrf.array.angles import AngularGrid
from swiftwrf.array.beamforming import PHASE
from swiftwrf.contrib.diagnostics.calibration import calibrate
from swiftwrf.contrib.diagnostics.elements import in_fft_order, in_noise, noisy_elements
from swiftwrf.contrib.diagnostics.frames import Frame, check_frames
from swiftwrf.contrib.diagnostics.path_loss import check_path_loss
from swiftwrf.data import Rssi, Snapshots, Spectra
from swiftwrf.data.powers import has_frequent_edge
from swiftwrf.data.splits import MAX_REPEATED, MIN_TRAINING, centres, places, repeated_fraction
from swiftwrf.errors import InputError, listed
from swiftwrf.positions import nearest
from swiftwrf.rssi import estimate_offsets
from swiftwrf.runtime.validation import checked

Level = Literal["fact", "warning"]
SMOOTH, ROUGH = 0.25, 0.5  # wavelengths between neighbours: below, fields are smooth; above, fringes are lost
SPARSE = 2.0  # wavelengths between neighbours, beyond which a search for a room finds few of its planes or none
MAX_EXTENT_M = 1000.0  # beyond, coordinates may be millimetres or pixels
MIN_GRID_M = 1e5  # of eastings and northings in UTM and national grids, which are metres
MIN_GAIN = 0.1  # of a recommended calibration, in the fraction of the power along the line of sight
MIN_BEHIND = 0.01  # share of the lines of sight behind the array that is reported
MAX_LEVEL_DBM = 10.0  # at 1 m, which no usual transmitter reaches
MIN_EXPLAINED, MIN_SPREAD_DB = 0.15, 1.0  # of offsets that are proposed


@dataclass
class Findings:
    """Facts and warnings about measurements, in the order of the checks. `print` shows a line each, warnings with a mark.

    Args:
        data: Measurements that were inspected, snapshots as spectra.
        sentences: Facts and warnings: level and text.
        numbers: Numbers behind the sentences by name, with units in the names.
    """

    data: Spectra | Rssi
    sentences: list[tuple[Level, str]] = field(default_factory=list)
    numbers: dict[str, Any] = field(default_factory=dict)

    @property
    def warnings(self) -> list[str]:
        """Texts of the warnings."""
        return [text for level, text in self.sentences if level == "warning"]

    def add(self, text: str, **numbers: Any) -> None:
        """Add a fact."""
        self.sentences.append(("fact", text))
        self.numbers |= numbers

    def warn(self, text: str, **numbers: Any) -> None:
        """Add a warning."""
        self.sentences.append(("warning", text))
        self.numbers |= numbers

    def __str__(self) -> str:
        return "\n".join(f"{'!' if level == 'warning' else ' '} {text}" for level, text in self.sentences)


@checked
def inspect(
    data: Spectra | Snapshots | Rssi, *, grid: AngularGrid | tuple[int, int] | None = None, beamformer: str = PHASE
) -> Findings:
    """Return what measurements contain and what may be wrong: counts, frames, units, density, calibration.

    Args:
        data: Spectra, array snapshots or RSSI.
        grid: Grid of the spectra of snapshots, or its numbers of elevations and azimuths.
        beamformer: Beamformer of the spectra of snapshots.

    Raises:
        InputError: No measurement, an unknown beamformer, or too few snapshots for it.

    Example:
        >>> import swiftwrf
        >>> findings = inspect(swiftwrf.simulated_room(n=50))
        >>> len(findings.warnings), findings.numbers["frame"]
        (0, 'fits')
    """
    if not (data.detected.any() if isinstance(data, Rssi) else len(data)):
        raise InputError(f"{data.name} holds no measurement to inspect")
    spectra = data.spectra(grid, beamformer) if isinstance(data, Snapshots) else data
    findings = Findings(spectra)
    for note in data.notes:
        findings.add(f"{note[0].upper()}{note[1:]}.")
    if isinstance(spectra, Rssi):
        _check_rssi(spectra, findings)
        return findings
    snapshots = data if isinstance(data, Snapshots) else None
    if snapshots is not None:
        _check_snapshots(snapshots, findings)
    _check_spectra(spectra, findings)
    if _check_peaks(spectra, findings, snapshots) != "explained" and snapshots is not None:
        if noise := noisy_elements(snapshots, snapshots.away):
            findings.warn(f"E{in_noise(noise)[1:]}.", noisy_elements=noise)
        _check_calibration(snapshots, findings)
    return findings


def _check_positions(
    position: Tensor, findings: Findings, wavelength: float | None = None, projected: bool = False
) -> None:
    """Report extent and density of positions (n, 3) [m], in wavelengths [m] if the carrier is known.

    Metres of projected degrees are not asked about.
    """
    low, high = position.amin(dim=0), position.amax(dim=0)
    extent = (high - low).tolist()
    ranges = ", ".join(
        f"{axis} {a:.2f} to {b:.2f}" if b > a else f"{axis} {a:.2f}"
        for axis, a, b in zip("xyz", low.tolist(), high.tolist(), strict=True)
    )
    findings.add(f"{len(position)} positions, {ranges} m.", n=len(position), extent_m=extent)
    projected = projected or bool((position[:, :2].abs().amin(dim=0) > MIN_GRID_M).all())
    if max(extent) > MAX_EXTENT_M and not projected:
        findings.warn(f"Positions extend over {max(extent):.0f} m; are they metres?")
    flat = [axis for axis, size in zip("xyz", extent, strict=True) if size < 1e-9]
    if {"x", "y"} & set(flat):
        findings.warn(f"All positions have one {' and one '.join(flat)}; directions and planes are not identifiable.")
    spots = centres(position, places(position))
    if len(spots) < len(position):
        findings.add(f"{len(position)} rows are at {len(spots)} places; the split random keeps each in one part.")
    if len(spots) < 2:
        return
    middle = float(nearest(spots, spots, 2)[0][:, 1].median())
    findings.numbers["nearest_m"] = middle
    if wavelength is None:
        findings.add(f"The nearest other position is {middle:.3f} m away (median).")
        return
    waves = middle / wavelength
    findings.numbers["nearest_wavelengths"] = waves
    text = f"The nearest other position is {middle:.3f} m, {waves:.2f} wavelengths away (median)"
    if waves <= SMOOTH:
        findings.add(f"{text}: interpolation between positions will work.")
    elif waves <= ROUGH:
        findings.add(f"{text}: interpolation will work in part; half a wavelength is the limit.")
    else:
        text += ": only models of the walls (geometry, hybrid) predict between them."
        if waves <= SPARSE:
            findings.add(f"{text} Nothing to do.")
        else:
            findings.warn(f"{text} They find few walls, if any; measure more densely.")


def _add_splits(data: Spectra | Snapshots | Rssi, findings: Findings) -> None:
    """Report the splits that came with the measurements."""
    for name, (train, test) in data.named_splits.items():
        findings.add(f"Split {name}: {len(train)} for training, {len(test)} for testing.")
        position = data.transmitter_position if isinstance(data, Rssi) else data.position
        if (repeated := repeated_fraction(position[train], position[test])) > MAX_REPEATED:
            findings.warn(f"Split {name} tests look-up: {repeated:.0%} of its test rows are at training positions.")


def _check_spectra(data: Spectra, findings: Findings) -> None:
    """Report number, grid, positions and range of spectra."""
    rows, columns = data.grid.shape
    findings.add(
        f"{len(data)} spectra of {rows} elevations x {columns} azimuths; the {data.moving} moves.",
        kind="spectra",
        grid=[rows, columns],
        moving=data.moving,
    )
    _check_positions(data.position, findings, data.array.wavelength if data.array else None)
    free = float(data.line_of_sight.double().mean())
    sight = (
        f"{free:.0%} of the positions have line of sight."
        if free < 1
        else "No position is marked as without line of sight."
    )
    findings.add(sight, line_of_sight_share=free)
    if data.array is None:
        findings.add(
            "The antenna array and its carrier are not described (give them with --array); coarray and geometry need them."
        )
    least, peak = torch.cat([torch.stack(part.flatten(1).aminmax(dim=1)) for part in data.store.batches()], dim=1)
    if float(peak.min()) < 0.05:
        findings.warn(f"{int((peak < 0.05).sum())} spectra are nearly empty, below 0.05 everywhere.")
    if bool((least == peak).any()):
        findings.warn("Some spectra have one value everywhere.")
    _add_splits(data, findings)


def _check_snapshots(data: Snapshots, findings: Findings) -> None:
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
    if in_fft_order(data):
        findings.warn(
            "Subcarriers look to be in the order of an FFT, from zero frequency, but the carriers ascend: give "
            "np.fft.fftshift(csi, axes=1). Directions are right, but delays and geometry are not."
        )
    near = float((data.away.norm(dim=1) < data.array.far_field_m).double().mean())
    if near > 0:
        findings.add(
            f"{near:.0%} of the positions are nearer than 2 D^2 / wavelength = {data.array.far_field_m:.2g} m, so waves are "
            "curved over the array; frames and calibration are checked with distances.",
            near_field_share=near,
        )
    if data.time is not None and len(data) > 1:
        step = data.time.diff()
        findings.add(
            f"Taken over {float(data.time.max() - data.time.min()):.1f} s, {float(step.median()):.3f} s apart (median)."
        )


def _check_calibration(data: Snapshots, findings: Findings) -> None:
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
            "swiftwrf.calibrate, or swiftwrf convert SOURCE OUT --calibrate.",
            calibration=found.to_json(),
        )
    else:
        findings.add(f"The array needs no calibration: {text}.", calibration=found.to_json())


def _check_peaks(data: Spectra, findings: Findings, snapshots: Snapshots | None) -> Frame:
    """Report whether the peaks of the spectra follow the lines of sight, and return the result in a word."""
    frame, text, numbers = check_frames(data, snapshots)
    behind = numbers.get("behind_share", 0.0)
    if frame != "explained" and behind >= MIN_BEHIND:
        where = "of the positions lie" if data.moving == "transmitter" else "of the positions have the transmitter"
        folded = f"{behind:.0%} {where} behind the array, and their directions are folded to its front"
        if behind > 1 - MIN_BEHIND:
            findings.add(f"{folded}.")
        else:
            findings.warn(f"{folded}: two places share one label.")
    add = findings.add if frame in ("fits", "in part") else findings.warn
    add(text, **numbers)
    return frame


def _check_rssi(data: Rssi, findings: Findings) -> None:
    """Report number, range and suspicious columns of RSSI."""
    detected = data.detected
    share = float(detected.double().mean())
    low, high = float(data.rssi_dbm[detected].min()), float(data.rssi_dbm[detected].max())
    findings.add(
        f"{len(data)} rows of {data.quantity} at {len(data.receiver_names)} receivers, {share:.0%} detected, {low:g} to "
        f"{high:g} {data.unit}.",
        kind="rssi",
        receivers=len(data.receiver_names),
        detected_fraction=share,
    )
    _check_positions(data.transmitter_position, findings, projected=data.origin is not None)
    count = detected.sum(dim=0)
    few = [name for name, n in zip(data.receiver_names, count.tolist(), strict=True) if n < MIN_TRAINING]
    if few:
        findings.warn(f"Receivers that detected fewer than {MIN_TRAINING} rows, too few to fit a model: {listed(few)}.")
    if data.is_power:
        _columns(data, detected, findings)
        _path_loss(data, findings)
    _add_splits(data, findings)


def propose_offsets(data: Rssi, findings: Findings) -> None:
    """Warn of the column of the groups of RSSI if its values have constant offsets."""
    if data.groups is None or data.groups.nunique() < 2:
        return
    column = data.groups.name
    offsets = estimate_offsets(data)
    spread = max(offsets.offset_db.values()) - min(offsets.offset_db.values())
    if offsets.explained < MIN_EXPLAINED or spread < MIN_SPREAD_DB:
        return
    findings.warn(
        f"Offsets of up to {spread:.1f} dB between the values of column {column} explain {offsets.explained:.0%} of the "
        f"variance about a smooth field; --offset-by {column} estimates them.",
        **{f"offsets_explained_{column}": offsets.explained},
    )


def _columns(data: Rssi, detected: Tensor, findings: Findings) -> None:
    """Warn of receivers whose values do not look like received power."""

    def those(suspicious: Callable[[Tensor], bool]) -> list[str]:
        columns = ((name, data.rssi_dbm[detected[:, c], c]) for c, name in enumerate(data.receiver_names))
        return [name for name, values in columns if len(values) >= MIN_TRAINING and suspicious(values)]

    if constant := those(lambda v: bool(v.min() == v.max())):
        findings.warn(f"Receivers with one value everywhere: {listed(constant)}.")
    if positive := those(lambda v: bool(v.min() < v.max() and v.max() >= 0)):
        findings.warn(f"Receivers with values of 0 dBm and more, which few receivers measure: {listed(positive)}.")
    if repeated := those(lambda v: has_frequent_edge(v.numpy())):
        findings.warn(
            "The weakest value is far more frequent than those above it; does it mean not detected? Receivers: "
            f"{listed(repeated)}."
        )
    first, filled = dict[bytes, str](), zip(data.receiver_names, data.rssi_dbm.nan_to_num(0.0).T, strict=True)
    earliest = {name: first.setdefault(column.numpy().tobytes(), name) for name, column in filled}
    if same := [f"{name} = {other}" for name, other in earliest.items() if name != other]:
        findings.warn(f"Receivers with the same values: {listed(same)}.")


def _path_loss(data: Rssi, findings: Findings) -> None:
    report = check_path_loss(data.columns(data.receiver_located.nonzero()[:, 0].tolist()))
    if report is None:
        findings.add("The receivers' positions are unknown, so there is no path-loss model; other predictors work.")
        return
    findings.add(
        f"Path-loss models explain {report.explained:.0%} of the variance of RSSI: {report.level_dbm:.0f} dBm at 1 m, "
        f"exponent {report.exponent:.1f}.",
        law_explained=report.explained,
        law_exponent=report.exponent,
    )
    if report.explanation:
        findings.warn(f"It would explain far more if {report.explanation}.", explanation=report.explanation)
    if report.misplaced:
        findings.warn(
            f"Other positions of the receivers would explain {report.attainable:.0%}; no frame that was tried comes close: "
            "are origin, axes and units those of the positions?",
            law_attainable=report.attainable,
        )
    if report.level_dbm > MAX_LEVEL_DBM:
        findings.warn(
            f"{report.level_dbm:.0f} dBm at 1 m is more than usual transmitters give; are positions in millimetres?"
        )
