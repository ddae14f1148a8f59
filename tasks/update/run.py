"""Update a fitted model with new measurements, from files or line by line."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import torch

from swiftwrf import FieldModel, InputError, Rssi, Spectra, load
from swiftwrf.contrib.comparison.steps import MODEL, check_unchanged
from swiftwrf.contrib.online import Follower
from swiftwrf.data import ReadOptions
from swiftwrf.data.files import sha256
from swiftwrf.data.formats import RSSI_FORMATS, SNAPSHOT_FORMATS, SPECTRA_FORMATS
from swiftwrf.errors import one_line, with_article
from swiftwrf.models.base import ALREADY_LEARNT
from swiftwrf.models.prediction import difference_unit
from swiftwrf.rssi import RssiModel
from swiftwrf.runtime import checkpoint
from swiftwrf.runtime.durable import write_json
from tasks.configs import TABLE_SUFFIX, UpdateConfig
from tasks.directory import Claim, begun, model_file, new_directory
from tasks.environment import environment, invocation
from tasks.options import by_name
from tasks.page.page import REPORT, write_page
from tasks.records import CONFIG, ENVIRONMENT, read_json
from tasks.source import aligned, reading, with_groups
from tasks.terminal import console, terminal
from tasks.update.lines import OF_ROWS, answer, check_source, lines, measurement
from tasks.update.record import SUMMARY, Record, next_step, page

WAITING = "waiting"  # tensor of the spectra that a geometry has not learnt yet


def run(config: UpdateConfig) -> None:
    """Write the updated model, a table of the measurements and a page; with --follow, the model after each line.

    Raises:
        InputError: No such model, measurements that cannot be read or do not fit it, or none that it has not learnt.
    """
    if config.follow:
        follow(config)
        return
    with new_directory(Path(config.out), "an update") as folder:
        model = _model(config.model)
        new, train = _read(config, config.source, model), _training(config, model)
        if n_known := int((known := model.is_learnt(new)).sum()):
            said = f"{new.name}: {n_known} of {len(new)} rows {ALREADY_LEARNT}"
            if n_known == len(new):
                raise InputError(f"{said}; give others")
            console.print(said)
            new = new.subset(~known)
        follower = Follower(model, train, config.false_alarm_rate)
        record = Record(config.source, _unit(model))
        for i, index in enumerate(new.index.tolist()):
            record.add(index, follower.step(new.subset(torch.tensor([i]))))
        _save(follower, folder / MODEL)
        record.write(folder)
        _write_config(config, folder)
        write_page(folder, page(record, new.name, Path(config.out)))
    sentences = record.sentences()
    if follower.waiting is not None:
        sentences.append(
            f"The last {len(follower.waiting)} spectra are not learnt: a room is refined at every 10 positions."
        )
    lines = [*sentences, "", str(next_step(Path(config.out)))]
    terminal.page(record.summary(), "\n".join(lines), Path(config.out) / REPORT)


def follow(config: UpdateConfig) -> None:
    """Record each line, replace the model, then print the answer: what was answered is learnt, whatever ends the run."""
    if terminal.options.open or terminal.options.json:
        raise InputError("--follow prints JSON lines and writes no page; leave out --open and --json")
    options, taken = ReadOptions(), tuple[str, ...]()
    if config.source != "-":
        options, taken = (
            reading(config, config.source).options,
            OF_ROWS if config.source.lower().endswith(TABLE_SUFFIX) else (),
        )
    for name in options.given if config.read is None or config.data is None else ():
        if name not in taken:
            raise InputError(f"{name} is no option of reading a followed source; leave it out")
    digests = {"model": sha256(Path(config.model))}
    model, rate = _model(config.model), config.false_alarm_rate
    check_source(config.source, model)
    if (train := _training(config, model)) is not None:
        digests |= train.source
    with _followed(Path(config.out), digests) as folder:
        file = folder / MODEL
        follower, place = _continued(file, rate) if file.exists() else (Follower(model, train, rate), (0, ""))
        record = Record(config.source, _unit(model))
        if (folder / SUMMARY).exists():
            record = Record.read(folder, follower.count)
        record.write(folder)
        _write_config(config, folder)
        left_out, is_noted = set[str](), False
        for line in lines(config.source, *place):
            before = follower.model
            try:
                new = before.aligned(measurement(line, options, before, left_out))  # type: ignore[arg-type]  # of the model's kind
                step = follower.step(new)
            except InputError as error:  # one bad line does not end a run of days
                console.print(f"error: {error}", markup=False, soft_wrap=True)
                continue
            if left_out and not is_noted:
                is_noted = True
                note = f"note: receivers that the model does not have are left out, e.g. {min(left_out)}"
                console.print(one_line(note), markup=False, soft_wrap=True)
            index = follower.count - 1
            record.append(folder, record.add(index, step))
            _save(follower, file, line.end, line.sha256)
            print(answer(index, new, before, step), flush=True)


@contextmanager
def _followed(folder: Path, digests: dict[str, str]) -> Iterator[Path]:
    """Claim a new or empty directory, or that of a followed run which began with the same model and training data.

    Raises:
        InputError: The directory holds something else, or another process works in it.
    """
    is_continued = (folder / ENVIRONMENT).exists() and (folder / SUMMARY).exists()  # other updates have no environment
    if is_continued:
        check_unchanged(folder, read_json(folder / ENVIRONMENT).get("input_sha256"), digests)
    elif folder.exists() and (not folder.is_dir() or begun(folder)):
        raise InputError(f"{folder} exists already and holds no run of update --follow; choose another --out")
    claim = Claim(folder, new=not is_continued)
    try:
        if not is_continued:
            write_json(folder / ENVIRONMENT, environment(torch.device("cpu"), digests))
        yield folder
    finally:
        claim.release()


def _continued(file: Path, false_alarm_rate: float) -> tuple[Follower, tuple[int, str]]:
    """Return the follower in a file, and the place in its source: number and SHA-256 of the bytes that it learnt."""
    follower = Follower(_model(str(file)), None, false_alarm_rate)
    _, tensors, header = checkpoint.read(file, follower.model.kind)
    with checkpoint.refusing(f"{file} is no model that a followed source continues"):
        follower.resume(json.loads(header["provenance"]["followed"]))
        if WAITING in tensors and isinstance(follower.model, FieldModel):
            follower.waiting = Spectra(
                tensors[WAITING], tensors[f"{WAITING}_position"], grid=follower.model.grid, **vars(follower.model.link)
            )
        end, digest = json.loads(header["provenance"]["place"])
        return follower, (int(end), str(digest))


def _save(follower: Follower, file: Path, end: int = 0, digest: str = "") -> None:
    """Write the model, the state of its tests, the spectra that wait, and the place in its source."""
    tensors, header = follower.model.state()
    if follower.waiting is not None:
        tensors |= {WAITING: follower.waiting.store[:], f"{WAITING}_position": follower.waiting.position}
    provenance = {"followed": json.dumps(follower.state()), "place": json.dumps([end, digest])}
    checkpoint.write(file, follower.model.kind, tensors, header | {"provenance": provenance})


def _write_config(config: UpdateConfig, folder: Path) -> None:
    write_json(folder / CONFIG, {"task": "update", "command": invocation("update"), "config": by_name(config)})


def _unit(model: FieldModel | RssiModel) -> str:
    return difference_unit(model.unit) if isinstance(model, RssiModel) else ""


def _model(path: str) -> FieldModel | RssiModel:
    model = load(model_file(Path(path)))
    if isinstance(model, RssiModel) or (isinstance(model, FieldModel) and model.updates):
        return model
    raise InputError(
        f"{path} holds {with_article(model.kind)}, which cannot be updated; fit it again to all measurements"
    )


def _training(config: UpdateConfig, model: FieldModel | RssiModel) -> Spectra | Rssi | None:
    return None if config.data is None else _read(config, config.data, model)


def _read(config: UpdateConfig, source: str, model: FieldModel | RssiModel) -> Spectra | Rssi:
    """Return measurements of the kind that a model predicts, of a folder, file or public data set."""
    how = reading(config, source)
    if how.note:
        console.print(how.note)
    if isinstance(model, RssiModel):
        return model.aligned(aligned(with_groups(how, model.offsets).read(RSSI_FORMATS), model, ignore_others=True))
    data = how.read(SPECTRA_FORMATS, SNAPSHOT_FORMATS)
    return model.aligned(how.using(grid=model.grid).options.spectra_of(data))
