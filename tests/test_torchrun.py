"""Two processes on the CPU, started by torchrun, learn what one does: a fit by gradient, the network, a whole run.

Started by torchrun, this file is the program that the test starts: it leaves what it found in the folder that it is given.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from unittest import mock

import pandas as pd
import pytest
import quick
import torch
from torch import distributed as dist

from augment import Mixed
from swiftwrf import AngularGrid, FitConfig, InputError, ModelConfig, fit, simulated_room
from swiftwrf.data.store import Store
from swiftwrf.runtime.processes import Processes
from swiftwrf.runtime.session import Session
from swiftwrf.runtime.threads import set_threads
from tasks import torchrun
from tasks.aoa.estimators import Settings, aann
from tasks.aoa.estimators.aann import AANN, AANNConfig
from tasks.cluster import connected

HERE = Path(__file__).parent
CONFIG = FitConfig(
    ModelConfig(n_primitives=8, components=("mean", "response", "attenuation", "cholesky")), steps=20, check_every=10
)
AOA = ("aoa", "--mix", 0.5, "--synthesizer", "swiftwrf", "idw", "--extra", 0, "--device", "cpu")


class Network(AANN):
    """The network of the paper, trained for one step: rounding grows to degrees with more of them."""

    def __init__(self, settings):
        super().__init__(settings, AANNConfig(steps=1, batch=5))


def run(*arguments):
    """A task on the toy, with the network of the paper."""
    with (
        mock.patch.object(quick, "QuickNetwork", Network),
        mock.patch("tasks.aoa.steps.candidates", return_value=["idw"]),
    ):
        return quick.run(*arguments)


def learnt(group=None):
    """What a fit by gradient draws, what it tells, and what two steps make of the network.

    Batches have a number that two does not divide. The network counts in double precision, in which two steps differ
    only if they are not the same.
    """
    set_threads(1)
    room = simulated_room(n=30, grid=AngularGrid.hemisphere(8, 32))
    records = []
    model = fit(room, replace(CONFIG, batch=7), progress=False, on_record=records.append, group=group)
    backbone = aann.backbone
    with mock.patch.object(aann, "backbone", lambda *how: backbone(*how).double()):
        network = AANN(Settings(room.grid, group=group), AANNConfig(steps=2, batch=5))
    network.fit(Mixed.measured(replace(room, store=Store(room.spectrum.double()))))
    estimate = network.estimate(room.spectrum.double())
    losses = torch.tensor([record["loss"] for record in (*records, *network.history)])
    return {"drawn": model.synthesize(room.position), "losses": losses, "estimate": estimate}


@pytest.fixture(scope="module")
def ended(tmp_path_factory):
    """The folder of what two processes did, and what they said."""
    folder = tmp_path_factory.mktemp("torchrun")
    honest, calls = Session.evaluated, []

    def interrupt(*arguments):
        honest(*arguments)
        calls.append(1)
        if len(calls) == 2:
            raise KeyboardInterrupt

    set_threads(1)
    with mock.patch.object(Session, "evaluated", interrupt):
        assert run(*AOA, "--out", folder / "two") == 130
    assert list((folder / "two.partial" / "steps").glob("*-fit.safetensors"))
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", __file__]
    path = os.pathsep.join([str(HERE), str(HERE.parent)])
    environment = os.environ | {"PYTHONPATH": path, "OMP_NUM_THREADS": "1"}
    done = subprocess.run([*command, str(folder)], env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[-3000:]
    return folder, done.stderr


def main(folder: Path) -> None:
    """In each of the processes."""
    codes = [run("aoa", "--resume", folder / "two.partial")]
    where = {name: int(os.environ[name.upper()]) for name in ("rank", "world_size")}
    dist.init_process_group("gloo", f"file://{folder / 'meeting'}", **where)
    codes.append(run("aoa", "--mix", 2, "--out", folder / "refused"))
    found = learnt(dist.group.WORLD)
    torch.save(found | {"codes": codes}, folder / f"{dist.get_rank()}.pt")
    dist.destroy_process_group()


def test_a_shared_fit_is_that_of_one_process(ended):
    alone = learnt()
    for rank in range(2):
        shared = torch.load(ended[0] / f"{rank}.pt")
        assert (shared["drawn"] - alone["drawn"]).abs().max() < 1e-4
        assert (shared["estimate"] - alone["estimate"]).abs().max() < 1e-4
        losses = alone["losses"] if rank == 0 else alone["losses"][-1:]  # the first one alone is told of the fit
        torch.testing.assert_close(shared["losses"], losses, rtol=1e-4, atol=0)


def test_a_run_goes_on_in_two_processes(ended):
    folder, said = ended
    set_threads(1)
    assert run(*AOA, "--out", folder / "one") == 0
    one, two = folder / "one", folder / "two"
    assert {file.name for file in two.iterdir()} == {file.name for file in one.iterdir()}
    for table, unequal in (("errors.csv", 1e-2), ("synthesis.csv", 1e-2)):
        pd.testing.assert_frame_equal(pd.read_csv(two / table), pd.read_csv(one / table), rtol=0, atol=unequal)
    histories = [pd.read_csv(run / "history.csv")[["synthesizer", "method", "step"]] for run in (one, two)]
    pd.testing.assert_frame_equal(*histories)
    environment = json.loads((two / "environment.json").read_text())
    assert (environment["processes"], environment["resumed"][0]["processes"]) == (1, 2)
    assert said.count("report: ") == 1


def test_all_processes_end_with_the_code_of_the_first_and_it_alone_speaks(ended):
    folder, said = ended
    assert [torch.load(folder / f"{rank}.pt")["codes"] for rank in range(2)] == [[0, 2], [0, 2]]
    assert said.count("error: --mix takes measured shares in (0, 1], got 2") == 1
    assert not list(folder.glob("refused*"))


def test_a_batch_has_a_row_for_each_process(monkeypatch):
    processes = Processes()
    processes.number, processes.rank = 3, 1
    assert processes.own(torch.arange(7)).tolist() == [1, 4]
    assert processes.weight(7) == pytest.approx(2 / (7 / 3))
    with pytest.raises(InputError, match="3 processes cannot share batches of 2 spectra"):
        processes.weight(2)


def test_what_torchrun_cannot_spread_is_refused(monkeypatch):
    monkeypatch.setattr(torchrun, "_others", object())
    with pytest.raises(InputError, match="use one of them"), connected("tcp://127.0.0.1:1", torch.device("cpu")):
        pass
    monkeypatch.setenv("LOCAL_WORLD_SIZE", "4")
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    with pytest.raises(InputError, match="started 4 processes on a machine of 2 GPUs"):
        torchrun.check_gpus()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
