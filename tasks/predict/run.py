"""A saved model applied to new measurements or positions; the answers as a table."""

from __future__ import annotations

from os.path import isfile  # unlike Path.is_file, it is False for names that are too long
from pathlib import Path

from augment.estimators import SavedEstimator
from swiftwrf import FieldModel, InputError, load
from swiftwrf.data.coordinates import PlanFrame
from swiftwrf.data.receivers import read_places
from swiftwrf.errors import with_article
from swiftwrf.locate import MatchedField, RssiLocator
from swiftwrf.rssi.base import RssiPredictor
from tasks.aoa.page.records import AoaRecords, FractionRecords
from tasks.claim import CONFIG, model_file
from tasks.convert.outputs import write_file
from tasks.directory import check_new_file
from tasks.environment import stamp
from tasks.options import given
from tasks.page.records import Records
from tasks.predict.observations import directions, positions_of_rssi, positions_of_spectra
from tasks.predict.options import PredictConfig
from tasks.records import Row, rounded, write_table
from tasks.terminal import console, terminal

MEDIANS = {"great_circle_deg": "degrees", "position_error_m": "m"}  # columns of errors and their units


def run(config: PredictConfig) -> None:
    """Write one row for each measurement or position, with truth and error where they are known.

    Raises:
        InputError: No model, a source that cannot be read or is not like what the model was fitted to, options that do not
            apply to the model, or `out` exists.
    """
    out = Path(config.out or f"predicted-{stamp()}.csv")
    check_new_file(out, "--out ")
    file = saved_file(Path(config.model))
    model = load(file)
    read = (
        None
        if isinstance(model, FieldModel | RssiPredictor)
        else "RSSI"
        if isinstance(model, RssiLocator)
        else "spectra"
    )
    for kinds, options in (("RSSI", config.table), ("spectra", config.spectra)):
        if kinds != read and (unused := given(options)):
            raise InputError(f"--{unused[0]} is for reading {kinds}, and {file} holds {with_article(model.kind)}")
    if config.track is not None and not isinstance(model, RssiLocator | MatchedField):
        raise InputError(
            f"--track smooths positions, and {file} holds {with_article(model.kind)}, which locates nothing"
        )
    if isinstance(model, FieldModel | RssiPredictor):
        origin = model.origin if isinstance(model, RssiPredictor) else None
        frame = PlanFrame(config.table.scale, config.table.y_down, config.table.up)
        prediction = model.predict(read_places(Path(config.source), origin, frame))
        terminal.page({"table": str(out)}, f"{write_file(prediction, out)}: {out}")
        return
    if isinstance(model, RssiLocator):
        columns = positions_of_rssi(model, config)
    elif isinstance(model, MatchedField):
        columns = positions_of_spectra(model, config)
    elif isinstance(model, SavedEstimator):
        columns = directions(model, config)
    else:
        raise InputError(
            f"{file} holds {with_article(model.kind)}, which no command applies; load it with swiftwrf.load in Python"
        )
    rows = zip(*(column.tolist() for column in columns.values()), strict=True)
    write_table(out, rounded(dict(zip(columns, row, strict=True)) for row in rows))
    values: Row = {"n": len(columns["index"]), "table": str(out)}
    values |= {f"median_{name}": float(columns[name].median()) for name in MEDIANS if name in columns}
    errors = " and ".join(f"{values[f'median_{name}']:.2f} {MEDIANS[name]}" for name in MEDIANS if name in columns)
    what = "positions" if "x_m" in columns else "directions"
    said = f", median error {errors}, too low if these rows trained the model" if errors else ""
    terminal.page(values, f"{values['n']} {what}{said}: {out}")


def saved_file(model: Path) -> Path:
    """Return the file of a model: the given one, or the one that a run's directory recommends.

    Raises:
        InputError: A run that recommends no file.
    """
    if not isfile(model / CONFIG):
        return model
    if kept := model_file(model):
        return kept
    records: AoaRecords = Records(model)
    fractions = FractionRecords.of(records) if "mixes" in records.metrics else []
    chosen = max(fractions, key=lambda fraction: float(fraction.key)).chosen_file if fractions else None
    if chosen is None:
        raise InputError(f"{model} is a run whose choice has no file; name one of its models, {model}/....safetensors")
    console.print(f"applied: {chosen}")
    return chosen
