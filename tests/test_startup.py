"""Help and refusals answer at once: they import none of the packages that compute or draw."""

import json
import subprocess
import sys

import pytest

import augment
import swiftwrf
from swiftwrf.array.beamforming import BEAMFORMERS
from swiftwrf.choices import FIELD_MODELS, RSSI_PREDICTORS
from swiftwrf.contrib.comparison.localizers import LOCALIZERS
from swiftwrf.contrib.raytraced import ROOMS as BUILT_IN_ROOMS
from swiftwrf.contrib.raytraced.names import ROOMS
from tasks import labels
from tasks.command import COMMANDS

HEAVY = ("torch", "torchvision", "numba", "sklearn", "matplotlib", "scipy", "pandas")
RUN = """
import json, sys
from tasks.command import main
for arguments in json.loads(sys.argv[1]):
    try:
        code = main(arguments)
    except SystemExit as end:
        code = end.code
    print(json.dumps([code, [name for name in sys.argv[2:] if name in sys.modules]]), file=sys.stderr)
"""
WRONG = [
    "aoa --no-such-option",
    "aoa --mix 0.3 --seed x",
    "aoa --mix 2",
    "aoa --mix 0.3 --synthesizer none",
    "aoa --mix 0.3 --suggest 1000",
    "convert x y --beamformer none",
    "rssi --rx 1 --also none",
    "rssi --rx 1 --floor-extent 3 2 1 0",
    "locate --cells 1",
    "inspect x --grid 1 1",
    "convert x y --split block",
    "predict x y --array 4 0 1e9",
    "aoa --mix 0.3 --read x.yaml",
    "view x --port -1",
    "scenes --room none --moving receiver --positions 9 --out x",
    "resume x",
]


@pytest.mark.parametrize(
    ("lines", "code"), [([f"{name} --help" for name in COMMANDS], 0), (WRONG, 2)], ids=["help", "wrong options"]
)
def test_help_and_refusals_import_nothing_heavy(lines, code):
    """One process for all of them: the first line that imports something heavy is the one that fails."""
    given = json.dumps([line.split() for line in lines])
    done = subprocess.run([sys.executable, "-c", RUN, given, *HEAVY], capture_output=True, text=True, check=True)
    found = [json.loads(line) for line in done.stderr.splitlines() if line.startswith("[")]
    assert dict(zip(lines, found, strict=True)) == {line: [code, []] for line in lines}


def imported(code: str) -> tuple[int, list[str]]:
    """Run code in a new process. Return its exit code, and the heavy packages that it imported."""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    exit_code, *modules = done.stderr.splitlines()[-1].split()
    return int(exit_code), sorted({*HEAVY} & {*modules})


@pytest.mark.parametrize("package", ["swiftwrf", "augment", "swiftwrf.choices"])
def test_packages_import_their_members_at_first_use(package):
    assert imported(f"import {package}, sys; print(0, *sys.modules, file=sys.stderr)") == (0, [])


def test_every_member_of_a_lazy_package_exists():
    for package in (swiftwrf, augment):
        assert {*package.__all__} <= {*dir(package)}
        for name in package.__all__:
            assert getattr(package, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'nowhere'"):
        _ = swiftwrf.nowhere


def test_documented_submodules_need_no_import_and_hide_no_function_of_their_name():
    code = """
import augment, swiftwrf, sys
names = swiftwrf.rssi.compare, swiftwrf.locate.compare, swiftwrf.metrics.angle_errors, swiftwrf.datasets, augment.estimators
import augment.mix, swiftwrf.contrib.rasterize.cpu
print(int(not callable(swiftwrf.rasterize) or not callable(augment.mix)), file=sys.stderr)
"""
    assert imported(code)[0] == 0


def test_other_threads_import_as_usual_while_a_package_starts():
    code = """
import builtins, sys
eager, unchanged = builtins.__import__, []
sys.setprofile(lambda *_: unchanged.append(builtins.__import__ is eager))
import swiftwrf, augment
sys.setprofile(None)
print(int(not all(unchanged)), file=sys.stderr)
"""
    assert imported(code) == (0, [])


@pytest.mark.parametrize(
    ("registry", "known"),
    [
        (FIELD_MODELS, labels.FIELD_MODELS),
        (BEAMFORMERS, labels.BEAMFORMERS),
        (RSSI_PREDICTORS, labels.PREDICTORS),
        (LOCALIZERS, labels.LOCALIZERS),
    ],
    ids=["field models", "beamformers", "predictors", "localizers"],
)
def test_what_is_declared_has_a_label_and_can_be_imported(registry, known):
    assert {*registry} == {*known}
    for name in registry:
        assert callable(registry[name])
        assert isinstance(registry, dict) or registry.summary(name)
        assert getattr(registry[name], "name", name) == name


def test_every_room_has_a_description():
    assert {*ROOMS} == {*BUILT_IN_ROOMS}
