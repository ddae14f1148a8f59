"""Runs on a Dask cluster: the numbers of this machine, whoever dies; one sentence where nothing can go on."""

import json
import os
import socket
import subprocess
import sys
import time
from pathlib import Path

import dask
import pytest
import torch
from quick import run, said
from sums import STEPS, Sum, add, kill, kill_once, refuse, results, sleep
from test_rssi_model import with_field

from swiftwrf import FitError, InputError, fit_rssi
from swiftwrf.contrib.comparison import steps
from swiftwrf.contrib.comparison.steps import _compute
from swiftwrf.runtime.threads import set_threads
from tasks import workers
from tasks.workers import connected

distributed = pytest.importorskip("distributed", reason="needs the extra 'cluster'")

HERE = Path(__file__).parents[1]
CPU = torch.device("cpu")


@pytest.fixture(autouse=True)
def patient(monkeypatch):
    """Processes start slowly where other tests run beside."""
    monkeypatch.setattr(workers, "WORKERS_S", 120)


@pytest.fixture(scope="module")
def local():
    """Two processes that know the stand-ins of `quick`; one that is killed may take its time to start again."""
    with (
        dask.config.set({"distributed.deploy.lost-worker-timeout": "10 minutes"}),
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=":0", preload="quick") as started,
    ):
        yield started


@pytest.fixture
def cluster(local):
    with connected(local.scheduler_address, CPU) as joined:
        yield joined


def test_a_cluster_gives_the_results_of_this_machine_when_a_worker_dies(cluster, tmp_path):
    here, _ = results(tmp_path / "here", [*STEPS, Sum(6)])
    there, arrived = results(tmp_path / "there", [*STEPS, Sum(6, function=kill_once)], cluster=cluster)
    assert [(name, value["sum"]) for name, value in there] == [(name, value["sum"]) for name, value in here]
    assert len(arrived) == len(set(arrived)) == 6
    assert all(value["process"] != os.getpid() for _, value in there)
    assert (tmp_path / "there" / "sum-5.txt").read_text() == "5"
    environment = json.loads((tmp_path / "there" / "environment.json").read_text())
    assert environment["workers"] == [environment["device"]]


def test_rssi_has_the_same_bits(cluster):
    data = with_field(n=40)
    here, there = fit_rssi(data), fit_rssi(data, parallel=cluster.map)
    assert torch.equal(there.predict(data.transmitter_position).mean, here.predict(data.transmitter_position).mean)


def test_a_run_has_the_same_numbers(local, tmp_path):
    for name, options in (("here", ()), ("there", ("--scheduler", local.scheduler_address))):
        assert run("rssi", "--rx", "1", *options, "--out", tmp_path / name) == 0
    here, there = ({file.name: file for file in (tmp_path / name).iterdir()} for name in ("here", "there"))
    assert set(here) == set(there)
    for name in ("errors.csv", "predictions.csv"):
        assert here[name].read_bytes() == there[name].read_bytes()
    assert "workers" in (tmp_path / "there" / "report.html").read_text()


def test_workers_take_the_threads_of_the_run(cluster):
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(3)
        assert list(cluster.map(lambda _: torch.get_num_threads(), range(2))) == [3, 3]
    finally:
        set_threads(before)


class Foreign:
    """Class that no other process can unpickle."""

    def __reduce__(self):
        return __import__, ("no_such_package",)


def test_workers_that_cannot_compute_the_same_are_refused(local, tmp_path, monkeypatch):
    with pytest.raises(InputError, match="lacks a package"), connected(local.scheduler_address, CPU) as cluster:
        list(cluster.map(abs, [Foreign()]))
    with pytest.raises(InputError, match="choose an --out on a file system that all machines share"):
        _compute(10, tmp_path / "elsewhere", add, 1)
    monkeypatch.setattr(workers, "packages", lambda: {"torch": "0.1"})
    with (
        pytest.raises(InputError, match=r"a worker has torch .* \(not 0.1\)"),
        connected(local.scheduler_address, CPU) as cluster,
    ):
        list(cluster.map(abs, [1]))


def test_a_step_that_ends_every_worker_ends_in_a_sentence(local, tmp_path, monkeypatch):
    monkeypatch.setattr(local.scheduler, "allowed_failures", 0)
    with (
        pytest.raises(FitError, match="a step ended several workers"),
        connected(local.scheduler_address, CPU) as cluster,
    ):
        results(tmp_path / "run", [Sum(1, function=kill)], cluster=cluster)


