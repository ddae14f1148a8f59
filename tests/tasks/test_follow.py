"""The command `update`: its outputs, and with `--follow` directories that it continues, places in a source, bad lines."""

import csv
import json
import time
from dataclasses import replace
from functools import cache

import numpy as np
import pandas as pd
import pytest
import small
import torch
from fuzz.runs import follow
from scipy.spatial.distance import cdist
from scipy.stats import norm

from swiftwrf import AngularGrid, Rssi, RssiModel, load, load_rssi, make_model, rssi_room, simulated_room
from swiftwrf.contrib.online import Follower, Step
from swiftwrf.contrib.online.scores import Scores
from swiftwrf.data.writing import write_rssi
from swiftwrf.models.geometry import GeometryModel, Plane
from swiftwrf.rssi import estimate_offsets
from tasks.command import run_command
from tasks.update.lines import answer
from tasks.update.record import Record, map_plot, page


@cache
def floor():
    return rssi_room(n=60)


@cache
def rssi_model(n=40):
    return RssiModel().fit(floor().subset(torch.arange(n)))


def line(i, **changes):
    names = floor().receiver_names
    row = {name: x for name, x in zip(names, floor().rssi_dbm[i].tolist(), strict=True) if x == x}
    content = {"position": floor().transmitter_position[i].tolist(), "rssi_dbm": row} | changes
    return json.dumps(content).encode() + b"\n"


HEADER = b"x,y,z,receiver01,receiver02\n"
ROWS = [b"1,2,1,-60,-61\n", b"2,2,1,-61,-62\n", b"3,2,1,-62,-63\n", b"4,2,1,-63,-64\n", b"5,2,1,-64,-65\n"]


@pytest.fixture
def model(tmp_path):
    file = tmp_path / "model.safetensors"
    rssi_model().save(file)
    return file


def indices(folder):
    return [int(row["index"]) for row in csv.DictReader((folder / "measurements.csv").open(newline=""))]


def contents(folder):
    return {file.name: file.read_bytes() for file in folder.rglob("*") if file.is_file()}


def other_model(folder):
    rssi_model(30).save(folder / "other.safetensors")
    return folder / "other.safetensors"


# whose directory


def foreign(folder, name, files):
    (folder / name).mkdir()
    for file, content in files.items():
        (folder / name / file).write_text(content)
    return folder / name


@pytest.mark.parametrize(
    "files",
    [
        {"config.json": '{"task": "rssi", "config": {}}', "metrics.json": "{}"},
        {"config.json": '{"my": "website"}'},
        {"config.json": '{"task": "update", "config": {"follow": false}}', "report.html": ""},
        {"config.json": '{"task": "rssi"}', "environment.json": "{}"},
        {"config.json": "no JSON"},
        {"notes.txt": "mine"},
    ],
    ids=lambda files: " ".join(files),
)
def test_a_directory_of_something_else_is_refused_and_unchanged(model, tmp_path, files):
    folder = foreign(tmp_path, "taken", files)
    code, answers, said = follow(model, content=line(40), out=folder)
    assert (code, answers) == (2, [])
    assert said.startswith("error: ")
    assert said.count("\n") == 1
    assert "swiftwrf resume" not in said
    assert contents(folder) == {name: text.encode() for name, text in files.items()}


@pytest.mark.parametrize("change", ["other", "missing", "rewritten", "data"])
def test_a_run_goes_on_with_the_model_and_data_that_it_began_with(model, tmp_path, change):
    assert follow(model, content=line(40))[0] == 0
    before, options = contents(tmp_path / "out"), ()
    if change == "other":
        model = other_model(tmp_path)
    elif change == "missing":
        model.unlink()
    elif change == "rewritten":
        model.write_bytes(other_model(tmp_path).read_bytes())
    else:
        (tmp_path / "data").mkdir()
        write_rssi(floor().subset(torch.arange(40)), tmp_path / "data")
        options = ("--data", str(tmp_path / "data"))
    code, answers, said = follow(model, content=line(41), options=options)
    assert (code, answers, said.count("\n")) == (2, [], 1)
    assert ("is missing" if change == "missing" else "has changed since") in said
    assert contents(tmp_path / "out") == before


# where a source goes on


def observed(answers):
    return [round(answer["observed"]["receiver01"]) for answer in answers]


