"""Convert measurements to the toolkit's own layout or to files, and RSSI models to maps."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch

from swiftwrf import InputError, RssiModel
from swiftwrf.array.beamforming import PHASE
from swiftwrf.data import ReadOptions, Rssi, Snapshots, Spectra
from swiftwrf.data.formats import RSSI_FORMATS, SNAPSHOT_FORMATS, SPECTRA_FORMATS, read
from swiftwrf.data.formats.paths import read_paths
from swiftwrf.data.writing import write_deepmimo, write_rssi, write_spectra
from swiftwrf.diagnostics.calibration import Calibration, calibrate
from swiftwrf.runtime.durable import write_json
from tasks.convert.options import FILES, ConvertConfig
from tasks.convert.outputs import map_of, saved_model, write_file
from tasks.directory import check_new_file, new_directory
from tasks.environment import invocation
from tasks.options import plain
from tasks.source import located, reading
from tasks.terminal import console, terminal


def run(config: ConvertConfig) -> None:
    """Read measurements or a model, and write a directory or a file.

    Raises:
        InputError: A source that cannot be read, calibrated or written as OUT asks.
    """
    source = Path(config.source)
    if config.deepmimo:
        with new_directory(Path(config.out), "a directory") as folder:
            paths = read_paths(source)
            write_deepmimo(paths, folder)
        _answer(config, f"{len(paths.count)} receivers with {len(paths.gain)} paths")
    elif (model := saved_model(source)) is not None or config.suffix:
        _write_new_file(config, model)
    else:
        _write_directory(config)


def _answer(config: ConvertConfig, written: str) -> None:
    terminal.page({"written": written, "out": config.out}, f"{written}: {config.out}")


def _write_new_file(config: ConvertConfig, model: RssiModel | None) -> None:
    out = Path(config.out)
    if not config.suffix:
        raise InputError(
            f"{config.source} is a model, of which files are written: {', '.join(FILES)}; got {config.out}"
        )
    if model is None and (config.rx or config.cell is not None or config.height is not None):
        raise InputError(
            f"--rx, --cell and --height are for maps of RSSI models, but {config.source} holds measurements"
        )
    if model is not None and (options := reading(config.spectra, config.table).given):
        raise InputError(f"{config.source} is a model; --{next(iter(options)).replace('_', '-')} is for measurements")
    check_new_file(out)
    data = (
        _spectra_or_rssi(_read(config), reading(config.spectra, config.table))
        if model is None
        else map_of(model, config)
    )
    _answer(config, write_file(data, out))


def _read(config: ConvertConfig) -> Spectra | Snapshots | Rssi:
    data: Spectra | Snapshots | Rssi = read(
        located(config.source), reading(config.spectra, config.table), SPECTRA_FORMATS, SNAPSHOT_FORMATS, RSSI_FORMATS
    )
    return data


def _spectra_or_rssi(data: Spectra | Snapshots | Rssi, options: ReadOptions) -> Spectra | Rssi:
    return data.spectra(options.grid, options.beamformer or PHASE) if isinstance(data, Snapshots) else data


def _write_directory(config: ConvertConfig) -> None:
    options = reading(config.spectra, config.table)
    with new_directory(Path(config.out), "a directory") as folder:
        data = _read(config)
        found = None
        if config.calibrate:
            data, found = _calibrated(data, config)
        for note in data.notes:
            console.print(f"{data.name}: {note}")
        written = _write(data, options, folder)
        record = {
            "command": invocation("convert"),
            "options": plain(config),
            "source_sha256": data.source,
            "notes": data.notes,
            "calibration": found.to_json() if found else None,
        }
        write_json(folder / "conversion.json", record)
    _answer(config, written)


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
    spectra = _spectra_or_rssi(data, options)
    if isinstance(spectra, Rssi):
        write_rssi(spectra, folder)
        return f"{len(spectra)} rows of RSSI at {len(spectra.receiver_names)} receivers"
    write_spectra(spectra, folder)
    return f"{len(spectra)} spectra of {spectra.grid.shape[0]} x {spectra.grid.shape[1]} pixels"
