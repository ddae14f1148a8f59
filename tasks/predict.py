"""A saved model applied to new measurements or positions; the answers as a table."""

from __future__ import annotations

from contextlib import suppress
from os.path import isfile  # unlike Path.is_file, it is False for names that are too long
from pathlib import Path

import numpy as np
from pandas import DataFrame

from augment.estimators import Estimator
from swiftwrf import FieldModel, InputError, Prediction, Rssi, load, predict
from swiftwrf.data.coordinates import PlanFrame
from swiftwrf.data.files import read_table
from swiftwrf.data.formats import RSSI_FORMATS
from swiftwrf.data.formats.stations import read_stations
from swiftwrf.data.receivers import read_places
from swiftwrf.data.survey import has_positions
from swiftwrf.errors import with_article
from swiftwrf.locate import MatchedField, RssiLocator
from swiftwrf.metrics import LEVEL
from swiftwrf.models.prediction import suffix
from swiftwrf.positions import inside
from swiftwrf.rssi.base import RssiPredictor
from tasks.aoa.records import FractionRecords
from tasks.command import run_module
from tasks.configs import PredictConfig
from tasks.convert import write_file
from tasks.directory import check_new_file, kept_model
from tasks.environment import stamp
from tasks.records import CONFIG, Records, Row, rounded, write_table
from tasks.source import Reading, aligned, is_table, observed_spectra, reading, rooms_beside, with_groups
from tasks.terminal import console, terminal

PLAN = ("scale", "y_down", "up")  # options of reading a table of positions
MAX_SHOWN = 20  # rows of a table on the terminal
MEDIANS = {"great_circle_deg": "degrees", "position_error_m": "m"}  # columns of errors and their units


def run(config: PredictConfig) -> None:
    """Write one row for each measurement or position, with truth and error where they are known.

    Raises:
        InputError: No model, a source that cannot be read or is not like what the model was fitted to, options that do not
            apply to the model, or `out` exists.
    """
    out = Path(config.out or f"predicted-{stamp()}.csv")
    check_new_file(out, (".csv", ".mat"), "--out ")
    file = saved_file(Path(config.model))
    model = load(file)
    at_positions = isinstance(model, FieldModel | RssiPredictor)
    check_new_file(out, (".csv", ".mat") if at_positions else (".csv",), "--out ")
    how = reading(config, config.source)
    for name in how.options.given if at_positions else ():
        if name not in PLAN:
            raise InputError(f"{how.file} states {name}, which does not apply to positions; leave it out")
    if how.note:
        console.print(how.note)
    if config.rooms is not None and not isinstance(model, RssiLocator | MatchedField):
        raise InputError(f"--rooms is for locators, and {file} holds {with_article(model.kind)}; leave it out")
    if isinstance(model, FieldModel | RssiPredictor):
        origin, floors = None, None
        if isinstance(model, RssiPredictor):
            origin, floors = model.origin, model.attenuation and model.attenuation.floors
        frame = PlanFrame(**{name: getattr(how.options, name) for name in PLAN})
        position = read_places(Path(how.source), origin, frame, floors)
        prediction = predict(model, position, track=config.track)
        assert isinstance(prediction, Prediction)
        if out.suffix.lower() == ".mat":
            terminal.page({"table": str(out)}, f"{write_file(prediction, out)}: {out}")
            return
        table = prediction.to_frame()
        if isinstance(model, RssiPredictor):
            table = with_intervals(table, model, prediction)
        write_table(out, rounded(table.to_dict("records")))
        few, text = len(position) <= MAX_SHOWN < len(table), ""
        if few and isinstance(model, RssiPredictor):
            strongest = prediction.mean.argmax(dim=1).numpy() + np.arange(len(position)) * len(model.receiver_names)
            text = f"strongest receiver at each position:\n{shown(table.iloc[strongest])}"
        terminal.page({"table": str(out)}, f"{text or shown(table)}{len(table)} rows: {out}")
        return
    if isinstance(model, RssiLocator):
        data, is_known = read_rssi(with_groups(how, model.model.offsets))
        data = aligned(data, model.model, config.ignore_receivers)
        if silent := int((~data.detected.any(dim=1)).sum()):
            console.print(f"{data.name}: rows that no receiver detected are left out: {silent}")
        rooms = rooms_beside(how, config.rooms, model.model.origin, model.region.floors)
        table = predict(model, data, track=config.track, truth=is_known, rooms=rooms)
    elif isinstance(model, MatchedField) and len(model.stations) > 1:
        data_of_all = read_stations(Path(how.source), how.options)
        rooms = rooms_beside(how, config.rooms, None, None)
        table = predict(model, data_of_all, track=config.track, rooms=rooms)
    elif isinstance(model, MatchedField | Estimator):
        kind = "locator" if isinstance(model, MatchedField) else "estimator"
        store, known = observed_spectra(how, model.grid, kind)
        rooms = rooms_beside(how, config.rooms, None, None) if isinstance(model, MatchedField) else None
        table = predict(model, store if known is None else known, track=config.track, rooms=rooms)
    else:
        raise InputError(
            f"{file} holds {with_article(model.kind)}, which no command applies; load it with swiftwrf.load in Python"
        )
    assert isinstance(table, DataFrame)  # as for all models that take measurements
    write_table(out, rounded(table.to_dict("records")))
    values: Row = {"n": len(table), "table": str(out)}
    values |= {f"median_{name}": float(table[name].median()) for name in MEDIANS if name in table}
    errors = " and ".join(f"{values[f'median_{name}']:.3g} {MEDIANS[name]}" for name in MEDIANS if name in table)
    what = "positions" if "x_m" in table else "directions"
    said = f", median error {errors}, too low if these rows trained the model" if errors else ""
    terminal.page(values, f"{shown(table)}{values['n']} {what}{said}: {out}")


