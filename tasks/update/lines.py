"""Measurements as JSON lines: reading them as they come, and the answer to each."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import torch

from swiftwrf import FieldModel, InputError, Rssi, Spectra
from swiftwrf.data.survey import SurveyOptions, frame_of, read_survey
from swiftwrf.online import Step
from swiftwrf.online.prequential import LEVEL
from swiftwrf.rssi import RssiModel
from tasks.records import strict
from tasks.update.options import UpdateConfig

POLL_S = 0.2  # between two looks at a file that grows


def lines(source: str) -> Iterator[str]:
    """Yield the complete lines of standard input (-), to its end, or of a file, for as long as it may grow."""
    if source == "-":
        yield from sys.stdin
        return
    with Path(source).open(encoding="utf-8") as file:
        part = ""
        while True:
            part += file.readline()
            if part.endswith("\n"):
                yield part
                part = ""
            else:
                time.sleep(POLL_S)


def measurements(config: UpdateConfig, model: FieldModel | RssiModel) -> Iterator[Callable[..., Rssi | Spectra]]:
    """Yield a reader of each measurement of a followed source, a function of its number and the model.

    Raises:
        InputError: A table, but a model that predicts no RSSI.
    """
    found = (line for line in lines(config.source) if line.strip())
    if Path(config.source).suffix.lower() != ".csv":
        yield from (partial(measurement, line) for line in found)
        return
    if not isinstance(model, RssiModel):
        raise InputError(f"{config.source} is a table, but the model predicts spectra; give JSON lines")
    header, stated = next(found, ""), SurveyOptions(config.column_names, config.fillers, config.coordinates)
    yield from (partial(table_row, header, line, stated) for line in found)


def table_row(header: str, line: str, options: SurveyOptions, number: int, model: RssiModel) -> Rssi:
    """Return the measurement in a row of a survey table; receivers that the model does not have are left out.

    Raises:
        InputError: A row without position, or without RSSI at a receiver of the model.
    """
    label = f"row {number}"
    survey = read_survey(label, frame_of(label, header + line), options)
    rssi = zip(survey.receiver_names, survey.rssi_dbm[0].tolist(), strict=True)
    value = {name: x for name, x in rssi if name in model.receiver_names}
    if not value:
        raise InputError(f"{label}: no receiver of the model detected the transmitter")
    data = Rssi(
        torch.tensor([list(value.values())]), survey.position, receiver_names=tuple(value), origin=survey.origin
    )
    return _rssi(data.about(model.origin).transmitter_position.tolist(), value, model)


def measurement(line: str, number: int, model: FieldModel | RssiModel) -> Rssi | Spectra:
    """Return the measurement in a line, of the kind that the model predicts.

    Raises:
        InputError: No JSON object, or other values than the model needs.
    """
    needed = "rssi_dbm" if isinstance(model, RssiModel) else "spectrum"
    try:
        content = json.loads(line)
        position, value = [[float(x) for x in content["position"]]], content[needed]
        if isinstance(model, RssiModel):
            return _rssi(position, value, model)
        return Spectra([value], position, grid=model.grid, name=f"line {number}", **vars(model.link))
    except InputError as error:
        raise InputError(f"line {number}: {error}") from None
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise InputError(
            f"line {number} is no JSON object with position and {needed} ({type(error).__name__}: {error}); mend it"
        ) from None


def _rssi(position: list[list[float]], value: dict[str, float | None], model: RssiModel) -> Rssi:
    """Return a row at the receivers of the model; those that the line does not name count as not detecting."""
    if unknown := sorted(value.keys() - set(model.receiver_names)):
        raise InputError(f"the model has no receiver {unknown[0]!r}; leave it out")
    row = [value.get(name) for name in model.receiver_names]
    return Rssi(
        [[torch.nan if x is None else float(x) for x in row]],
        position,
        receiver_names=model.receiver_names,
        origin=model.origin,
    )


def answer(number: int, new: Rssi | Spectra, before: FieldModel | RssiModel, step: Step) -> str:
    """Return the answer to a line: what was predicted and observed, the interval, and alarms, as JSON.

    Args:
        number: Number of the measurement, counted from 1.
        new: The measurement.
        before: Model that had not learnt it.
        step: Its scores.
    """
    found: dict[str, Any] = {"measurement": number, "position": step.scores.position[0]}
    if isinstance(new, Rssi):
        assert isinstance(before, RssiModel)
        predicted = before.predict(new.transmitter_position)
        low, high = predicted.interval(LEVEL)
        columns = {"predicted": predicted.mean, "observed": new.rssi_dbm, "low": low, "high": high}
        found |= {
            name: dict(zip(before.receiver_names, [round(x, 2) for x in values[0].tolist()], strict=True))
            for name, values in columns.items()
        }
    else:
        assert isinstance(before, FieldModel)
        mean = before.synthesize(new.position)
        for name, spectrum in (("predicted", mean), ("observed", new.store[:])):
            direction = new.grid.peak_direction(spectrum).rad2deg()[0]
            found[f"{name}_peak_deg"] = [round(x, 1) for x in direction.tolist()]
        found["covered"] = float(step.scores.covered[0])
    found |= {"error": round(float(step.scores.error[0]), 5), "alarm": "; ".join(step.alarms) or None}
    if step.notice:
        found["notice"] = step.notice
    if step.correlation is not None:
        found["correlation"] = step.correlation
    return json.dumps(strict(found), allow_nan=False, ensure_ascii=False)
