"""Whatever is done to files and command lines, there is a result that is finite, or one sentence; never a traceback.

8 mutations of files a kind and 3 attempts of any other kind with every test run. `pytest -m fuzz` makes 10,000 and 5,000
more, and 200 command lines.
"""

import inspect
import multiprocessing
import random
import re
import resource
import shutil
import signal
from contextlib import suppress
from pathlib import Path

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from quick import run

from fuzz.commands import command_lines
from fuzz.kinds import ATTEMPTS, DATA, KINDS, MODELS, Attempt, answer, fitted, save
from fuzz.mutate import damages, spoil
from swiftwrf import FitError, InputError, load
from swiftwrf.data.files import read_table, read_yaml
from swiftwrf.data.formats import RSSI_FORMATS, SNAPSHOT_FORMATS, SPECTRA_FORMATS
from swiftwrf.errors import MAX_LENGTH
from swiftwrf.runtime.checkpoint import Saved

pytestmark = pytest.mark.usefixtures("short_fits")
# a region has any positions, an array any elements, and a model that recognises fewer of its rows predicts the same
TAKEN = re.compile(r"tensor ([\w.]+\.)?((region\.known|array\.element|row_digests) shorter|row_digests narrower)")


def attack(kind: str, folder: Path, seeds: range) -> dict[str, int]:
    """Return the number of mutated samples, or attempts, that were read and that were refused.

    Raises:
        AssertionError: One was neither read nor refused.
    """
    attempt = ATTEMPTS[kind] if kind in ATTEMPTS else _spoiling(kind, folder / "sound")
    ends, spoilt = {"read": 0, "refused": 0}, folder / "spoilt"
    for seed in seeds:
        shutil.rmtree(spoilt, ignore_errors=True)
        spoilt.mkdir(parents=True)
        try:
            attempt(random.Random(seed), spoilt)
        except (InputError, FitError) as refusal:
            if len(str(refusal)) > MAX_LENGTH or "\n" in str(refusal):
                raise AssertionError(f"{kind}, seed {seed}: {refusal}") from refusal
            ends["refused"] += 1
        except BaseException as error:
            raise AssertionError(f"{kind}, seed {seed}: {type(error).__name__}: {error}") from error
        else:
            ends["read"] += 1
    return ends


def forked(function, *arguments):
    """Return what a function returns in a forked process: a compiled parser that ends its process ends no other.

    Raises:
        AssertionError: The process ended without a result.
    """
    receiver, sender = multiprocessing.Pipe(duplex=False)

    def call() -> None:
        try:
            found = function(*arguments)
        except BaseException as error:
            found = error
        sender.send(found)

    process = multiprocessing.get_context("fork").Process(target=call)
    process.start()
    sender.close()
    try:
        found = receiver.recv()
    except EOFError:
        process.join()
        raise AssertionError(f"{arguments[0]}: the process ended with code {process.exitcode}") from None
    process.join()
    if isinstance(found, BaseException):
        raise found
    return found


def test_a_forked_process_returns_its_result_or_the_signal_that_ended_it():
    assert forked(abs, -1) == 1
    with pytest.raises(AssertionError, match="seed 3"):
        forked(_refuse, "seed 3")
    with pytest.raises(AssertionError, match=f"code {-signal.SIGKILL}"):
        forked(signal.raise_signal, signal.SIGKILL)


def _refuse(words):
    raise AssertionError(words)


def _spoiling(kind: str, sound: Path) -> Attempt:
    """Write a sound sample, and return a function that reads a mutated copy of it."""
    write, read = KINDS[kind]
    sound.mkdir(parents=True)
    write(sound)
    read(sound)

    def attempt(draw: random.Random, spoilt: Path) -> None:
        shutil.copytree(sound, spoilt, dirs_exist_ok=True)
        spoil(spoilt, draw)
        read(spoilt)

    return attempt


