"""Runs on a Dask cluster: the numbers of this machine, whoever dies; one sentence where nothing can go on."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
from functools import partial
from pathlib import Path
from unittest import mock

import ablation
import comparison
import dask
import model_size
import pytest
import torch
from quick import run, said
from small import small_swiftwrf
from test_interrupts import same_results
from test_rssi_model import with_field

from swiftwrf import AngularGrid, FitError, InputError, fit_rssi, simulated_room
from tasks import cluster as clusters
from tasks.cluster import Cluster
from tasks.directory import Run

distributed = pytest.importorskip("distributed", reason="needs the extra 'cluster'")

HERE = Path(__file__).parents[1]
CPU = torch.device("cpu")
ENDS = ("client", "scheduler", "worker")
AOA = ("aoa", "--mix", 0.5, "--synthesizer", "swiftwrf", "idw", "--extra", 20)
RSSI = ("rssi", "--rx", 1, 2, 3, 4, 5)


@pytest.fixture(autouse=True)
def patient(monkeypatch):
    """Processes start slowly where other tests run beside."""
    monkeypatch.setattr(clusters, "WORKERS_S", 120)


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
    joined = Cluster(local.scheduler_address, CPU)
    yield joined
    joined.client.close()


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The run of AOA here; nowhere a room is searched, which has tests of its own."""
    with mock.patch("tasks.aoa.context.candidates", return_value=["idw", "gp"]):
        out = tmp_path_factory.mktemp("whole") / "run"
        assert run(*AOA, "--out", out) == 0
        yield out


def during(monkeypatch, call, act):
    """Acts when a run keeps or awaits something for the so-manyth time."""
    owner, name, number = call
    honest, calls = getattr(owner, name), []

    def acting(*arguments):
        calls.append(1)
        if len(calls) == number:
            act()
        return honest(*arguments)

    monkeypatch.setattr(owner, name, acting)


def kill_a_worker(local):
    """One that is up."""
    up = [nanny for nanny in local.workers.values() if nanny.worker_address in local.scheduler.workers]
    os.kill(up[0].pid, signal.SIGKILL)


@pytest.mark.skipif(sys.platform != "linux", reason="the worker's allocator is set where it is glibc")
def test_workers_keep_the_memory_that_a_training_frees(cluster):
    def faults(_):
        import resource

        def block():
            return [torch.empty(2**18).fill_(1.0) for _ in range(40)]  # 1 MiB each

        block()
        before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
        for _ in range(20):
            block()
        return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

    assert max(cluster.map(faults, range(2))) < 20_000  # 200,000 as Dask sets it


@pytest.mark.long
def test_aoa_has_the_same_numbers_when_a_worker_dies(local, whole, tmp_path, monkeypatch):
    during(monkeypatch, (Run, "keep", 4), lambda: kill_a_worker(local))
    assert run(*AOA, "--scheduler", local.scheduler_address, "--out", tmp_path / "run") == 0
    same_results("aoa", whole, tmp_path / "run")
    assert {file.name for file in (tmp_path / "run").iterdir()} == {file.name for file in whole.iterdir()}
    environment = json.loads((tmp_path / "run" / "environment.json").read_text())
    assert environment["workers"] == [environment["device"]]
    assert "workers" in (tmp_path / "run" / "report.html").read_text()


def test_rssi_has_the_same_bits_when_a_worker_dies(local, cluster, monkeypatch):
    during(monkeypatch, (Cluster, "next", 2), lambda: kill_a_worker(local))
    data = with_field(n=40)
    here, there = fit_rssi(data), fit_rssi(data, parallel=cluster.map)
    assert torch.equal(there.predict(data.transmitter_position).mean, here.predict(data.transmitter_position).mean)


def test_the_comparison_has_the_same_rows(local, tmp_path, monkeypatch, small_published):
    data = simulated_room(n=30, grid=AngularGrid.hemisphere(8, 32))
    written = []
    monkeypatch.setattr(comparison, "scenes", lambda config: [("room random", data, "random")])
    monkeypatch.setattr(comparison, "BASELINES", ("mean", "nearest"))
    monkeypatch.setattr(comparison, "LEARNT", ("vae",))
    monkeypatch.setattr(comparison, "write_result", lambda name, content: written.append(content["scenes"]))
    monkeypatch.setattr(comparison, "draw", lambda found: None)
    for address in (None, local.scheduler_address):
        work = tmp_path / ("here" if address is None else "there")
        comparison.main(comparison.Config(Path(), parts=("scenes",), work=work, scheduler=address))
        assert not list(work.rglob("*.state"))
    here, there = (found["room random"]["24"] for found in written)
    assert list(there) == list(here) == ["mean", "nearest", "vae"]
    assert scores(there.values()) == scores(here.values())