@pytest.mark.parametrize(
    ("after", "expected"),
    [
        (HEADER + b"".join(ROWS[:3]), []),
        (HEADER + b"".join(ROWS), [-63, -64]),
        (HEADER + b"".join(ROWS[2:]), [-62, -63, -64]),
        (HEADER + b"".join(ROWS[1:2]), [-61]),
        (HEADER + ROWS[1] + ROWS[0] + b"".join(ROWS[2:]), [-61, -60, -63, -64]),  # the third is already learnt
    ],
    ids=["unchanged", "grown", "rewritten", "truncated", "last line the same"],
)
@pytest.mark.parametrize("by", ["in place", "by name"])
@pytest.mark.parametrize("when", ["between two starts", "while it is followed"])
def test_a_source_goes_on_after_the_lines_learnt_or_begins_again(model, tmp_path, after, expected, by, when):
    source, changed = tmp_path / "rows.csv", []
    source.write_bytes(HEADER + b"".join(ROWS[:3]))

    def change(seconds=0.0):
        if changed:
            raise KeyboardInterrupt
        changed.append(True)
        if by == "by name":
            source.rename(tmp_path / "rows.csv.1")
        source.write_bytes(after)

    if when == "between two starts":
        answers = follow(model, source)[1]
        change()
        answers += follow(model, source)[1]
    else:
        answers = follow(model, source, stop=change)[1]
    assert observed(answers) == [-60, -61, -62, *expected]
    assert indices(tmp_path / "out") == list(range(3 + len(expected)))


# rows and spectra


def killed(*arguments):
    raise KeyboardInterrupt


