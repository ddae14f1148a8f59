"""Steps in processes of `concurrent.futures`: they compute, or the call ends with a sentence; none waits for ever."""

import os
import signal
import subprocess
import sys
import textwrap
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import nullcontext
from multiprocessing import get_context

import pytest

from augment import turbo_learning
from swiftwrf import AngularGrid, InputError, simulated_room
from swiftwrf.data.simulated import rssi_room
from swiftwrf.models.neighbours import IDWModel
from swiftwrf.rssi import compare

DATA = simulated_room(n=30, grid=AngularGrid.hemisphere(8, 32))
OPTIONS = {"measured": 0.5, "models": ["idw"], "estimators": ["peak"], "extra": 0}
AFTER = """
    import multiprocessing, torch, swiftwrf, augment
    from concurrent.futures import ProcessPoolExecutor
    fork = multiprocessing.get_context("fork")
    data = swiftwrf.simulated_room(n=30, grid=swiftwrf.AngularGrid.hemisphere(8, 32))
    torch.rand(2000, 2000).exp() @ torch.rand(2000, 2000)  # starts the threads of OpenMP
"""
IN_PROCESSES = """
    with ProcessPoolExecutor(2, mp_context=fork) as executor:
        options = dict(measured=0.5, models=["idw"], estimators=["peak"], extra=0)
        print(len(augment.turbo_learning(data, **options, executor=executor).summary()))
"""
RASTERIZED = """
    from swiftwrf.models.swiftwrf_paper import SwiftWRFPaper
    model = SwiftWRFPaper(n_primitives=3, steps=12, check_every=6).fit(data)

    def attempt(function, *arguments):
        try:
            function(*arguments)
        except swiftwrf.InputError as error:
            print(error)

    with fork.Pool(1) as pool:
        attempt(pool.apply, model.synthesize, (data.position,))
    with ProcessPoolExecutor(1, mp_context=fork) as executor:
        options = dict(measured=0.5, models=[SwiftWRFPaper(model.config)], estimators=["peak"], extra=0, executor=executor)
        attempt(lambda: augment.turbo_learning(data, **options))
"""


def printed(code):
    """Return the lines that code prints in a process with two threads."""
    environment = os.environ | {"OMP_NUM_THREADS": "2"}
    call = [sys.executable, "-c", textwrap.dedent(code)]
    return subprocess.run(call, env=environment, capture_output=True, text=True, check=True, timeout=120).stdout.split(
        "\n"
    )


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no forks")
def test_forks_of_a_process_that_has_computed_in_threads_compute():
    """They waited for ever for threads of OpenMP that they do not have."""
    assert printed(AFTER + IN_PROCESSES)[0] == "4"


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no forks")
def test_forks_of_a_process_that_has_rasterized_refuse_to():
    """OpenMP ended them by a signal, for which the pool of a user waited for ever."""
    pytest.importorskip("numba")
    said = printed(AFTER + RASTERIZED)
    assert len(said) == 3
    assert all(
        "does not work in a process forked from one that used it; start processes by spawn" in s for s in said[:2]
    )


class Killed(IDWModel):
    name = "killed"

    def synthesize(self, position):
        os.kill(os.getpid(), signal.SIGKILL)


def local():
    class Local(IDWModel):
        name = "local"

    return Local()


def shut(executor):
    executor.shutdown()
    return executor


def processes():
    return ProcessPoolExecutor(1, mp_context=get_context("fork"))


@pytest.mark.parametrize(
    ("model", "executor", "words"),
    [
        ("idw", lambda: shut(processes()), "cannot schedule new futures after shutdown"),
        ("idw", lambda: shut(ThreadPoolExecutor(1)), "cannot schedule new futures after shutdown"),
        (local(), processes, "Can't (pickle|get) local object"),
        (Killed(), processes, "terminated abruptly"),
    ],
    ids=["shut processes", "shut threads", "local class", "killed"],
)
def test_an_executor_that_cannot_compute_is_refused_in_a_sentence(model, executor, words):
    one = executor()
    with pytest.raises(InputError, match=rf"^the executor does not compute the steps \(.*{words}.*leave it out$"):
        turbo_learning(DATA, **OPTIONS | {"models": [model]}, executor=one)
    one.shutdown()


def test_an_executor_of_rssi_that_is_shut_down_is_refused_too():
    with pytest.raises(InputError, match="the executor does not compute"):
        compare(rssi_room(n=60), receivers=["6"], executor=shut(processes()))


class Wrong(IDWModel):
    name = "wrong"

    def synthesize(self, position):
        raise AttributeError("of my own")


@pytest.mark.parametrize("executor", [processes, lambda: ThreadPoolExecutor(1), nullcontext])
def test_errors_of_ones_own_code_stay_as_they_are(executor):
    with executor() as one, pytest.raises(AttributeError, match=r"^of my own$"):
        turbo_learning(DATA, **OPTIONS | {"models": [Wrong()]}, executor=one)
