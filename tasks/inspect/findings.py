"""What measurements hold, and what about them may be wrong, in sentences."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal

import torch
from torch import Tensor

from swiftwrf import InputError
from swiftwrf.beamforming import PHASE
from swiftwrf.calibration import calibrate
from swiftwrf.data import Reading, Rssi, Snapshots, Spectra
from swiftwrf.data.splits import MIN_TRAINING
from swiftwrf.errors import listed
from swiftwrf.frames import FEW, check_frames, check_law
from swiftwrf.positions import distance

Level = Literal["is", "warning"]
MOST_POSITIONS = 3000  # whose neighbours are looked for at once
SMOOTH, ROUGH = 0.25, 0.5  # [wavelengths] between neighbours: below, fields are smooth; above, fringes are lost
WIDE = 1000.0  # [m] beyond which coordinates may be millimetres
STRONG = 10.0  # [dBm] at 1 m, which no usual transmitter reaches
REPEATED = 0.2  # share of one value at the edge that is no chance
HELPS = 0.1  # in the share along the line of sight, that a calibration must gain to be recommended


@dataclass(frozen=True)
class Finding:
    """One sentence: what is so, or a warning."""

    level: Level
    text: str


@dataclass
class Findings:
    """Sentences and numbers, in the order in which they were found."""

    sentences: list[Finding] = field(default_factory=list)
    numbers: dict[str, Any] = field(default_factory=dict)

    def say(self, text: str, **numbers: Any) -> None:
        """What is so."""
        self.sentences.append(Finding("is", text))
        self.numbers |= numbers

    def warn(self, text: str, **numbers: Any) -> None:
        """What may be wrong."""
        self.sentences.append(Finding("warning", text))
        self.numbers |= numbers


def inspect(data: Spectra | Snapshots | Rssi, how: Reading) -> tuple[Findings, Spectra | Rssi]:
    """Findings, and the spectra of snapshots."""
    findings = Findings()
    for note in data.notes:
        findings.say(f"{note}.")
    if isinstance(data, Rssi):
        _rssi(data, findings)
        return findings, data
    spectra = data
    if isinstance(data, Snapshots):
        _snapshots(data, findings)
        spectra = data.spectra(how.grid, how.beamformer or PHASE)
    assert isinstance(spectra, Spectra)
    _spectra(spectra, findings)
    fits = _frames(spectra, findings)
    if isinstance(data, Snapshots):
        _calibration(data, findings, fits)
    return findings, spectra


def _positions(position: Tensor, findings: Findings, wavelength: float | None = None) -> None:
    low, high = position.amin(dim=0), position.amax(dim=0)
    extent = (high - low).tolist()
    ranges = ", ".join(
        f"{axis} {a:.2f} to {b:.2f}" for axis, a, b in zip("xyz", low.tolist(), high.tolist(), strict=True)
    )
    findings.say(f"{len(position)} positions, {ranges} m.", n=len(position), extent_m=extent)
    if max(extent) > WIDE:
        findings.warn(f"Positions extend over {max(extent):.0f} m; are they millimetres? The toolkit takes metres.")
    flat = [axis for axis, size in zip("xyz", extent, strict=True) if size < 1e-9]
    if {"x", "y"} & set(flat):
        findings.warn(
            f"All positions have one {' and one '.join(flat)}; directions and planes cannot be told from them."
        )
    _, near = nearest(position)
    _, times = position.unique(dim=0, return_counts=True)
    same = int(times[times > 1].sum())
    if same:
        findings.warn(f"{same} positions occur more than once; a random split puts the same place into both parts.")
    middle = float(near.median())
    findings.numbers["nearest_m"] = middle
    if wavelength is None:
        findings.say(f"The nearest other position is {middle:.3f} m away (median).")
        return
    waves = middle / wavelength
    findings.numbers["nearest_wavelengths"] = waves
    text = f"The nearest other position is {middle:.3f} m, {waves:.2f} wavelengths away (median)"
    if waves <= SMOOTH:
        findings.say(f"{text}: interpolation between positions will work.")
    elif waves <= ROUGH:
        findings.say(f"{text}: interpolation will work in part; half a wavelength is the limit.")
    else:
        findings.warn(f"{text}: interpolators see no fringes between such positions; geometry needs none.")


def nearest(position: Tensor) -> tuple[Tensor, Tensor]:
    """Rows of positions (n, 3), all or, of many, some, and the distance from each to the nearest other one [m]."""
    some = torch.linspace(0, len(position) - 1, min(MOST_POSITIONS, len(position))).round().long()
    apart = torch.cat([distance(position[rows], position) for rows in some.split(500)])
    apart[torch.arange(len(some)), some] = torch.inf
    return some, apart.amin(dim=1)


def _splits(data: Spectra | Snapshots | Rssi, findings: Findings) -> None:
    for name, (train, test) in data.named_splits.items():
        findings.say(f"Split {name}: {len(train)} for training, {len(test)} for testing.")


def _spectra(data: Spectra, findings: Findings) -> None:
    rows, columns = data.grid.shape
    findings.say(
        f"{len(data)} spectra of {rows} elevations x {columns} azimuths; the {data.moving} moves.",
        kind="spectra",
        grid=[rows, columns],
        moving=data.moving,
    )
    _positions(data.position, findings, data.array.wavelength if data.array else None)
    free = float(data.line_of_sight.double().mean())
    findings.say(
        f"{free:.0%} of the positions have line of sight, or are not known to lack it.", line_of_sight_share=free
    )
    if data.array is None:
        findings.say(
            "The antenna array and its carrier are not described (--array tells them); coarray and geometry need them."
        )
    peak = torch.cat([part.flatten(1).amax(dim=1) for part in data.store.batches()])
    least = torch.cat([part.flatten(1).amin(dim=1) for part in data.store.batches()])
    if float(peak.min()) < 0.05:
        findings.warn(f"{int((peak < 0.05).sum())} spectra are nearly empty, below 0.05 everywhere.")
    if bool((least == peak).any()):
        findings.warn("Some spectra have one value everywhere.")
    _splits(data, findings)


def _frames(data: Spectra, findings: Findings) -> bool:
    """Whether the peaks of the spectra fit the lines of sight."""
    report = check_frames(data)
    if report is None:
        findings.warn(
            f"Frames cannot be checked: that needs the fixed end, the orientation and {FEW} positions with line of sight."
        )
        return False
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
    return report.fits


def _snapshots(data: Snapshots, findings: Findings) -> None:
    count, elements = data.channel.shape[1:]
    apart = distance(*(2 * [torch.nn.functional.pad(data.array.element, (0, 1))])).fill_diagonal_(torch.inf).amin(dim=1)
    spacing = float(apart.median() / data.array.wavelength)
    findings.say(
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
        findings.say(
            f"Taken over {float(data.time.max() - data.time.min()):.1f} s, {float(step.median()):.3f} s apart (median)."
        )
        if bool((step < 0).any()):
            findings.warn("Times are not in order; a block split by position does not mind.")


def _calibration(data: Snapshots, findings: Findings, fits: bool) -> None:
    try:
        found = calibrate(data)
    except InputError as error:
        findings.say(f"No calibration: {error}.")
        return
    gain = f"from {found.before:.0%} to {found.after:.0%} of what is heard, at positions held out"
    text = f"a calibration of phases and orientation brings what comes along the line of sight {gain}"
    if found.after - found.before >= HELPS:
        findings.warn(
            f"The array is not calibrated: {text} (turned by {float(found.turn.rad2deg().norm()):.1f} degrees). Use "
            "python -m tasks.convert SOURCE OUT --calibrate.",
            calibration=found.to_json(),
        )
    else:
        findings.say(f"The array needs no calibration: {text}.", calibration=found.to_json())


def _rssi(data: Rssi, findings: Findings) -> None:
    heard = ~data.rssi_dbm.isnan()
    share = float(heard.double().mean())
    low, high = float(data.rssi_dbm[heard].min()), float(data.rssi_dbm[heard].max())
    findings.say(
        f"{len(data)} rows of RSSI at {len(data.receiver_names)} receivers, {share:.0%} heard, {low:g} to {high:g} dBm.",
        kind="rssi",
        receivers=len(data.receiver_names),
        heard_share=share,
    )
    _positions(data.transmitter_position, findings)
    count = heard.sum(dim=0)
    few = [name for name, n in zip(data.receiver_names, count.tolist(), strict=True) if n < MIN_TRAINING]
    if few:
        findings.warn(f"Heard in fewer than {MIN_TRAINING} rows, too few to learn from: {listed(few)}.")
    _columns(data, heard, findings)
    _law(data, findings)
    _splits(data, findings)


def _columns(data: Rssi, heard: Tensor, findings: Findings) -> None:
    """Receivers whose values look like something else than received power."""

    def those(suspicious: Callable[[Tensor], bool]) -> list[str]:
        columns = ((name, data.rssi_dbm[heard[:, c], c]) for c, name in enumerate(data.receiver_names))
        return [name for name, values in columns if len(values) >= MIN_TRAINING and suspicious(values)]

    if constant := those(lambda v: bool(v.min() == v.max())):
        findings.warn(f"Receivers with one value everywhere: {listed(constant)}.")
    if positive := those(lambda v: bool(v.min() < v.max() and v.max() >= 0)):
        findings.warn(f"Receivers with values of 0 dBm and more, which few hear: {listed(positive)}.")

    def edged(values: Tensor) -> bool:
        weakest = values == values.min()
        others = values[~weakest]
        return len(others) > 0 and float(weakest.double().mean()) > REPEATED and float(others.min() - values.min()) > 3

    if repeated := those(edged):
        findings.warn(
            f"The weakest value is frequent and stands apart; does it mean not heard? Receivers: {listed(repeated)}."
        )
    filled = data.rssi_dbm.nan_to_num(0.0)
    same = [
        f"{a} = {b}"
        for i, a in enumerate(data.receiver_names)
        for j, b in enumerate(data.receiver_names[:i])
        if bool((filled[:, i] == filled[:, j]).all())
    ] if len(data.receiver_names) <= 200 else []  # fmt: skip
    if same:
        findings.warn(f"Receivers with the same values: {listed(same)}.")


def _law(data: Rssi, findings: Findings) -> None:
    report = check_law(data)
    if report is None:
        findings.say("The receivers' positions are unknown, so there is no law of the distance; other predictors work.")
        return
    findings.say(
        f"A law of the distance explains {report.explained:.0%} of the variance of RSSI: {report.level_dbm:.0f} dBm at 1 m, "
        f"falling with {report.exponent:.1f} powers of the distance.",
        law_explained=report.explained,
        law_exponent=report.exponent,
    )
    if report.explanation:
        findings.warn(f"It would explain far more if {report.explanation}.", explanation=report.explanation)
    if report.level_dbm > STRONG:
        findings.warn(
            f"{report.level_dbm:.0f} dBm at 1 m is more than usual transmitters give; are positions in millimetres?"
        )
