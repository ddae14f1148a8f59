"""Reader of survey tables: positions and RSSI in CSV or Parquet, one column a receiver (wide) or one row a packet (long)."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from swiftwrf.data.files import SUFFIXES, digests, lines_before_header, read_table
from swiftwrf.data.formats.base import RSSI_FORMATS, Format, ReadOptions
from swiftwrf.data.formats.captures import holds_captures
from swiftwrf.data.formats.nerf2_rssi import FILES as NERF2_FILES
from swiftwrf.data.rssi import Rssi
from swiftwrf.data.splits import kept_splits, read_splits
from swiftwrf.data.survey import read_receivers, read_survey
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
        table = read_table(file)
        data = Rssi(**read_survey(file, table, **options.given), name=file.stem)
        known, unknown = data.receiver_position, list[str]()
        if receivers.is_file() and not data.located:
            known, unknown = read_receivers(receivers, data.receiver_names, data.origin)
        if data.receiver_moves and (bool(known.isnan().all()) or unknown):
            raise InputError(
                f"{file}: column {options.transmitter[0]} has names of positions, so {RECEIVERS} beside it must contain "
                "each of them"
            )
        skipped = file.suffix.lower() == ".csv" and lines_before_header(file)
        notes = [f"lines before the header are skipped: {skipped}"] * bool(skipped)
        splits = read_splits(file.parent, len(table), first=0)
        return replace(
            data,
            receiver_position=known,
            named_splits=kept_splits(splits, data.index, len(table)),
            source=digests([file, *([receivers] if receivers.is_file() else [])], file.parent),
            notes=(*notes, *data.notes, *unknown),
        )


def _tables(path: Path) -> list[Path]:
    if holds_captures(path):
        return []
    if path.is_file():
        return [path] if path.suffix.lower() in SUFFIXES else []
    if any((path / name).is_file() for name in NERF2_FILES):
        return []
    return sorted(file for file in path.iterdir() if file.suffix.lower() in SUFFIXES and file.name != RECEIVERS)