def test_the_next_run_does_not_wait_for_the_steps_of_a_stopped_one(local, tmp_path, monkeypatch):
    def processes():
        with distributed.Client(local.scheduler_address) as client:
            client.wait_for_workers(1)
            return set(client.run(os.getpid).values())

    def stop(*_):
        with distributed.Client(local.scheduler_address) as client:
            while not any(client.processing().values()):
                time.sleep(0.1)
        raise KeyboardInterrupt

    before = processes()
    monkeypatch.setattr(steps, "wait", stop)  # once the step is computed
    with pytest.raises(KeyboardInterrupt), connected(local.scheduler_address, CPU) as cluster:
        results(tmp_path / "run", [Sum(1, function=sleep)], cluster=cluster)
    assert before - processes()  # a new worker is in the place of the one that slept


def test_workers_that_never_come_or_go_for_good(tmp_path, monkeypatch):
    with distributed.LocalCluster(n_workers=0, dashboard_address=":0") as empty:
        with monkeypatch.context() as patch:
            patch.setattr(workers, "WORKERS_S", 1)
            with pytest.raises(InputError, match="has no workers"), connected(empty.scheduler_address, CPU):
                pass
        empty.scale(1)

        def lose():
            monkeypatch.setattr(workers, "WORKERS_S", 1)
            empty.scale(0)

        with pytest.raises(FitError, match="workers went away"), connected(empty.scheduler_address, CPU) as cluster:
            results(tmp_path / "run", [Sum(1, (2,))], cluster=cluster, act=lose)


@pytest.fixture
def scheduler(tmp_path):
    """A scheduler without torch and a worker, in processes of their own: that of the scheduler, and its address."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(HERE), str(HERE.parent)])}
    file = tmp_path / "scheduler.json"
    lacking = "import sys; sys.modules |= dict.fromkeys(('torch', 'swiftwrf', 'augment', 'tasks', 'sums'));"

    def start(program, *options):
        begin = lacking if program == "scheduler" else "import sys;"
        command = [sys.executable, "-c", f"{begin} from distributed.cli.dask_{program} import main; main()"]
        command += ["--scheduler-file", str(file), *options, "--no-dashboard"]
        return subprocess.Popen(command, env=environment, stderr=subprocess.DEVNULL)

    processes = [start("scheduler", "--host=127.0.0.1", "--port=0"), start("worker", "--nthreads=1", "--no-nanny")]
    while not file.exists():
        assert processes[0].poll() is None
        time.sleep(0.1)
    yield processes[0], json.loads(file.read_text())["address"]
    for process in processes:
        process.kill()
        process.wait()


def test_a_scheduler_without_torch_gives_results_and_reasons(scheduler, tmp_path):
    _, address = scheduler
    here, _ = results(tmp_path / "here", STEPS)
    with connected(address, CPU) as cluster:
        there, _ = results(tmp_path / "there", STEPS, cluster=cluster)
        assert [value["sum"] for _, value in there] == [value["sum"] for _, value in here]
        assert next(iter(cluster.map(torch.neg, [torch.ones(2)]))).tolist() == [-1, -1]
    with connected(address, CPU) as cluster, pytest.raises(InputError, match="no such number"):
        results(tmp_path / "refused", [Sum(1, function=refuse)], cluster=cluster)


def test_a_run_that_loses_its_scheduler_continues_here(scheduler, tmp_path):
    process, address = scheduler
    with pytest.raises(FitError, match="went away; go on with swiftwrf resume"), connected(address, CPU) as cluster:
        results(tmp_path / "run", STEPS, cluster=cluster, act=process.kill)
    kept = {file.name for file in (tmp_path / "run.partial" / "steps").glob("*.json")}
    assert kept
    found, arrived = results(tmp_path / "run", STEPS, resume=tmp_path / "run.partial")
    assert [value["sum"] for _, value in found] == [11, 13, 14, 12, 11, 15]
    assert not {f"{name}.json" for name in arrived} & kept


def test_another_server_is_no_scheduler(local, monkeypatch):
    monkeypatch.setattr(workers, "CONNECT_S", 1)
    with socket.create_server(("127.0.0.1", 0)) as mute:
        silent = f"tcp://127.0.0.1:{mute.getsockname()[1]}"
        worker = next(iter(local.scheduler.workers))
        for address in (silent, "tcp://127.0.0.1:1", "127.0.0.1", "http://127.0.0.1:1", worker):
            with pytest.raises(InputError, match="no Dask scheduler answers"), connected(address, CPU):
                pass


def test_a_run_without_its_scheduler_leaves_nothing(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(workers, "CONNECT_S", 1)
    assert run("rssi", "--rx", 1, "--scheduler", "tcp://127.0.0.1:1", "--out", tmp_path / "run") == 2
    assert "no Dask scheduler answers" in said(capsys)
    assert not list(tmp_path.iterdir())
