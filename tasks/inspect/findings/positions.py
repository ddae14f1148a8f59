"""Findings on positions and splits."""

from __future__ import annotations

import torch
from torch import Tensor

from swiftwrf.data import Rssi, Snapshots, Spectra
from swiftwrf.data.splits import MAX_REPEATED, repeated_fraction
from swiftwrf.positions import distance
from tasks.inspect.findings.base import Findings

MAX_POSITIONS = 3000  # whose neighbours are searched
SMOOTH, ROUGH = 0.25, 0.5  # wavelengths between neighbours: below, fields are smooth; above, fringes are lost
SPARSE = 2.0  # wavelengths between neighbours, beyond which a search for a room finds few of its planes or none
MAX_END_OFFSET = 1e-3  # of normalised coordinates from the ends of their interval
MAX_EXTENT_M = 1000.0  # beyond, coordinates may be millimetres or pixels


def check_positions(position: Tensor, findings: Findings, wavelength: float | None = None) -> None:
    """Report extent and density of positions (n, 3) [m], in wavelengths [m] if the carrier is known."""
    low, high = position.amin(dim=0), position.amax(dim=0)
    extent = (high - low).tolist()
    ranges = ", ".join(
        f"{axis} {a:.2f} to {b:.2f}" for axis, a, b in zip("xyz", low.tolist(), high.tolist(), strict=True)
    )
    findings.add(f"{len(position)} positions, {ranges} m.", n=len(position), extent_m=extent)
    if max(extent) > MAX_EXTENT_M:
        findings.warn(f"Positions extend over {max(extent):.0f} m; are they metres?")
    flat = [axis for axis, size in zip("xyz", extent, strict=True) if size < 1e-9]
    if {"x", "y"} & set(flat):
        findings.warn(f"All positions have one {' and one '.join(flat)}; directions and planes are not identifiable.")
    if len(position) < 2:
        return
    _, near = nearest(position)
    _, times = position.unique(dim=0, return_counts=True)
    same = int(times[times > 1].sum())
    if same:
        findings.add(f"{same} positions occur more than once; the split random keeps each place in one part.")
    middle = float(near.median())
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
        geometry = "geometry needs none" if waves <= SPARSE else "geometry finds few planes, if any"
        findings.warn(f"{text}: interpolators see no fringes between such positions; {geometry}.")


def normalised(position: Tensor) -> str:
    """Return the interval that every coordinate of positions (n, 3) fills exactly, as normalised ones do, or an empty text.

    Coordinates without extent are left out; one coordinate alone is no evidence.
    """
    low, high = position.amin(dim=0), position.amax(dim=0)
    varying = high > low
    for name, start in (("[-1, 1]", -1.0), ("[0, 1]", 0.0)):
        ends = torch.cat([low[varying] - start, high[varying] - 1])
        if int(varying.sum()) >= 2 and bool((ends.abs() <= MAX_END_OFFSET).all()):
            return name
    return ""


def nearest(position: Tensor) -> tuple[Tensor, Tensor]:
    """Return rows of positions (n, 3), a subset of many, and the distance from each to the nearest other one [m]."""
    some = torch.linspace(0, len(position) - 1, min(MAX_POSITIONS, len(position))).round().long()
    apart = torch.cat([distance(position[rows], position) for rows in some.split(500)])
    apart[torch.arange(len(some)), some] = torch.inf
    return some, apart.amin(dim=1)


def add_splits(data: Spectra | Snapshots | Rssi, findings: Findings) -> None:
    """Report the splits that came with the measurements."""
    for name, (train, test) in data.named_splits.items():
        findings.add(f"Split {name}: {len(train)} for training, {len(test)} for testing.")
        position = data.transmitter_position if isinstance(data, Rssi) else data.position
        if (repeated := repeated_fraction(position[train], position[test])) > MAX_REPEATED:
            findings.warn(f"Split {name} tests look-up: {repeated:.0%} of its test rows are at training positions.")
