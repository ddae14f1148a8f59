"""Positions of new observations, by a locator that a run keeps."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from swiftwrf import InputError, Rssi, Spectra, load, load_rssi
from swiftwrf.data.store import Store
from swiftwrf.data.survey import SUFFIXES, has_positions, read_frame
from swiftwrf.errors import listed
from swiftwrf.locate import MatchedField, Posterior, RssiLocator
from swiftwrf.metrics import angle_errors
from tasks.directory import check_new_table, console
from tasks.locate.localizers import BATCH_ROWS
from tasks.locate.options import OBSERVATIONS, TABLE, LocateConfig
from tasks.records import write_table
from tasks.source import observed_spectra, reading

Columns = dict[str, Tensor]


def write_positions(config: LocateConfig) -> None:
    """Write one row for each observation: position, its uncertainty and, where positions are known, the truth and the error.

    Raises:
        InputError: No locator, observations that cannot be read or are not like those it was fitted to, or `out` exists.
    """
    assert config.model is not None
    assert config.source is not None
    out = Path(config.out or TABLE)
    check_new_table(out)
    model = load(config.model)
    if isinstance(model, RssiLocator):
        columns = _of_rssi(model, config, config.source)
    elif isinstance(model, MatchedField):
        columns = _of_spectra(model, config, config.source)
    else:
        raise InputError(
            f"{config.model} holds a {model.kind}, which locates nothing; give {RssiLocator.kind!r} or {MatchedField.kind!r}"
        )
    rows = zip(*(column.tolist() for column in columns.values()), strict=True)
    write_table(out, [dict(zip(columns, row, strict=True)) for row in rows])
    error = f", median error {columns['position_error_m'].median():.2f} m" if "position_error_m" in columns else ""
    print(f"{len(columns['index'])} positions{error}: {out}")


def _of_rssi(locator: RssiLocator, config: LocateConfig, source: str) -> Columns:
    unused = [name for name in OBSERVATIONS if getattr(config, name) is not None]
    if unused:
        raise InputError(f"--{unused[0]} is for spectra, and {config.model} locates by RSSI")
    data, is_known = read_rssi(source, reading(config).columns or {})
    data = aligned(data, locator.receiver_names)
    kept = data.detected.any(dim=1)
    if not bool(kept.any()):
        raise InputError(f"no receiver of {config.model} detected the transmitter in any row of {source}")
    if not bool(kept.all()):
        console.print(f"{data.name}: rows that no receiver detected are left out: {int((~kept).sum())}")
    data = data.subset(kept)
    return _located(
        locator.locate, data.rssi_dbm.split(BATCH_ROWS), data.index, data.transmitter_position if is_known else None
    )


def read_rssi(source: str, columns: Mapping[str, str]) -> tuple[Rssi, bool]:
    """Read RSSI, and return it with True if its positions are known. A survey table may have none.

    Raises:
        InputError: RSSI that cannot be read.
    """
    file = Path(source)
    if file.is_file() and file.suffix.lower() in SUFFIXES:
        frame = read_frame(file)
        if not has_positions(frame, columns):
            return Rssi.from_frame(frame.assign(x=0.0, y=0.0, z=0.0), columns=columns, name=file.stem), False
    return load_rssi(source, columns=columns or None), True


def aligned(data: Rssi, names: tuple[str, ...]) -> Rssi:
    """Return the data at the receivers of a locator, in its order; those that the data lack count as not detecting.

    Raises:
        InputError: The data have none of the receivers.
    """
    place = {name: column for column, name in enumerate(data.receiver_names)}
    if not place.keys() & set(names):
        raise InputError(
            f"{data.name} has other receivers ({listed(data.receiver_names)}) than the model ({listed(names)}); their names "
            "must be the same"
        )
    missing = [name for name in names if name not in place]
    if missing:
        console.print(f"{data.name}: receivers of the model that are missing count as not detecting: {listed(missing)}")
    others = [name for name in data.receiver_names if name not in names]
    if others:
        console.print(f"{data.name}: receivers that the model does not have are not used: {listed(others)}")
    rssi = torch.full((len(data), len(names)), torch.nan, dtype=torch.float64)
    for column, name in enumerate(names):
        if name in place:
            rssi[:, column] = data.rssi_dbm[:, place[name]]
    unknown = torch.full((len(names), 3), torch.nan, dtype=torch.float64)
    return replace(data, rssi_dbm=rssi, receiver_names=names, receiver_position=unknown)


def _of_spectra(locator: MatchedField, config: LocateConfig, source: str) -> Columns:
    store, known = observed_spectra(source, reading(config), locator.grid, "locator")
    if known is not None and known.array is not None and known.array != locator.room.array:
        raise InputError(f"{source} has spectra of another array than those that {config.model} was fitted to")
    directions: list[Tensor] = []

    def locate(spectrum: Tensor) -> Posterior:
        posterior = locator.locate(spectrum)
        directions.append(locator.direction(posterior))
        return posterior

    index = torch.arange(len(store)) if known is None else known.index
    columns = _located(locate, _batches(store), index, None if known is None else known.position)
    direction = torch.cat(directions)
    columns |= {"azimuth_deg": direction[:, 0].rad2deg(), "elevation_deg": direction[:, 1].rad2deg()}
    return columns | _direction_errors(direction, known)


def _batches(store: Store) -> Iterable[Tensor]:
    return (part for batch in store.batches() for part in batch.split(BATCH_ROWS))


def _direction_errors(direction: Tensor, known: Spectra | None) -> Columns:
    if known is None:
        return {}
    truth = known.label.rad2deg()
    error = angle_errors(direction, known.label)["great_circle"].rad2deg()
    return {"truth_azimuth_deg": truth[:, 0], "truth_elevation_deg": truth[:, 1], "great_circle_deg": error}


def _located(
    locate: Callable[[Tensor], Posterior], batches: Iterable[Tensor], index: Tensor, truth: Tensor | None
) -> Columns:
    """Return the columns of a table with the positions of observations, batch by batch."""
    parts = []
    for batch in batches:
        posterior = locate(batch)
        parts.append((posterior.median, posterior.std, posterior.credible_radius(0.8), posterior.ambiguous))
    position, std, radius, ambiguous = (torch.cat(values) for values in zip(*parts, strict=True))
    columns: Columns = {"index": index}
    columns |= dict(zip(("x_m", "y_m", "z_m"), position.T, strict=True))
    columns |= dict(zip(("std_x_m", "std_y_m", "std_z_m"), std.T, strict=True))
    columns |= {"credible_radius_80_m": radius, "ambiguous": ambiguous}
    if truth is not None:
        columns |= dict(zip(("truth_x_m", "truth_y_m", "truth_z_m"), truth.T, strict=True))
        columns["position_error_m"] = (position - truth).norm(dim=1)
    return columns