def test_every_format_and_model_is_fuzzed():
    for formats in (SPECTRA_FORMATS, SNAPSHOT_FORMATS, RSSI_FORMATS):
        for name in formats:
            assert f"{formats.kind} {name}" in KINDS, f"add a sample of {name} to fuzz/kinds.py"
    saved = {kind: model for kind, model in Saved.kinds.items() if not inspect.isabstract(model)}
    own = {kind for kind, model in saved.items() if model.__module__.startswith("swiftwrf.")}
    own -= {"ray-tracing model"}  # Sionna RT opens it; its file is that of a geometry model
    assert own <= set(KINDS), "add a sample of the model to fuzz/kinds.py"


@pytest.mark.parametrize("name", MODELS)
def test_a_model_from_a_file_answers_as_the_one_in_memory(name, tmp_path):
    save(name, tmp_path)
    model, again = fitted(name), load(tmp_path / "model")
    torch.testing.assert_close(answer(name, again), answer(name, model), atol=1e-6, rtol=0)
    assert again.config == model.config
    assert getattr(again, "receiver_names", None) == getattr(model, "receiver_names", None)


def few_or_many(few: int, many: int):
    """Give a test few seeds, and many others if a person asks for them."""
    more = pytest.param(range(few, few + many), marks=pytest.mark.fuzz)
    return pytest.mark.parametrize("seeds", [range(few), more], ids=["few", "many"])


@few_or_many(8, -(-10_000 // len(KINDS)))
@pytest.mark.parametrize("kind", KINDS)
def test_mutations(kind, seeds, tmp_path):
    ends = forked(attack, kind, tmp_path, seeds) if kind in DATA else attack(kind, tmp_path, seeds)
    assert ends["refused"] > 0


@few_or_many(3, -(-5_000 // len(ATTEMPTS)))
@pytest.mark.parametrize("kind", ATTEMPTS)
def test_attempts(kind, seeds, tmp_path):
    attack(kind, tmp_path, seeds)


@pytest.mark.parametrize("every", [8, pytest.param(1, marks=pytest.mark.fuzz)])
@pytest.mark.parametrize("kind", [*MODELS, *(kind for kind in KINDS if kind.startswith("run of "))])
def test_other_arrays_and_values_in_a_file(kind, every, tmp_path):
    """They are refused before memory is taken, or what follows from them is finite."""
    write, read = KINDS[kind]
    write(tmp_path)
    read(tmp_path)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    wrong = []
    for file in sorted(file for file in tmp_path.iterdir() if file.is_file()):
        content = file.read_bytes()
        for name, damage in [*damages(file, kind)][::every]:
            damage()
            try:
                read(tmp_path)
            except (InputError, FitError) as refusal:
                if len(str(refusal)) > MAX_LENGTH:
                    wrong.append(f"{name}: {refusal}")
            except Exception as error:
                wrong.append(f"{file.name}, {name}: {type(error).__name__}: {error}")
            else:
                if name.startswith("tensor") and not TAKEN.fullmatch(name):
                    wrong.append(f"{name} is accepted")
            file.write_bytes(content)
    assert not wrong, "\n".join(wrong)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 2**20  # KiB


def _end(task, arguments, capfd):
    """Run a command line and return its exit code, and the message of a refusal."""
    try:
        code = run(task, *arguments)
    except SystemExit as end:  # help, or options that the parser does not know
        code = end.code
    lines = capfd.readouterr().err.strip().splitlines()
    said = [line for line in lines if line.startswith("error: ")]
    assert code in (0, 1, 2, None), (task, arguments)
    if said:
        assert code in (1, 2)
        assert len(said) == 1
        assert len(said[0]) <= MAX_LENGTH + len("error: ")
    return code


@pytest.mark.parametrize("count", [20, pytest.param(200, marks=pytest.mark.fuzz)])
def test_command_lines(count, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    for task, arguments in command_lines(random.Random(count), tmp_path, count):
        _end(task, arguments, capfd)


text = st.text(alphabet=st.characters(codec="utf-8"), max_size=200)


@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(text)
def test_any_text_as_yaml_or_table(tmp_path, content):
    file = tmp_path / "file"
    file.write_text(content, encoding="utf-8", newline="")
    for read in (read_yaml, read_table):
        with suppress(InputError):
            read(file)