def test_a_row_without_its_model_is_dropped(model, tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr("tasks.update.run._save", killed)
        code, answers, _ = follow(model, content=line(40))
        assert (code, answers) == (130, [])  # no answer to what is not learnt
    assert indices(tmp_path / "out") == [0]
    assert follow(model, content=line(41))[0] == 0
    assert indices(tmp_path / "out") == [0]
    assert json.loads((tmp_path / "out" / "update.json").read_text())["measurements"] == 1
    assert Record.read(tmp_path / "out").rows[0]["x_m"] == pytest.approx(float(floor().transmitter_position[41, 0]))


@cache
def room():
    return simulated_room(n=60, grid=AngularGrid.hemisphere(18, 72))


@cache
def geometry():
    return GeometryModel.of_planes(room().subset(torch.arange(40)), [small.FLOOR, Plane((1.0, 0.0, 0.0), 6.0, -0.5)])


def spectrum_lines(first, last):
    rows = room().subset(range(first, last))
    pairs = zip(rows.position.tolist(), rows.store[:].tolist(), strict=True)
    return b"".join(json.dumps({"position": at, "spectrum": values}).encode() + b"\n" for at, values in pairs)


def test_spectra_that_wait_are_learnt_by_the_next_start(tmp_path):
    file, learnt = tmp_path / "room.safetensors", tmp_path / "out" / "model.safetensors"
    geometry().save(file)
    assert len(follow(file, content=spectrum_lines(40, 45))[1]) == 5
    first = load(learnt)
    assert first.planes == load(file).planes
    assert [answer["measurement"] for answer in follow(file, content=spectrum_lines(45, 51))[1]] == list(range(5, 11))
    assert indices(tmp_path / "out") == list(range(11))
    follower = Follower(load(file))
    for i in range(40, 51):
        follower.step(room().subset(torch.tensor([i])))
    assert load(learnt).planes != first.planes
    found, expected = (model.tensors().offset for model in (load(learnt), follower.model))
    torch.testing.assert_close(found, expected, atol=1e-5, rtol=0)


def test_an_update_of_a_room_states_the_spectra_that_it_has_not_learnt(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("tasks.update.run._read", lambda *_: room().subset(torch.arange(40, 43)))
    geometry().save(tmp_path / "room.safetensors")
    options = [str(tmp_path / "room.safetensors"), "x", "--out", str(tmp_path / "out")]
    assert run_command("update", options, "swiftwrf update") == 0
    assert "3 spectra are not learnt" in capsys.readouterr().out


def test_an_update_by_the_rows_that_trained_the_model_learns_the_others(model, tmp_path, capsys):
    (tmp_path / "data").mkdir()
    write_rssi(floor(), tmp_path / "data")
    options = [str(model), str(tmp_path / "data"), "--out", str(tmp_path / "out")]
    assert run_command("update", options, "swiftwrf update") == 0
    said = capsys.readouterr()
    assert "data: 40 of 60 rows are already in the model and are left out" in said.err.replace("\n", " ")
    assert "20 measurements learnt" in said.out
    assert len(load(tmp_path / "out" / "model.safetensors").region()) == 60
    options[0], options[-1] = str(tmp_path / "out" / "model.safetensors"), str(tmp_path / "again")
    assert run_command("update", options, "swiftwrf update") == 2
    assert "data: 60 of 60 rows are already in the model and are left out; give others" in capsys.readouterr().err
    assert not (tmp_path / "again").exists()


# lines that are no measurements


BAD = [
    b"nonsense\n",
    b'{"position":[1,0,0],"note":"caf\xe9"}\n',
    b"\xff\xfe{\x00\n",
    line(41, position=[10**400, 0, 0]),
    line(41, position=[True, 0, 0]),
    line(41, position=["1", 0, 0]),
    line(41, rssi_dbm={"receiver01": True}),
    line(41, rssi_dbm={"receiver01": 10**400}),
    line(41, rssi_dbm={"nowhere\r\n": -60}),
    b"[" * 5000 + b"\n",
    b'{"position": [1, 2, 1], "rssi_dbm": {"receiver01": -60, "receiver01": -90}}\n',
    b'{"position": [1, 2, 1], "position": [9, 9, 1], "rssi_dbm": {"receiver01": -60}}\n',
]
FAR = [line(41, position=place) for place in ([8.5, 47.3, 400.0], [1e8, 2.0, 1.0])]  # in other units
WORDS = [
    *((bad, "error: line 2") for bad in BAD),
    *((far, "away from those that the model was fitted to") for far in FAR),
]


@pytest.mark.parametrize(("bad", "words"), WORDS, ids=lambda bad: str(bad[:40]))
def test_a_bad_line_is_reported_and_left_out(model, bad, words):
    code, answers, said = follow(model, content=line(40) + bad + line(42))
    assert (code, len(answers), said.count("error: ")) == (0, 2, 1)
    assert words in said
    assert said.count("\n") == 1


def test_receivers_that_appear_are_left_out_of_lines_as_of_rows_with_one_note(model, tmp_path):
    scans = [{"receiver01": -60.0, "receiver02": -61.0, f"new{n}": -40.0} for n in range(3)]
    content = b"".join(line(40 + n, rssi_dbm=scan) for n, scan in enumerate(scans))
    code, answers, said = follow(model, content=content + line(43, rssi_dbm={"Receiver01": -60.0}))
    assert (code, observed(answers)) == (0, [-60] * 4)  # a name counts in any spelling, as in a table
    assert said == "note: receivers that the model does not have are left out, e.g. new0\n"
    assert all(answer["observed"].keys() == answers[0]["observed"].keys() for answer in answers)
    (tmp_path / "rows.csv").write_bytes(b"x,y,z,receiver01,new\n1,2,1,-60,-40\n2,2,1,-61,-40\n")
    code, answers, said = follow(model, tmp_path / "rows.csv", out=tmp_path / "other")
    assert observed(answers) == [-60, -61]
    assert said == "note: receivers that the model does not have are left out, e.g. new\n"


def test_lines_that_a_model_has_learnt_are_reported_and_left_out(model, tmp_path):
    """Also those of a table that trained it."""
    code, answers, said = follow(model, content=line(40) + line(41), out=tmp_path / "a")
    assert (code, len(answers), said) == (0, 2, "")
    code, answers, said = follow(tmp_path / "a" / "model.safetensors", content=line(40) + line(42), out=tmp_path / "b")
    assert (code, len(answers)) == (0, 1)
    assert said.startswith("error: ")
    assert "row 0, counted from 0, is already in the model; leave it out" in said
    data = floor().subset(torch.arange(44))
    table = data.to_frame().rename(columns={"x_m": "x", "y_m": "y", "z_m": "z"})
    table.to_csv(tmp_path / "walk.csv", index=False)
    trained = RssiModel().fit(load_rssi(tmp_path / "walk.csv").subset(torch.arange(40)))
    trained.save(tmp_path / "trained.safetensors")
    _, answers, said = follow(tmp_path / "trained.safetensors", tmp_path / "walk.csv", out=tmp_path / "c")
    assert (len(answers), said.count("is already in the model")) == (4, 40)


def test_booleans_are_no_spectrum(tmp_path):
    make_model("gp").fit(room().subset(torch.arange(40))).save(tmp_path / "gp.safetensors")
    bad = json.dumps({"position": [1, 1, 1], "spectrum": [[True] * 72] * 18}).encode() + b"\n"
    code, answers, said = follow(tmp_path / "gp.safetensors", content=bad + spectrum_lines(41, 42))
    assert (code, len(answers)) == (0, 1)
    assert said.startswith("error: line 1")


def test_bad_rows_of_a_table_are_left_out(model, tmp_path):
    source = tmp_path / "rows.csv"
    rows = [ROWS[0], b"caf\xe9,2,1,-60,-61\n", b"1" * 401 + b",2,1,-60,-61\n", b"1,2,-60\n", ROWS[1]]
    source.write_bytes(b"\xef\xbb\xbf" + HEADER + b"".join(rows))
    _, answers, said = follow(model, source)
    assert observed(answers) == [-60, -61]
    assert [text.replace(":", "").split()[:3] for text in said.splitlines()] == [["error", "line", n] for n in "345"]


def test_rows_in_degrees_are_left_out_by_a_model_in_metres(model, tmp_path):
    source = tmp_path / "rows.csv"
    source.write_bytes(b"latitude,longitude,z,receiver01,receiver02\n47.3,8.5,1,-60,-61\n47.3001,8.5,1,-61,-62\n")
    _, answers, said = follow(model, source)
    assert not answers
    assert said.count("has positions in degrees, but the predictor was fitted to metres") == 2


@cache
def two_floors():
    """RSSI on two floors, heights counted from each; another phone reads 8 dB less."""
    draw = np.random.default_rng(0)
    table = pd.DataFrame(draw.uniform(0, 20, (60, 2)), columns=["x", "y"])
    table = table.assign(z=1.0, floor=np.repeat(["0", "1"], 30), phone=["new", "old"] * 30)
    loss = 20 * np.log10(np.hypot(table.x, table.y) + 1) + 15 * (table.floor == "1")
    return table.assign(receiver01=-40 - loss + draw.normal(0, 1, 60) - 8 * (table.phone == "old"))


def test_followed_rows_are_of_their_floor_and_phone(tmp_path):
    """A single row lacks the other floors, from which the height of its own follows."""
    data = Rssi.from_frame(two_floors(), offset_by="phone")
    fitted = RssiModel().fit(estimate_offsets(data, "new").removed(data))
    fitted.save(tmp_path / "floors.safetensors")
    rows = two_floors().assign(x=lambda table: table.x + 0.1)
    rows[rows.floor == "0"].tail(2).to_csv(tmp_path / "ground.csv", index=False)
    rows[rows.floor == "1"].tail(2).to_csv(tmp_path / "first.csv", index=False)
    _, answers, said = follow(tmp_path / "floors.safetensors", tmp_path / "ground.csv", out=tmp_path / "a")
    read = rows.receiver01[rows.floor == "0"].tail(2) - np.array([0.0, fitted.offsets.offset_db["old"]])
    assert [answer["observed"]["receiver01"] for answer in answers] == pytest.approx(read.tolist(), abs=0.01)
    assert not said
    _, answers, said = follow(tmp_path / "floors.safetensors", tmp_path / "first.csv", out=tmp_path / "b")
    assert not answers
    assert said.count("has rows on floor 1 at heights of other floors") == 2


def test_a_character_in_two_parts_is_one(model, tmp_path):
    source, parts = tmp_path / "rows.ndjson", [b"\xa9", b'"}\n']
    whole = line(40, note="?").replace(b"?", b"\xc3")
    source.write_bytes(whole.partition(b"\xc3")[0] + b"\xc3")

    def append(seconds):
        if not parts:
            raise KeyboardInterrupt
        with source.open("ab") as file:
            file.write(parts.pop(0))

    code, answers, said = follow(model, source, stop=append)
    assert (code, len(answers), said) == (130, 1, "")


def test_names_of_receivers_are_any_text(tmp_path, monkeypatch):
    """No encoding of the terminal breaks an answer."""
    data = floor()
    names = ("caf\u00e9 hall", *data.receiver_names[1:])
    data = Rssi(data.rssi_dbm, data.transmitter_position, receiver_names=names)
    RssiModel().fit(data.subset(torch.arange(40))).save(tmp_path / "model.safetensors")
    monkeypatch.setattr("swiftwrf.contrib.online.follower.alarm_threshold", lambda *_: 1e-9)
    content = line(40, rssi_dbm={names[0]: -20.0}) + line(41, rssi_dbm={names[0]: -20.0})
    code, answers, _ = follow(tmp_path / "model.safetensors", content=content)
    assert code == 0
    assert any("hall" in answer["alarm"] for answer in answers if answer["alarm"])
    rows = Record.read(tmp_path / "out").rows
    assert [row["index"] for row in rows] == [0, 1]
    assert any("caf\u00e9 hall stronger" in row["alarm"] for row in rows)


# sources and ends


@pytest.mark.parametrize("name", ["nothing.csv", "folder.csv", "nothing.ndjson", "rows.csv"])
def test_a_source_that_cannot_be_followed_is_refused_before_the_directory_is_made(model, tmp_path, name):
    """No file, or a table for spectra."""
    (tmp_path / "folder.csv").mkdir()
    (tmp_path / "rows.csv").write_bytes(HEADER)
    if name == "rows.csv":
        make_model("gp").fit(room().subset(torch.arange(40))).save(model)
    code, _, said = follow(model, tmp_path / name)
    assert code == 2
    assert ("give JSON lines" if name == "rows.csv" else f"error: {tmp_path / name} is ") in said
    assert "cannot write" not in said
    assert not (tmp_path / "out").exists()


def test_a_full_disk_is_answered_with_the_right_advice(model, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr("tasks.update.run._save", full)
        code, _, said = follow(model, content=line(40))
    assert code == 2
    assert "free space and run the same command again" in said
    assert "swiftwrf resume" not in said
    assert follow(model, content=line(40))[0] == 0


def test_a_last_line_without_its_end(model, tmp_path):
    """It counts at the end of standard input, but waits in a file, which may grow."""
    assert len(follow(model, content=line(40) + line(41).strip())[1]) == 2
    source = tmp_path / "rows.csv"
    source.write_bytes(HEADER + ROWS[0] + ROWS[1].strip())
    assert observed(follow(model, source, out=tmp_path / "table")[1]) == [-60]
    with source.open("ab") as file:
        file.write(b"\n")
    assert observed(follow(model, source, out=tmp_path / "table")[1]) == [-61]


def test_a_line_costs_the_same_in_a_long_record():
    step = Follower(rssi_model()).step(floor().subset(torch.tensor([40])))
    first = Record("source", "dB")
    first.add(0, step)
    record = Record("source", "dB", first.rows * 100_000)
    begin = time.process_time()
    for _ in range(10):
        record.add(1, step)
        found = record.summary()
    assert time.process_time() - begin < 0.2
    assert found["measurements"] == 100_010
    assert found["mean_error"] == pytest.approx(first.rows[0]["error"])


@pytest.mark.parametrize("named", [None, "source", "data"])
def test_an_update_from_files_or_a_public_data_set_writes_model_table_and_page(
    model, tmp_path, monkeypatch, capsys, named
):
    folder, out = tmp_path / "public" / "tetam-tracks", tmp_path / "out"
    folder.mkdir(parents=True)
    write_rssi(floor().subset(torch.arange(40, 50)), folder)
    monkeypatch.setenv("SWIFTWRF_DATA", str(folder.parent))
    source, data = (folder.name if named == kind else folder for kind in ("source", "data"))
    options = [str(model), str(source), *(("--data", str(data)) if named else ()), "--out", str(out)]
    assert run_command("update", options, "swiftwrf update") == 0
    assert "10 measurements learnt" in capsys.readouterr().out
    assert {"model.safetensors", "report.html", "measurements.csv", "update.json"} <= {f.name for f in out.iterdir()}
    assert len(load(out / "model.safetensors").region()) == 50
    assert run_command("update", options, "swiftwrf update") == 2


def test_a_record_comes_back_as_it_was_and_is_cut_to_what_the_model_has_learnt(tmp_path):
    """Texts that spreadsheets would run, rows in which nothing was detected, and a row that a kill cut in a letter."""
    follower, record = Follower(rssi_model()), Record("source", "dB")
    nothing = replace(floor().subset(torch.tensor([41])), rssi_dbm=torch.full((1, 12), torch.nan, dtype=torch.float64))
    step = replace(follower.step(nothing), alarms=("=hall weaker everywhere",), notice="kernel chosen again")
    record.append(tmp_path, record.add(41, step))
    assert "Mean error before each was learnt: unknown, over the last 30: unknown." in record.sentences()
    for _ in range(2):
        with (tmp_path / "measurements.csv").open("ab") as file:
            file.write("42,1.0,é".encode()[:-1])
        record = Record.read(tmp_path)
        assert {"Change at measurement 41: =hall weaker everywhere.", "Kernel chosen again."} <= {*record.sentences()}
        record.write(tmp_path)
    record.append(tmp_path, record.add(42, follower.step(floor().subset(torch.tensor([42])))))
    assert [(row["index"], row["notice"]) for row in Record.read(tmp_path).notices] == [(41, "kernel chosen again")]
    for number in (2, 1):
        kept = Record.read(tmp_path, number)
        kept.write(tmp_path)
        assert [row["index"] for row in Record.read(tmp_path).rows] == [41, 42][:number]
        assert kept.table["error"].tolist() == pytest.approx(record.table["error"][:number].tolist(), nan_ok=True)


def test_the_numbers_of_a_record_are_those_of_its_measurements(tmp_path):
    draw, record = np.random.default_rng(0), Record("source", "dB")
    position, error, covered = draw.random((40, 3)), draw.gamma(2, size=40), draw.random(40)
    innovation = draw.normal(size=(40, 3))
    innovation[20:, 1] = np.nan  # not detected
    for k in range(40):
        scores = Scores(*(torch.from_numpy(values[k : k + 1]) for values in (position, error, innovation, covered)))
        record.add(k, Step(scores, ("hall weaker",) * (k == 7), None, ""))
    root_mean_square = np.sqrt(np.nanmean(innovation**2, axis=1))
    running = [error[max(0, k - 29) : k + 1].mean() for k in range(40)]
    for column, values in (("error", error), ("running_error", running), ("innovation", root_mean_square)):
        assert record.table[column].tolist() == pytest.approx(list(values))
    shown = page(record, "name", tmp_path)
    mean, last = f"{error.mean():.3g} dB", f"{running[-1]:.3g} dB"
    assert [number.value for number in shown.summary.numbers] == ["40", mean, "1", f"{covered.mean():.0%}"]
    first, second, third = record.sentences()
    assert first == "1 change detected, 40 measurements learnt."
    assert (mean in second, second.endswith(f"30: {last}."), "measurement 7" in third) == (True, True, True)
    cells = shown.sections[0].tables[0].rows
    assert [int(row[0]) for row in cells] == np.argsort(-root_mean_square)[:10].tolist()
    worst = root_mean_square.argmax()
    assert cells[0][1:] == [f"{x:.3g}" for x in (*position[worst], error[worst], root_mean_square[worst])]
    near = np.argsort(cdist(position, position), axis=1)[:, :5]
    assert map_plot(record).data["innovation"].tolist() == pytest.approx(root_mean_square[near].mean(axis=1).tolist())


def test_an_answer_has_what_was_predicted_its_interval_and_what_was_observed():
    model, new = rssi_model(), floor().subset(torch.tensor([41]))
    found = json.loads(answer(41, new, model, Follower(model).step(new)))
    predicted = model.predict(new.transmitter_position)
    for name, away in (("predicted", 0), ("low", -1), ("high", 1)):
        expected = (predicted.mean + away * norm.ppf(0.9) * predicted.std)[0].tolist()
        assert found[name] == pytest.approx(dict(zip(model.receiver_names, expected, strict=True)), abs=0.00501)
    observed = dict(zip(model.receiver_names, new.rssi_dbm[0].tolist(), strict=True))
    known = {name: x for name, x in found["observed"].items() if x is not None}
    assert known == pytest.approx({name: x for name, x in observed.items() if x == x}, abs=0.00501)
    data = simulated_room(n=41, grid=AngularGrid.hemisphere(8, 32))
    train, new = data.subset(torch.arange(40)), data.subset(torch.tensor([40]))
    field = make_model("gp").fit(train)
    found = json.loads(answer(40, new, field, Follower(field, train).step(new)))
    for name, spectrum in (("predicted", field.synthesize(new.position)), ("observed", new.spectrum)):
        peak = data.grid.peak_direction(spectrum)[0].rad2deg().tolist()
        assert found[f"{name}_peak_deg"] == pytest.approx(peak, abs=0.0501)
