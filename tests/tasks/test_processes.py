"""Steps in several processes: the results of one process, in one order, and a sentence if a process is lost."""

import json
import os
import subprocess
import sys
import time
from functools import partial
from importlib import import_module
from multiprocessing import active_children
from multiprocessing.forkserver import set_forkserver_preload
from pathlib import Path
from unittest import mock

import pytest
import torch
from pandas.testing import assert_frame_equal
from sums import STEPS, Sum, kill, kill_once, leave, refuse, results

from swiftwrf import FitError, InputError, rssi_room
from swiftwrf.contrib.comparison.rssi import compare
from swiftwrf.contrib.comparison.steps import Memo
from swiftwrf.runtime.threads import set_threads
from tasks.command import PRELOADED
from tasks.configs import AoaConfig
from tasks.directory import Run
from tasks.environment import number_of_processes
from tasks.preload import SERVED
from tasks.workers import local_processes

HERE = Path(__file__).parents[1]
ENVIRONMENT = os.environ | {"PYTHONPATH": f"{HERE}{os.pathsep}{HERE.parent}"}
if SERVED:
    set_forkserver_preload(["tasks.workers"])  # a process starts in a tenth of the time


def test_processes_give_the_results_of_one_process_in_the_same_order(tmp_path):
    (here, _), (there, arrived) = (results(tmp_path / str(n), STEPS, n) for n in (1, 2))
    assert [(name, value["sum"]) for name, value in there] == [(name, value["sum"]) for name, value in here]
    assert [value["sum"] for _, value in there] == [11, 13, 14, 12, 11, 15]
    assert sorted(arrived) == [f"sum-{number}" for number in range(1, 6)]
    assert all(value["process"] != os.getpid() and value["threads"] == 1 for _, value in there)
    assert (tmp_path / "2" / "sum-5.txt").read_text() == "5"
    assert not active_children()


@pytest.mark.skipif(not SERVED, reason="processes are forks of a server on Linux alone")
def test_processes_begin_with_the_modules_that_a_command_preloads():
    assert all(set(map(import_module, modules)) <= set(sys.modules.values()) for modules in PRELOADED.values())
    code = """if __name__ == "__main__":
        from tasks.preload import preload, process_context
        preload(["colorsys"])
        with process_context().Pool(1) as pool:
            print(pool.apply(exec, ("import sys; assert 'colorsys' in sys.modules; assert 'torch' not in sys.modules",)))
    """
    threads = os.environ | {"OMP_NUM_THREADS": "2"}
    done = subprocess.run([sys.executable, "-c", code], env=threads, capture_output=True, text=True, check=False)
    assert (done.stdout, done.stderr) == ("None\n", "")


@pytest.mark.skipif(not SERVED, reason="processes are forks of a server on Linux alone")
@pytest.mark.parametrize("modules", ["", "colorsys"])
def test_a_map_is_computed_in_forks_of_the_server_if_there_is_one(modules):
    code = f"""if __name__ == "__main__":
        import os
        from tasks.preload import preload, served_map
        preload({modules!r}.split())
        print(served_map(pow, [2, 3], [3, 2]), served_map(eval, ["__import__('os').getpid()"]) == [os.getpid()])
        print(served_map(eval, ["__import__('gc').isenabled()"]))  # the server itself collects no garbage
    """
    threads = os.environ | {"OMP_NUM_THREADS": "2"}
    done = subprocess.run([sys.executable, "-c", code], env=threads, capture_output=True, text=True, check=False)
    assert (done.stdout, done.stderr) == (f"[8, 9] {not modules}\n[True]\n", "")


KILLED = "was killed, probably because memory was short; continue with one process: .* --processes 1"


@pytest.mark.parametrize(
    ("step", "error"),
    [
        (Sum(1, function=refuse), InputError("no such number")),
        (Sum(1, function=kill), FitError(KILLED)),
        (Sum(1, function=leave), FitError("ended with exit code 3; continue with one process")),
    ],
)
def test_a_step_that_fails_ends_the_run_and_its_processes(tmp_path, step, error):
    with pytest.raises(type(error), match=str(error)):
        results(tmp_path / "run", [Sum(2), step], 2)
    assert not list((tmp_path / "run.partial" / "steps").glob(".*"))
    assert not active_children()


