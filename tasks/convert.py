"""Conversion of measurements to the toolkit's own layout or to files, and of RSSI models to maps."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from swiftwrf import FieldModel, InputError, RssiModel, load
from swiftwrf.choices import PHASES_AND_ORIENTATION
from swiftwrf.contrib.diagnostics.calibration import Calibration, calibrate
from swiftwrf.contrib.formats.deepmimo import write_deepmimo
from swiftwrf.contrib.map_files import write_geojson, write_geotiff, write_world_file
from swiftwrf.data import Rssi, Snapshots, Spectra
from swiftwrf.data.dataset import Labelled
from swiftwrf.data.formats import RSSI_FORMATS, SNAPSHOT_FORMATS, SPECTRA_FORMATS
from swiftwrf.data.formats.paths import read_paths
from swiftwrf.data.writing import write_mat, write_rssi, write_spectra
from swiftwrf.errors import with_article
from swiftwrf.locate import RssiLocator
from swiftwrf.rssi.base import RssiPredictor
from swiftwrf.rssi.maps import RssiMap
from swiftwrf.runtime.checkpoint import Saved
from swiftwrf.runtime.durable import replacing, write_json
from tasks.command import run_module
from tasks.configs import FILES, MAP_FILES, ConvertConfig
from tasks.directory import check_new_file, model_file, new_directory
from tasks.environment import command, invocation
from tasks.options import by_name
from tasks.page import figures
from tasks.records import rounded, write_table
from tasks.source import reading
from tasks.terminal import console, terminal

FORMATS = (SPECTRA_FORMATS, SNAPSHOT_FORMATS, RSSI_FORMATS)
WORLD_FILE = ".pgw"  # suffix beside a .png
PNG_DPI = 150  # pixels an inch of an image


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
    if model is None and (config.receivers or config.cell is not None or config.height is not None):
        raise InputError(
            f"--receivers, --cell and --height are for maps of RSSI models, but {config.source} holds measurements"
        )
    if model is not None and config.reading.given:
        raise InputError(f"{config.source} is a model; options of reading are for measurements")
    check_new_file(out, FILES)
    if model is None:
        how = reading(config, config.source)
        _answer(config, write_file(how.options.spectra_of(how.read(*FORMATS)), out))
    else:
        found = RssiMap.predict(model, config.cell, config.height)
        _answer(config, write_file(found.receivers(config.receivers) if config.receivers else found, out))


def _write_directory(config: ConvertConfig) -> None:
    how = reading(config, config.source)
    with new_directory(Path(config.out), "a directory") as folder:
        data = how.read(*FORMATS)
        found = None
        if config.calibrate is not None:
            data, found = _calibrated(data, config)
        for note in data.notes:
            console.print(f"{data.name}: {note}")
        spectra = how.options.spectra_of(data)
        if isinstance(spectra, Rssi):
            write_rssi(spectra, folder)
            written = f"{len(spectra)} rows of RSSI at {len(spectra.receiver_names)} receivers"
        else:
            write_spectra(spectra, folder)
            written = f"{len(spectra)} spectra of {spectra.grid.shape[0]} x {spectra.grid.shape[1]} pixels"
        record = {
            "command": invocation("convert"),
            "options": by_name(config),
            "read_as": {name: str(value) for name, value in how.options.given.items()},
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
    parts = config.calibrate or PHASES_AND_ORIENTATION
    found = calibrate(train, parts)
    values = {
        "phases": f"phases to {float(found.phase_std.rad2deg().max()):.1f} deg",
        "orientation": f"rotated by {float(found.turn.rad2deg().norm()):.1f} deg (+- "
        f"{float(found.turn_std.rad2deg().max()):.1f})",
        "position": f"moved by {float(found.shift.norm()):.2f} m (+- {float(found.shift_std.max()):.2f})",
    }
    console.print(
        f"calibrated on {found.clear} training positions: {', '.join(values[part] for part in parts)}; at held-out "
        f"positions, {found.after:.0%} of the received power arrives along the line of sight, {found.before:.0%} without "
        "calibration"
    )
    rows = torch.searchsorted(data.index, train.index), torch.searchsorted(data.index, test.index)
    return replace(found.apply(data), named_splits={**data.named_splits, name: rows}), found


def saved_model(source: Path) -> RssiModel | None:
    """Return the RSSI model in a file or in the directory of a run; None if the source is no model.

    Raises:
        InputError: A run without an RSSI model, or a model of which no map is written.
    """
    file = model_file(source)
    if file.suffix != ".safetensors":
        return None
    model: Saved = load(file)
    model = model.model if isinstance(model, RssiLocator) else model
    if isinstance(model, RssiPredictor) and not isinstance(model, RssiModel):
        raise InputError(
            f"{file} holds {with_article(model.kind)}, of which no file is written; the report of its run shows its maps, "
            "and in Python its method predict gives RSSI at any position"
        )
    if isinstance(model, FieldModel):
        raise InputError(
            f"{file} predicts spectra at positions, not a map; use {command('predict', str(file), 'POSITIONS')}"
        )
    if not isinstance(model, RssiModel):
        raise InputError(f"{file} holds {with_article(model.kind)}, which predicts neither spectra nor RSSI")
    return model


def write_file(data: Labelled, file: Path) -> str:
    """Write a file by its suffix, and return a description of it.

    Raises:
        InputError: A suffix of maps for other data, or a map in local metres as GeoJSON.
    """
    if file.suffix.lower() in MAP_FILES:
        if not isinstance(data, RssiMap):
            raise InputError(f"{file.name} holds a map of RSSI, but the source is none; write .csv or .mat")
        return _write_map(data, file)
    if file.suffix.lower() == ".mat":
        write_mat(data, file)
        return f"{' and '.join(data.variables())}, with coordinates"
    table = data.to_frame()
    if table.index.name:
        table = table.reset_index()
    write_table(file, rounded(table.to_dict("records")))
    return f"{len(table)} rows"


def _write_map(data: RssiMap, file: Path) -> str:
    described = f"map of {len(data.y)} x {len(data.x)} cells of {data.cell:.3g} m"
    match file.suffix.lower():
        case ".tif":
            write_geotiff(file, data)
            return f"{described}, a band per receiver"
        case ".geojson":
            write_geojson(file, data)
            return described
    strongest = data.mean.max(axis=0)
    low, high = np.percentile(strongest, (1, 99)).tolist()
    x0, x1, y0, y1 = data.corners
    figure, axes = figures.panel(9.0, 1.2 + 7.0 * float(np.clip((y1 - y0) / (x1 - x0), 0.3, 1.5)))
    data.plot(ax=axes)
    axes.images[0].set_clim(low, max(high, low + 1))
    axes.set_aspect("equal")
    axes.grid(visible=False)
    figure.set_dpi(PNG_DPI)
    with replacing(file) as temporary:
        figure.savefig(temporary, format="PNG", dpi=PNG_DPI)
    columns, rows = figure.canvas.get_width_height()
    (left, bottom), (right, top) = axes.transData.inverted().transform([(0, 0), (columns, rows)]).tolist()
    write_world_file(file.with_suffix(WORLD_FILE), (left, right, bottom, top), (columns, rows), data.origin)
    return f"{described}, strongest RSSI from {low:.0f} dBm (dark) to {high:.0f} dBm (bright), with axes and world file"


if __name__ == "__main__":
    raise SystemExit(run_module("tasks.convert"))