def scores(rows):
    """The rows but for what no two measurements share."""
    timed = ("seconds", "processor_seconds", "fit_seconds", "ms")
    return [{key: value for key, value in row.items() if key not in timed} for row in rows]


def test_studies_have_the_same_scores(local, tmp_path, monkeypatch):
    data = simulated_room(n=30, grid=AngularGrid.hemisphere(8, 32))
    written = []
    for study in (ablation, model_size):
        monkeypatch.setattr(study, "simulated_room", lambda: data)
        monkeypatch.setattr(study, "write_result", lambda name, content: written.append(content))
    monkeypatch.setattr(model_size, "SIZES", (16,))
    monkeypatch.setattr(ablation, "variants", lambda default: {"default": default})
    with small_swiftwrf():  # as the workers, which preload `quick`
        for study in (ablation, model_size):
            for address in (None, local.scheduler_address):
                study.main(study.Config(scheduler=address))
    found = [content["scenes"]["simulated-room random"] for content in written]
    varied = [scores(study["variants"].values()) for study in found[:2]]
    sized = [scores([study["auto"], *study["fixed"]]) for study in found[2:]]
    assert varied[0] == varied[1]
    assert sized[0] == sized[1]
    assert "psnr_db" in varied[0][0]
    assert ["workers" in content for content in written] == [False, True, False, True]


def test_workers_take_the_threads_of_the_run(cluster):
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        assert list(cluster.map(lambda _: torch.get_num_threads(), range(2))) == [3, 3]
    finally:
        torch.set_num_threads(before)


def test_workers_of_other_versions_are_refused(cluster, monkeypatch):
    monkeypatch.setattr(clusters, "packages", lambda: {"torch": "0.1"})
    with pytest.raises(InputError, match=r"a worker has torch .* \(not 0.1\)"):
        list(cluster.map(abs, [1]))


class Foreign:
    """Class that no other process can unpickle."""

    def __reduce__(self):
        return __import__, ("no_such_package",)


def test_a_cluster_without_this_package_is_refused(cluster):
    with pytest.raises(InputError, match="install this package there"):
        list(cluster.map(abs, [Foreign()]))
    with pytest.raises(InputError, match="install this package there"):
        list(cluster.map(partial(max, Foreign()), [1]))


def test_what_ends_every_worker_ends_in_a_sentence(local, cluster, monkeypatch):
    monkeypatch.setattr(local.scheduler, "allowed_failures", 0)
    with pytest.raises(FitError, match="part 1 of 1 ended several workers"):
        list(cluster.map(lambda _: os.kill(os.getpid(), signal.SIGKILL), [0]))


def test_workers_that_never_come(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(clusters, "WORKERS_S", 1)
    with distributed.LocalCluster(n_workers=0, dashboard_address=":0") as empty:
        assert run(*RSSI, "--scheduler", empty.scheduler_address, "--out", tmp_path / "run") == 2
    lines = capsys.readouterr().err.splitlines()
    assert lines[0].startswith("waiting up to 1 s for workers")
    assert "has no workers after 1 s" in lines[1]
    assert not list(tmp_path.iterdir())


def test_workers_that_go_for_good(monkeypatch):
    monkeypatch.setattr(clusters, "WORKERS_S", 1)
    with distributed.LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=":0") as mortal:
        left, nanny = Cluster(mortal.scheduler_address, CPU), mortal.workers[0]
        during(monkeypatch, (Cluster, "next", 1), lambda: mortal.sync(nanny.close))
        with pytest.raises(FitError, match=r"all workers .* went away"):
            list(left.map(time.sleep, [60]))
        left.client.close()


def test_a_connection_that_breaks_while_a_result_is_fetched(cluster, monkeypatch):
    def broken(future, timeout=None):
        raise ConnectionResetError(104, "Connection reset by peer")

    with monkeypatch.context() as patch:
        patch.setattr(distributed.Future, "result", broken)
        with pytest.raises(FitError, match="went away"):
            list(cluster.map(abs, [-1]))
    assert list(cluster.map(abs, [-2])) == [2]


def test_rssi_survives_a_lost_connection(local, tmp_path, monkeypatch, capsys):
    def lose():
        distributed.default_client().scheduler_comm.comm.abort()

    with monkeypatch.context() as patch:
        during(patch, (Cluster, "next", 2), lose)
        assert run(*RSSI, "--scheduler", local.scheduler_address, "--out", tmp_path / "cut") == 1
    assert "went away; go on with --resume" in said(capsys)
    assert run("rssi", "--resume", tmp_path / "cut.partial", "--scheduler", local.scheduler_address) == 0
    assert run(*RSSI, "--out", tmp_path / "whole") == 0
    same_results("rssi", tmp_path / "whole", tmp_path / "cut")


