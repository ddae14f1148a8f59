"""Fixtures of several tests: toy scenes, and the measured data if available."""

import os
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from unittest import mock

import pytest
import torch
from filelock import FileLock
from PIL import Image
from small import FLOOR, known_planes, small

from swiftwrf import AngularGrid, GeometryModel, InputError, Spectra, make_model, simulated_room
from swiftwrf.contrib.raytraced import sionna
from swiftwrf.data.writing import write_spectra

collect_ignore = ["cuda_shim"]  # programs of tests, which have no examples
torch.set_num_threads(1)  # tests run side by side, and mocks reach steps that are computed in this process alone
os.environ["OMP_NUM_THREADS"] = "1"


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Skips what this machine cannot run and what is long, with the reason."""
    for item in items:
        if item.get_closest_marker("fuzz") and "fuzz" not in config.option.markexpr:
            item.add_marker(pytest.mark.skip(reason="long: run it with -m fuzz"))
        if item.get_closest_marker("cuda") and not torch.cuda.is_available():
            item.add_marker(pytest.mark.skip(reason="needs an NVIDIA GPU"))
        if item.get_closest_marker("data") and not os.environ.get("SWIFTWRF_DATA"):
            item.add_marker(pytest.mark.skip(reason="needs the measured data: set SWIFTWRF_DATA to their folder"))


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Tests of all synthesizers skip the one whose extra is missing."""
    if getattr(item, "callspec", None) and item.callspec.params.get("name") == "raytrace":
        _sionna_or_skip()


def _sionna_or_skip() -> None:
    try:
        sionna()
    except InputError as error:
        pytest.skip(str(error))


@pytest.fixture
def ray_tracer() -> None:
    """Sionna RT, or a reason to skip."""
    _sionna_or_skip()


@pytest.fixture(scope="session")
def room() -> Spectra:
    """Forty spectra of the simulated room on a small grid."""
    return simulated_room(n=40, seed=0, grid=AngularGrid.hemisphere(15, 60))


@pytest.fixture(scope="session")
def built_in_room() -> tuple[Spectra, Spectra]:
    """Training and test spectra of the simulated room as the tasks use it, but on a smaller grid."""
    return simulated_room(grid=AngularGrid.hemisphere(15, 60)).split()


@pytest.fixture(scope="session")
def measured_data() -> Path:
    """The folder of the measured data sets."""
    return Path(os.environ["SWIFTWRF_DATA"])


def during_a_test(context: Callable[..., AbstractContextManager[None]], *arguments: object) -> Callable[..., object]:
    """Return a fixture that is in this context."""

    @pytest.fixture
    def entered() -> Iterator[None]:
        with context(*arguments):
            yield

    return entered


small_published = during_a_test(small, "published")
short_searches = during_a_test(small, "searches")
short_fits = during_a_test(small, "kernels", "distributions", "path gains")
floor_alone = during_a_test(known_planes, FLOOR)  # the only plane that any search finds


@pytest.fixture(scope="module")
def without_furniture() -> Iterator[None]:
    """No search for furniture, which takes most of the time of a fit to channels, and has tests of its own."""
    with mock.patch.object(GeometryModel, "furnish"):
        yield


@pytest.fixture
def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def made_once(factory: pytest.TempPathFactory, name: str, make: Callable[[Path], None]) -> Path:
    """Return a folder that the first of all workers makes, and that no test changes."""
    base = factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / name
    with FileLock(f"{folder}.lock"):
        if not folder.exists():
            folder.mkdir()
            make(folder)
    return folder


@pytest.fixture(scope="session")
def aoa_run(tmp_path_factory: pytest.TempPathFactory, room: Spectra) -> Path:
    """A run of angle of arrival on files, whose second model does not know its deviation."""
    import quick  # the tasks are imported by the tests that run them

    def make(folder: Path) -> None:
        (folder / "data").mkdir()
        write_spectra(room, folder / "data")
        options = ("--synthesizer", "swiftwrf", "--extra", 0, "--data", folder / "data", "--out", folder / "run")
        with mock.patch("augment.turbo.experiment.candidates", return_value=["idw"]), quick.recorded(folder):
            assert quick.run("aoa", "--mix", 0.5, 1, *options, drawn=True) == 0
        make_model("idw").fit(room).save(folder / "run" / "swiftwrf-mix1.safetensors")

    return made_once(tmp_path_factory, "aoa", make) / "run"


@pytest.fixture(scope="session")
def rssi_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of RSSI at three receivers, over a floor plan."""
    import quick

    def make(folder: Path) -> None:
        Image.new("RGB", (40, 30), "white").save(folder / "plan.png")
        plan = ("--floor-plan", folder / "plan.png", "--floor-extent", 0, 20, 0, 15)
        with quick.recorded(folder):
            assert quick.run("rssi", "--rx", 1, 6, 12, *plan, "--out", folder / "run", drawn=True) == 0

    return made_once(tmp_path_factory, "rssi", make) / "run"


@pytest.fixture(scope="session")
def locate_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that locates on the built-in floor."""
    import quick

    def make(folder: Path) -> None:
        with quick.recorded(folder):
            Image.new("RGB", (40, 30), "white").save(folder / "plan.png")
            plan = ("--floor-plan", folder / "plan.png", "--floor-extent", 0, 20, 0, 15)
            assert quick.run("locate", "--cells", 300, *plan, "--out", folder / "run", drawn=True) == 0

    return made_once(tmp_path_factory, "locate", make) / "run"