def with_intervals(table: DataFrame, model: RssiPredictor, prediction: Prediction) -> DataFrame:
    """Return a table of predictions with their intervals, the probability of a detection, and places that are outside.

    A place is outside if it is beyond the training positions in plan. Models without these positions have no such column.
    """
    position, unit = prediction.position, suffix(model.unit)
    assert position is not None
    if prediction.std is not None:
        low, high = prediction.interval(LEVEL)
        table = table.assign(**{f"low_{unit}": low.flatten().numpy(), f"high_{unit}": high.flatten().numpy()})
    table = table.assign(detection=model.predict_detection(position).flatten().numpy().round(3))
    with suppress(InputError):  # of a model without training positions
        outside = ~inside(position.numpy(), model.region().numpy())
        table = table.assign(outside=outside.repeat(len(model.receiver_names)))
    if model.unit != "dBm":  # of any size
        values = [name for name in table if str(name).endswith(f"_{unit}")]
        table[values] = table[values].map(lambda value: float(f"{value:.5g}"))
    return table


def shown(table: DataFrame) -> str:
    """Return a table of at most 20 rows as lines of text, otherwise an empty text.

    Example:
        >>> shown(DataFrame({"x_m": [1.23456]})).split()
        ['x_m', '1.235']
    """
    if len(table) > MAX_SHOWN:
        return ""
    text: str = DataFrame(rounded(table.to_dict("records"))).to_string(index=False)
    return f"{text}\n"


def saved_file(model: Path) -> Path:
    """Return the file of a model: the given one, or the one that a run's directory recommends.

    Raises:
        InputError: A run that recommends no file.
    """
    if not isfile(model / CONFIG):
        return model
    if kept := kept_model(model):
        return kept
    records = Records(model)
    fractions = FractionRecords.of(records) if "mixes" in records.metrics else []
    chosen = max(fractions, key=lambda fraction: float(fraction.key)).chosen_file if fractions else None
    if chosen is None:
        models = ", ".join(sorted(file.name for file in model.glob("*.safetensors"))) or "none"
        raise InputError(f"{model} is a run whose choice has no file; name one of its saved models: {models}")
    console.print(f"applied: {chosen}")
    return chosen


def read_rssi(how: Reading) -> tuple[Rssi, bool]:
    """Read RSSI, and return it with True if its positions are known. A survey table may have none.

    Raises:
        InputError: RSSI that cannot be read.
    """
    options = how.options
    if is_table(how.source):
        file = Path(how.source)
        frame = read_table(file)
        if not has_positions(frame, options.columns or {}):
            somewhere = frame.assign(x=0.0, y=0.0, z=0.0)
            names = ("columns", "filler", "offset_by", "pool_by", "window")
            data = Rssi.from_frame(somewhere, **{name: getattr(options, name) for name in names}, name=file.stem)
            return data, False
    return how.read(RSSI_FORMATS), True


if __name__ == "__main__":
    raise SystemExit(run_module("tasks.predict"))