@pytest.fixture
def scheduler(tmp_path):
    """A scheduler and a worker in processes of their own: that of the scheduler, and its address."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(HERE), str(HERE.parent)])}
    file = tmp_path / "scheduler.json"

    def start(program, *options):
        command = [sys.executable, "-m", f"distributed.cli.dask_{program}", "--scheduler-file", str(file), *options]
        return subprocess.Popen([*command, "--no-dashboard"], env=environment, stderr=subprocess.DEVNULL)

    worker = "--nthreads=1", "--no-nanny", "--preload=quick"
    processes = [start("scheduler", "--host=127.0.0.1", "--port=0"), start("worker", *worker)]
    while not file.exists():
        assert processes[0].poll() is None
        time.sleep(0.1)
    yield processes[0], json.loads(file.read_text())["address"]
    for process in processes:
        process.kill()
        process.wait()


@pytest.mark.long
def test_aoa_survives_its_scheduler(scheduler, whole, tmp_path, monkeypatch, capsys):
    process, address = scheduler
    with monkeypatch.context() as patch:
        during(patch, (Run, "keep", 3), process.kill)
        assert run(*AOA, "--scheduler", address, "--out", tmp_path / "cut") == 1
    assert "went away; go on with --resume" in said(capsys)
    kept = {file: file.read_bytes() for file in (tmp_path / "cut.partial" / "steps").glob("*.json")}
    assert len(kept) == 3
    assert run("aoa", "--resume", tmp_path / "cut.partial", "--scheduler", address) == 2
    assert "no Dask scheduler answers" in said(capsys)
    assert {file: file.read_bytes() for file in kept} == kept
    assert run("aoa", "--resume", tmp_path / "cut.partial") == 0
    same_results("aoa", whole, tmp_path / "cut")


def test_a_worker_is_no_scheduler(local):
    while not local.scheduler.workers:
        time.sleep(0.1)
    with pytest.raises(InputError, match="a Dask Worker answers"):
        Cluster(next(iter(local.scheduler.workers)), CPU)


def test_another_server_is_no_scheduler(monkeypatch):
    monkeypatch.setattr(clusters, "CONNECT_S", 1)
    with socket.create_server(("127.0.0.1", 0)) as mute, pytest.raises(InputError, match="nothing in 1 s"):
        Cluster(f"tcp://127.0.0.1:{mute.getsockname()[1]}", CPU)


@pytest.mark.parametrize(
    ("address", "says"),
    [
        ("tcp://127.0.0.1:1", "no Dask scheduler answers"),
        ("127.0.0.1", "takes tcp://HOST:PORT"),
        ("http://127.0.0.1:1", "takes tcp://HOST:PORT"),
        ("inproc://1/2", "takes tcp://HOST:PORT"),
        ("tls://127.0.0.1:1", "with the certificates of Dask's configuration"),
    ],
)
def test_addresses_that_lead_nowhere(tmp_path, capsys, monkeypatch, address, says):
    monkeypatch.setattr(clusters, "CONNECT_S", 1)
    assert run(*RSSI, "--scheduler", address, "--out", tmp_path / "run") == 2
    assert says in said(capsys)
    assert not list(tmp_path.iterdir())


def test_tls_with_the_certificates_of_dask(tmp_path, monkeypatch):
    key, certificate = str(tmp_path / "key.pem"), str(tmp_path / "certificate.pem")
    command = ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "1", "-subj", "/CN=localhost"]
    try:
        subprocess.run([*command, "-keyout", key, "-out", certificate], check=True, capture_output=True)
    except FileNotFoundError:
        pytest.skip("needs openssl")
    monkeypatch.setattr(clusters, "WORKERS_S", 1)
    tls = {
        f"distributed.comm.tls.{end}.{part}": file
        for end in ENDS
        for part, file in (("key", key), ("cert", certificate))
    }
    tls["distributed.comm.tls.ca-file"] = certificate
    with dask.config.set(tls):
        safe = {"protocol": "tls://", "security": distributed.Security(), "dashboard_address": ":0"}
        with distributed.LocalCluster(n_workers=0, **safe) as empty:
            assert empty.scheduler_address.startswith("tls://")
            with pytest.raises(InputError, match="has no workers"):
                Cluster(empty.scheduler_address, CPU)
        dask.config.set({"distributed.comm.tls.ca-file": str(tmp_path / "gone.pem")})
        with pytest.raises(InputError, match="with the certificates of Dask's configuration"):
            Cluster("tls://127.0.0.1:1", CPU)
