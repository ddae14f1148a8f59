"""Reader of survey tables: positions and RSSI in CSV or Parquet, one column a receiver (wide) or one row a packet (long)."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from swiftwrf.data.files import digests, lines_before_header
from swiftwrf.data.formats.base import RSSI_FORMATS, Format, ReadOptions
from swiftwrf.data.formats.captures import holds_captures
from swiftwrf.data.formats.nerf2_rssi import FILES as NERF2_FILES
from swiftwrf.data.groups import Groups
from swiftwrf.data.receivers import read_receivers
from swiftwrf.data.rssi import Rssi
from swiftwrf.data.splits import kept_splits, read_splits
from swiftwrf.data.survey import SEPARATORS, SUFFIXES, SurveyOptions, read_frame, read_survey
from swiftwrf.errors import InputError

RECEIVERS = "receivers.csv"  # beside the table: receiver,x,y,z


@RSSI_FORMATS.register("survey")
class SurveyTable(Format[Rssi]):
    """Table of a walk test; positions of receivers are unknown unless receivers.csv beside it contains them."""

    takes = frozenset({"columns", "filler", "coordinates", "offset_by", "transmitter", "pool_by"})

    def recognises(self, path: Path) -> bool:
        return bool(_tables(path))

    def read(self, path: Path, options: ReadOptions) -> Rssi:
        tables = _tables(path)
        if len(tables) > 1:
            raise InputError(
                f"{path} holds {len(tables)} tables ({', '.join(file.name for file in tables)}); name the one to read"
            )
        file, receivers = tables[0], tables[0].with_name(RECEIVERS)
        stated = SurveyOptions(
            options.columns,
            options.filler,
            options.coordinates,
            options.offset_by,
            options.transmitter,
            options.pool_by,
        )
        survey = read_survey(file, read_frame(file), stated)
        known: Tensor | None = None
        unknown: list[str] = []
        if survey.receiver_position is not None:
            places = [survey.receiver_position[name] for name in survey.receiver_names]
            known = torch.tensor(places, dtype=torch.float64)
        elif receivers.is_file():
            known, unknown = read_receivers(receivers, survey.receiver_names, survey.origin)
        if survey.receiver_moves and (known is None or unknown):
            raise InputError(
                f"{file}: column {options.transmitter[0]} has names of positions, so {RECEIVERS} beside it must contain "
                "each of them"
            )
        skipped = file.suffix.lower() == ".csv" and lines_before_header(file, SEPARATORS)
        notes = [f"lines before the header are skipped: {skipped}"] * bool(skipped)
        splits = read_splits(file.parent, survey.n_rows, first=0)
        return Rssi(
            survey.rssi_dbm,
            survey.position,
            name=file.stem,
            receiver_names=survey.receiver_names,
            receiver_position=known,
            origin=survey.origin,
            groups=Groups.of(options.offset_by, survey.group) if options.offset_by else None,
            labels=survey.labels,
            floors=survey.floors,
            receiver_moves=survey.receiver_moves,
            session=survey.session,
            time=survey.time,
            index=survey.row,
            named_splits=kept_splits(splits, torch.from_numpy(survey.row), survey.n_rows),
            source=digests([file, *([receivers] if receivers.is_file() else [])], file.parent),
            notes=(*notes, *survey.notes, *unknown),
        )


def _tables(path: Path) -> list[Path]:
    if holds_captures(path):
        return []
    if path.is_file():
        return [path] if path.suffix.lower() in SUFFIXES else []
    if any((path / name).is_file() for name in NERF2_FILES):
        return []
    return sorted(file for file in path.iterdir() if file.suffix.lower() in SUFFIXES and file.name != RECEIVERS)
