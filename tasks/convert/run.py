"""Convert measurements of any known format to the toolkit's own layout."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path

import torch

from swiftwrf import InputError
from swiftwrf.array.beamforming import PHASE
from swiftwrf.data import ReadOptions, Rssi, Snapshots, Spectra
from swiftwrf.data.formats import RSSI_FORMATS, SNAPSHOT_FORMATS, SPECTRA_FORMATS, read
from swiftwrf.data.writing import write_rssi, write_spectra
from swiftwrf.diagnostics.calibration import Calibration, calibrate
from tasks.convert.options import ConvertConfig
from tasks.directory import new_directory
from tasks.environment import invocation
from tasks.records import write_json
from tasks.source import reading
from tasks.terminal import console


def run(config: ConvertConfig) -> None:
    """Read measurements, calibrate them on request, and write them.

    Raises:
        InputError: Measurements that cannot be read, calibrated or written in the layout.
    """
    options = reading(config)
    with new_directory(Path(config.out), "a directory") as folder:
        data = read(config.source, options, SPECTRA_FORMATS, SNAPSHOT_FORMATS, RSSI_FORMATS)
        found = None
        if config.calibrate:
            data, found = _calibrated(data, config)
        for note in data.notes:
            console.print(f"{data.name}: {note}")
        written = _write(data, options, folder)
        record = {
            "command": invocation("convert"),
            "options": asdict(config),
            "source_sha256": data.source,
            "notes": data.notes,
            "calibration": found.to_json() if found else None,
        }
        write_json(folder / "conversion.json", record)
    print(f"{written}: {config.out}")


def _calibrated(data: Spectra | Snapshots | Rssi, config: ConvertConfig) -> tuple[Snapshots, Calibration]:
    if not isinstance(data, Snapshots):
        raise InputError("--calibrate takes array snapshots; spectra and RSSI do not hold the elements' phases")
    name = config.split or "random"
    train, test = data.split(name, config.seed)
    found = calibrate(train)
    phase, turn = float(found.phase_std.rad2deg().max()), float(found.turn.rad2deg().norm())
    console.print(
        f"calibrated on {found.clear} training positions: phases to {phase:.1f} deg, rotated by {turn:.1f} deg (+- "
        f"{float(found.turn_std.rad2deg().max()):.1f}); at held-out positions, {found.after:.0%} of the received power "
        f"arrives along the line of sight, {found.before:.0%} without calibration"
    )
    rows = torch.searchsorted(data.index, train.index), torch.searchsorted(data.index, test.index)
    return replace(found.apply(data), named_splits={**data.named_splits, name: rows}), found


def _write(data: Spectra | Snapshots | Rssi, options: ReadOptions, folder: Path) -> str:
    if isinstance(data, Rssi):
        write_rssi(data, folder)
        return f"{len(data)} rows of RSSI at {len(data.receiver_names)} receivers"
    spectra = data.spectra(options.grid, options.beamformer or PHASE) if isinstance(data, Snapshots) else data
    write_spectra(spectra, folder)
    return f"{len(spectra)} spectra of {spectra.grid.shape[0]} x {spectra.grid.shape[1]} pixels"
