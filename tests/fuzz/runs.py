"""Runs as the page opens them, and sources that a model follows."""

import csv
import io
import json
import math
import random
import sys
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest import mock

import numpy as np
import torch
from PIL import Image

from fuzz.misuse import MAX_RSSI_DB, check_plausible, fitted, planes, rssi, rssi_model
from fuzz.mutate import mutated
from swiftwrf import (
    AngularGrid,
    FieldModel,
    InputError,
    RssiLocator,
    RssiModel,
    fit,
    load,
    rssi_room,
    simulated_room,
)
from swiftwrf.contrib.online import Follower
from swiftwrf.errors import MAX_LENGTH
from swiftwrf.models.geometry import Plane
from swiftwrf.runtime.durable import write_json
from tasks.aoa.room import in_plan
from tasks.command import run_command
from tasks.configs import AoaConfig, LocateConfig
from tasks.options import by_name
from tasks.page.maps import FloorPlan
from tasks.update import lines
from tasks.update.record import TABLE, FollowedView, Record, snapshot
from tasks.view.charts import around, picture, points
from tasks.view.rssi import MapSelection, RssiView
from tasks.view.sources import open_source

ERROR = "error: "


def run_of_locate(folder: Path) -> None:
    train, _ = rssi_room(n=60).split()
    RssiLocator(n_cells=200).fit(train).save(folder / "locator.safetensors")
    write_json(folder / "config.json", {"task": "locate", "config": by_name(LocateConfig(data="gone.csv"))})
    write_json(folder / "environment.json", {"input_sha256": {}})


def run_of_rssi(folder: Path) -> None:
    data = rssi()
    rssi_model().save(folder / "model.safetensors")
    write_json(folder / "config.json", {"task": "rssi", "config": {}})
    measured = {"measured_position": data.transmitter_position, "measured": data.rssi_dbm}
    arrays = {name: values.numpy() for name, values in (measured | {"receiver": data.receiver_position}).items()}
    np.savez(folder / "maps.npz", **arrays)
    FloorPlan.scaled(np.zeros((6, 8, 3), np.uint8), 2.0, (0, 6)).save(folder)


def run_of_aoa(folder: Path) -> None:
    model = fit(simulated_room(n=20, grid=AngularGrid.hemisphere(4, 8)), n_primitives=3)
    model.save(folder / "swiftwrf-mix1.safetensors")
    write_json(folder / "geometry-mix1.json", {"planes": [Plane((1.0, 0.0, 0.0), 6.0, -0.5, 1.0, 0.95, 6.1).to_json()]})
    write_json(folder / "config.json", {"task": "aoa", "config": by_name(AoaConfig(measured=(1.0,), data="gone"))})
    write_json(folder / "environment.json", {"input_sha256": {}})


def followed_run(folder: Path) -> None:
    data = rssi_room(n=66)
    write_json(folder / "config.json", {"task": "update"})
    follower, record = Follower(RssiModel().fit(data.subset(torch.arange(60)))), Record("source", " [dB]")
    for i in range(60, 66):
        record.append(folder, record.add(i, follower.step(data.subset(torch.tensor([i])))))


def show(folder: Path) -> None:
    """Open a run and compute what its page shows, with small maps and without files of the figures."""
    with mock.patch("swiftwrf.rssi.maps.CELLS", 9), mock.patch("tasks.page.figures.as_svg", return_value="<svg"):
        view = open_source(folder)
        if isinstance(view, FollowedView):
            snapshot(view, view.version)
        elif isinstance(view, RssiView):
            _show_rssi(view)
        else:
            for loaded in view.models:
                assert np.isfinite(view.predict(loaded, view.start).mean).all()
                for plane in loaded.planes:
                    in_plan(plane, *view.box)


def _show_rssi(view: RssiView) -> None:
    chart = view.map(view.heights[1])
    x, y = (float(line.mean()) for line in (chart.x, chart.y))
    assert np.isfinite(chart.mean).all()
    for kind in set(view.kinds) - {"expected error"}:
        selection = MapSelection(kind, 0, view.heights[1])
        view.coloured(selection)
        view.describe(selection, x, y)
    json.dumps([around(view.region), points(view.position)], allow_nan=False)
    if view.plan is not None:
        picture(Image.fromarray(view.plan.pixels), view.plan.corners)


# followed sources


