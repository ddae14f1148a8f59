"""The number of threads: restored whoever uses it, and however users overlap."""

import threading
from collections.abc import Iterator

import pytest
import scipy.linalg  # noqa: F401  # loads its library
import torch
from test_rssi_model import with_field
from threadpoolctl import ThreadpoolController, threadpool_limits

from swiftwrf import fit, fit_rssi
from swiftwrf.runtime.threads import parallel_map, single_thread, threads_kept


@pytest.fixture(autouse=True)
def four_threads() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(4)
    with threadpool_limits(4, user_api="blas"):
        yield
    torch.set_num_threads(before)


def of_linear_algebra() -> set[int]:
    """Return the numbers of threads of the linear algebra of NumPy and SciPy."""
    return {library["num_threads"] for library in ThreadpoolController().select(user_api="blas").info()}


def in_a_new_thread() -> int:
    """Return torch's number of threads in a thread that starts now."""
    found: list[int] = []
    thread = threading.Thread(target=lambda: found.append(torch.get_num_threads()))
    thread.start()
    thread.join()
    return found[0]


def test_users_of_several_threads_may_overlap():
    """The first to come is the first to go: the second must not restore what the first had set."""
    first_in, second_in, first_out = (threading.Event() for _ in range(3))

    def first() -> None:
        with single_thread():
            first_in.set()
            second_in.wait()
        first_out.set()

    def second() -> None:
        first_in.wait()
        with single_thread():
            second_in.set()
            first_out.wait()

    threads = [threading.Thread(target=user) for user in (first, second)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert in_a_new_thread() == 4
    assert of_linear_algebra() == {4}


def test_users_may_be_nested():
    with single_thread():
        with threads_kept():
            torch.set_num_threads(3)
        with single_thread():
            assert of_linear_algebra() == {1}
        assert torch.get_num_threads() == 1
        assert of_linear_algebra() == {1}
    assert of_linear_algebra() == {4}
    assert torch.get_num_threads() == 4


def test_each_of_several_threads_uses_one():
    def uses_threads(_: int) -> int:
        with threads_kept():
            torch.set_num_threads(2)
        return torch.get_num_threads()

    assert parallel_map(uses_threads, range(8)) == [1] * 8
    assert torch.get_num_threads() == in_a_new_thread() == 4


@pytest.mark.parametrize(("kind", "tolerance"), [("spectra", 1e-5), ("RSSI", 0.0)])
def test_any_number_of_threads_gives_the_same_model(room, kind, tolerance):
    def fitted(threads: int) -> dict[str, torch.Tensor]:
        with threads_kept():
            torch.set_num_threads(threads)
            if kind == "spectra":
                return fit(room, n_primitives=32).state()[0]
            found = fit_rssi(with_field()).predict(with_field(seed=1).transmitter_position)
            assert torch.get_num_threads() == threads
        return {"mean": found.mean, "std": found.std}

    one, two = fitted(1), fitted(2)
    for name, value in one.items():
        torch.testing.assert_close(two[name], value, atol=tolerance, rtol=tolerance, equal_nan=True, msg=name)