@pytest.mark.parametrize("processes", [1, 2])
def test_a_run_that_lost_a_process_continues_with_the_results_that_it_kept(tmp_path, processes):
    steps = [Sum(1, (3, 4)), Sum(2, (5,), kill_once)]
    with pytest.raises(FitError, match=KILLED):
        results(tmp_path / "run", steps, 2)
    found, arrived = results(tmp_path / "run", steps, processes, resume=tmp_path / "run.partial")
    assert [value["sum"] for _, value in found] == [11, 13, 14, 12, 15]
    assert {"sum-2", "sum-5"} <= set(arrived)


SCRIPT = """
import sys, torch
from sums import add
from swiftwrf.contrib.comparison.steps import Steps
from tasks.configs import AoaConfig
from tasks.directory import Run
from tasks.workers import workers_of

class Own(int): pass

print("once")
for context in (10, Own(10)):
    config = AoaConfig(measured=(0.5,), out=sys.argv[1] + type(context).__name__)
    with Run("aoa", "", config, torch.device("cpu"), {}, None, 2) as run, workers_of(run, None) as two:
        steps = Steps(context, run, two)
        names = [steps.start(f"sum-{number}", "", add, number) for number in (1, 2)]
        print([steps[name]["sum"] for name in names])
"""


def test_a_script_without_main_guard_runs_once_and_its_errors_are_those_that_happened(tmp_path):
    (tmp_path / "script.py").write_text(SCRIPT)
    command = [sys.executable, str(tmp_path / "script.py"), str(tmp_path / "run")]
    done = subprocess.run(command, env=ENVIRONMENT, capture_output=True, text=True, check=False)
    assert done.stdout.splitlines() == ["once", "[11, 12]"]
    assert "AttributeError: Can't get attribute 'Own'" in done.stderr
    assert "memory" not in done.stderr


@pytest.mark.parametrize(("now", "asked", "processes"), [(4, None, 2), (1, None, 1), (4, 1, 1)])
def test_a_resumed_run_has_the_processes_of_now_with_the_threads_of_its_beginning(tmp_path, now, asked, processes):
    file = tmp_path / "run.partial" / "environment.json"
    start = partial(Run, "aoa", "", AoaConfig(measured=(0.5,), out=str(tmp_path / "run")), torch.device("cpu"), {})
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(8)
        with start(None, None) as run:
            assert (run.processes, torch.get_num_threads()) == (4, 2)
        torch.set_num_threads(now)
        with start(file.parent, asked) as run:
            assert (run.processes, torch.get_num_threads()) == (processes, 2)
    finally:
        set_threads(threads)
    recorded = json.loads(file.read_text())
    assert (recorded["threads"], recorded["processes"], recorded["resumed"][0]["processes"]) == (2, 4, processes)


def test_one_process_with_one_thread_and_on_a_gpu():
    assert number_of_processes(torch.device("cpu")) == 1
    with mock.patch("torch.get_num_threads", return_value=16):
        assert number_of_processes(torch.device("cpu")) == 4
        assert number_of_processes(torch.device("cuda")) == 1
    assert number_of_processes(torch.device("cpu"), 3) == 3
    with pytest.raises(InputError, match="--processes 2 is for steps on the CPU"):
        number_of_processes(torch.device("cuda"), 2)


def test_predictors_that_processes_fit_are_those_fitted_here(tmp_path):
    data, options = rssi_room(n=60).columns([0]), {"only": ["knn"], "fewer": (0.5,)}
    here, memo = compare(data, **options), Memo(tmp_path)
    with local_processes(2, memo.folder) as two:
        there = compare(data, **options, executor=two)
    assert_frame_equal(there.errors, here.errors)
    assert_frame_equal(there.by_rows, here.by_rows)
    assert list(there.predictors) == ["swiftwrf"]


def is_running(process):
    stat = Path(f"/proc/{process}/stat")
    return stat.exists() and stat.read_text().rpartition(")")[2].split()[0] != "Z"


@pytest.mark.skipif(not Path("/proc").exists(), reason="reads the states of processes")
def test_processes_end_with_a_run_that_is_killed(tmp_path):
    code = "import sys; from sums import *; results(sys.argv[1], [Sum(1), Sum(2, function=sleep)], 2)"
    run = subprocess.Popen([sys.executable, "-c", code, str(tmp_path / "run")], env=ENVIRONMENT)
    file = tmp_path / "run.partial" / "steps" / "sum-1.json"
    while not file.exists():
        assert run.poll() is None
        time.sleep(0.1)
    run.kill()
    run.wait()
    process, deadline = json.loads(file.read_text())["value"]["process"], time.monotonic() + 30
    while is_running(process) and time.monotonic() < deadline:
        time.sleep(0.1)
    assert not is_running(process)
