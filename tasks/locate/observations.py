"""Positions of new observations, by a locator that a run keeps."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from swiftwrf import InputError, Rssi, Spectra, load
from swiftwrf.data import ReadOptions
from swiftwrf.data.coordinates import degree_columns
from swiftwrf.data.files import SUFFIXES, read_table
from swiftwrf.data.formats import RSSI_FORMATS, read
from swiftwrf.data.store import Store
from swiftwrf.data.survey import has_positions
from swiftwrf.errors import listed, with_article
from swiftwrf.locate import MatchedField, Posterior, RssiLocator, smoothed
from swiftwrf.locate.baselines import BATCH_ROWS
from swiftwrf.metrics import angle_errors
from tasks.directory import check_new_file
from tasks.environment import stamp
from tasks.locate.options import LocateConfig
from tasks.options import SpectraSource, TableSource, given
from tasks.records import Row, rounded, write_table
from tasks.source import located, observed_spectra, reading
from tasks.terminal import console, terminal

Columns = dict[str, Tensor]
MAX_TRACKED = 20_000_000  # candidate positions of a walk that are in memory together


def write_positions(config: LocateConfig) -> None:
    """Write one row for each observation: position, its uncertainty and, where positions are known, the truth and the error.

    Raises:
        InputError: No locator, observations that cannot be read or are not like those it was fitted to, or `out` exists.
    """
    assert config.model is not None
    assert config.source is not None
    out = Path(config.out or f"positions-{stamp()}.csv")
    check_new_file(out, "--out ")
    model = load(config.model)
    if isinstance(model, RssiLocator):
        columns = _of_rssi(model, config, config.source)
    elif isinstance(model, MatchedField):
        columns = _of_spectra(model, config, config.source)
    else:
        raise InputError(
            f"{config.model} holds {with_article(model.kind)}, which locates nothing; give {RssiLocator.kind!r} or "
            f"{MatchedField.kind!r}"
        )
    rows = zip(*(column.tolist() for column in columns.values()), strict=True)
    write_table(out, rounded(dict(zip(columns, row, strict=True)) for row in rows))
    values: Row = {"n_positions": len(columns["index"]), "table": str(out)}
    error = ""
    if "position_error_m" in columns:
        values["median_error_m"] = float(columns["position_error_m"].median())
        error = f", median error {values['median_error_m']:.2f} m, too low if these rows trained the locator"
    terminal.page(values, f"{values['n_positions']} positions{error}: {out}")


def _of_rssi(locator: RssiLocator, config: LocateConfig, source: str) -> Columns:
    if unused := given(config, SpectraSource):
        raise InputError(f"--{unused[0]} is for spectra, and {config.model} locates by RSSI")
    options = reading(config)
    offsets = locator.model.offsets
    if offsets is not None and has_column(source, offsets.column):
        options = replace(options, offset_by=offsets.column)
    data, is_known = read_rssi(source, options)
    origin = locator.model.origin
    if is_known and data.origin is not None and origin is None:
        raise InputError(f"{source} has positions in degrees, {config.model} was fitted to metres; give metres")
    if offsets is not None:
        if data.groups is None:
            console.print(f"{data.name}: rows count as those of {offsets.column} {offsets.reference}")
        data = offsets.removed(data)
    data = aligned(data.about(origin), locator.receiver_names)
    locator.model.check_measurements(data)
    kept = data.detected.any(dim=1)
    if not bool(kept.any()):
        raise InputError(f"no receiver of {config.model} detected the transmitter in any row of {source}")
    if not bool(kept.all()):
        console.print(f"{data.name}: rows that no receiver detected are left out: {int((~kept).sum())}")
    data = data.subset(kept)
    posteriors: Iterable[Posterior] = map(locator.locate, data.rssi_dbm.split(BATCH_ROWS))
    if config.track is not None:
        posteriors = _tracked(posteriors, _times(source, data), config.track)
    columns = _located(posteriors, data.index, data.transmitter_position if is_known else None)
    degrees = degree_columns(origin, torch.stack([columns["x_m"], columns["y_m"]], dim=1).numpy())
    return columns | {name: torch.from_numpy(values.copy()) for name, values in degrees.items()}


def read_rssi(source: str, options: ReadOptions) -> tuple[Rssi, bool]:
    """Read RSSI, and return it with True if its positions are known. A survey table may have none.

    Raises:
        InputError: RSSI that cannot be read.
    """
    file = Path(source)
    if file.is_file() and file.suffix.lower() in SUFFIXES:
        frame = read_table(file)
        if not has_positions(frame, options.columns or {}):
            somewhere = frame.assign(x=0.0, y=0.0, z=0.0)
            columns, filler, offset_by = options.columns, options.filler, options.offset_by
            data = Rssi.from_frame(
                somewhere, columns=columns, filler=filler, offset_by=offset_by, pool_by=options.pool_by, name=file.stem
            )
            return data, False
    return read(located(source), options, RSSI_FORMATS), True


def has_column(source: str, name: str) -> bool:
    """Return True if a source is a table that has a column of this name."""
    file = Path(source)
    return file.is_file() and file.suffix.lower() in SUFFIXES and name in read_table(file).columns


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
    position = torch.full((len(names), 3), torch.nan, dtype=torch.float64)
    for column, name in enumerate(names):
        if name in place:
            rssi[:, column] = data.rssi_dbm[:, place[name]]
            position[column] = data.receiver_position[place[name]]
    return replace(data, rssi_dbm=rssi, receiver_names=names, receiver_position=position)


def _of_spectra(locator: MatchedField, config: LocateConfig, source: str) -> Columns:
    if unused := given(config, TableSource):
        raise InputError(f"--{unused[0]} is for RSSI, and {config.model} locates by spectra")
    store, known = observed_spectra(source, reading(config), locator.grid, "locator")
    if known is not None and known.array is not None and known.array != locator.room.array:
        raise InputError(f"{source} has spectra of another array than those that {config.model} was fitted to")
    directions: list[Tensor] = []
    index = torch.arange(len(store)) if known is None else known.index
    posteriors: Iterable[Posterior] = map(locator.locate, _batches(store))
    if config.track is not None:
        posteriors = _tracked(posteriors, index.double(), config.track)

    def with_direction(posterior: Posterior) -> Posterior:
        directions.append(locator.direction(posterior))
        return posterior

    columns = _located(map(with_direction, posteriors), index, None if known is None else known.position)
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


def _times(source: str, data: Rssi) -> Tensor:
    """Return the times (n,) [s] of rows of RSSI: one second a row of the file without a column of times.

    Raises:
        InputError: A row without time.
    """
    if data.time is None:
        return data.index.double()
    missing = data.time.isnan()
    if bool(missing.any()):
        raise InputError(
            f"{source} row {int(data.index[missing][0])} (counted from 0) has no time [s] or date, which --track needs"
        )
    return data.time


def _tracked(posteriors: Iterable[Posterior], time: Tensor, speed_m_s: float) -> Iterator[Posterior]:
    """Yield the posteriors of a walk in groups, smoothed along it.

    Raises:
        InputError: A walk that is too long, or times or a speed that are none.
    """
    parts: list[Posterior] = []
    for part in posteriors:
        parts.append(part)
        if sum(some.log_weight.numel() for some in parts) > MAX_TRACKED:
            most = MAX_TRACKED // part.log_weight.shape[1]
            raise InputError(f"--track takes {most} rows with this locator; split SOURCE, or fit it with fewer --cells")
    whole = smoothed(Posterior.cat(parts), time, speed_m_s)
    for start in range(0, len(whole), BATCH_ROWS):
        rows = slice(start, start + BATCH_ROWS)
        position = whole.position if len(whole.position) == 1 else whole.position[rows]
        yield replace(whole, position=position, log_weight=whole.log_weight[rows])


def _located(posteriors: Iterable[Posterior], index: Tensor, truth: Tensor | None) -> Columns:
    """Return the columns of a table with the positions of observations, batch by batch."""
    parts = ((each.median, each.std, each.credible_radius(0.8), each.ambiguous) for each in posteriors)
    position, std, radius, ambiguous = (torch.cat(values) for values in zip(*parts, strict=True))
    columns: Columns = {"index": index}
    columns |= dict(zip(("x_m", "y_m", "z_m"), position.T, strict=True))
    columns |= dict(zip(("std_x_m", "std_y_m", "std_z_m"), std.T, strict=True))
    columns |= {"credible_radius_80_m": radius, "ambiguous": ambiguous}
    if truth is not None:
        columns |= dict(zip(("truth_x_m", "truth_y_m", "truth_z_m"), truth.T, strict=True))
        columns["position_error_m"] = (position - truth).norm(dim=1)
    return columns