def json_lines(model: FieldModel | RssiModel) -> bytes:
    """Return measurements for a model as JSON lines."""
    if isinstance(model, RssiModel):
        new = rssi().subset(torch.arange(30, 33))
        values = [dict(zip(new.receiver_names, row, strict=True)) for row in new.rssi_dbm.nan_to_num(-90).tolist()]
        rows = list(zip(new.transmitter_position.tolist(), values, strict=True))
    else:
        room = simulated_room(n=3, grid=model.grid, seed=1)
        rows = list(zip(room.position.tolist(), room.store[:].tolist(), strict=True))
    name = "rssi_dbm" if isinstance(model, RssiModel) else "spectrum"
    return b"".join(json.dumps({"position": place, name: value}).encode() + b"\n" for place, value in rows)


def table() -> bytes:
    """Return rows of RSSI as a table."""
    header = ",".join(["x", "y", "z", *rssi().receiver_names])
    return "\n".join([header, *(f"{x},2,1,-60,-{61 + x},-70" for x in range(3)), ""]).encode()


def interrupt(seconds: float) -> None:
    """Stop a command in the place where it waits for more lines."""
    raise KeyboardInterrupt


def follow(
    model: Path,
    source: Path | str = "-",
    content: bytes = b"",
    out: Path | None = None,
    options: tuple[str, ...] = (),
    stop: Callable[[float], None] = interrupt,
) -> tuple[int, list[dict[str, Any]], str]:
    """Follow standard input, or a file to its present end. Return the exit code, the answers and the messages."""
    answers, messages = io.StringIO(), io.StringIO()
    arguments = [str(model), str(source), "--follow", "--out", str(out or model.with_name("out")), *options]
    with (
        mock.patch.object(sys, "stdin", io.TextIOWrapper(io.BytesIO(content))),
        mock.patch.object(lines, "time", SimpleNamespace(sleep=stop)),
        redirect_stdout(answers),
        redirect_stderr(messages),
    ):
        code = run_command("update", arguments, "swiftwrf update")
    return code, [json.loads(line) for line in answers.getvalue().splitlines()], messages.getvalue()


def followed(model: FieldModel | RssiModel, content: bytes, folder: Path, source: str = "-") -> None:
    """Follow a source and check that each line is learnt once and plausibly, or reported in one sentence.

    Raises:
        InputError: The first sentence, if a line was reported.
        AssertionError: A line that was lost, doubled or learnt although it is implausible.
    """
    file, out = folder / "model", folder / "out"
    model.save(file)
    n_lines = sum(bool(line.strip()) for line in content.split(b"\n"))
    if source != "-":
        (folder / source).write_bytes(content)
        n_lines = sum(bool(line.strip()) for line in content.split(b"\n")[:-1])  # the last line may grow
        n_lines -= source.endswith(".csv") and n_lines > 0
    with (
        mock.patch("tasks.update.run.environment", return_value={}),  # asks git
        mock.patch("tasks.page.page.as_svg", return_value="<svg></svg>"),
    ):
        code, learnt, messages = follow(file, source if source == "-" else folder / source, content)
    errors = [line for line in messages.splitlines() if not line.startswith("note: ")]
    assert all(len(line) <= MAX_LENGTH + len(ERROR) for line in messages.splitlines())
    assert all(line.startswith(ERROR) and len(line) <= MAX_LENGTH + len(ERROR) for line in errors), errors
    if code == 2 and len(errors) == 1 and not learnt:
        raise InputError(errors[0])
    assert code in (0, 130)
    assert len(learnt) + len(errors) == n_lines, f"{len(learnt)} learnt and {len(errors)} reported of {n_lines}"
    rows = list(csv.DictReader((out / TABLE).open(newline=""))) if learnt else []
    assert [int(row["index"]) for row in rows] == list(range(len(learnt)))
    assert json.loads((out / "update.json").read_text())["measurements"] == len(learnt)
    for found in learnt:
        names = ("predicted", "observed", "low", "high") if isinstance(model, RssiModel) else ()
        values = [value for name in names for value in found[name].values() if value is not None]
        assert all(abs(value) <= MAX_RSSI_DB for value in values), found
        assert all(abs(value) <= 1e9 for value in found["position"]), found
        assert found["error"] is None or math.isfinite(found["error"])
    if learnt:
        check_plausible(load(out / "model.safetensors"))
    if errors:
        raise InputError(errors[0])


def followed_lines(name: str, draw: random.Random, folder: Path) -> None:
    """Follow mutated JSON lines over standard input."""
    model = {"rssi": rssi_model, "geometry": planes}.get(name, lambda: fitted(name))()
    followed(model, mutated(json_lines(model), draw, words_only=draw.random() < 0.5), folder)


def followed_file(source: str, draw: random.Random, folder: Path) -> None:
    """Follow a mutated file of JSON lines or rows to its end."""
    content = table() if source.endswith(".csv") else json_lines(rssi_model())
    followed(rssi_model(), mutated(content, draw), folder, source)
