"""A wheel installs in a clean environment and runs in a directory that contains a `tasks.py`."""

import os
import subprocess
import sys
import zipfile
from importlib.util import find_spec
from pathlib import Path

import pytest
from samples import write_survey

ROOT = Path(__file__).parent.parent


@pytest.mark.long
@pytest.mark.skipif(find_spec("hatchling") is None, reason="needs hatchling to build without a network")
def test_a_wheel_runs_beside_a_module_called_tasks(tmp_path):
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check"]
    subprocess.run(
        [*pip, "wheel", "--quiet", "--no-deps", "--no-build-isolation", "-w", str(tmp_path / "dist"), str(ROOT)],
        check=True,
    )
    (wheel,) = (tmp_path / "dist").glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        tops = {name.partition("/")[0] for name in archive.namelist()}
    assert {name for name in tops if not name.endswith(".dist-info")} == {"swiftwrf", "augment", "tasks"}

    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(tmp_path / "clean")], check=True)
    python = tmp_path / "clean" / "bin" / "python"
    subprocess.run([*pip, "--python", str(python), "install", "--quiet", "--no-deps", str(wheel)], check=True)
    # the libraries come from this environment, the project from the wheel, which is earlier on the path
    site = next((tmp_path / "clean" / "lib").glob("python*/site-packages"))
    libraries = [path for path in sys.path if path.endswith("-packages")]
    (site / "libraries.pth").write_text("\n".join(libraries) + "\n")

    empty = tmp_path / "empty"
    empty.mkdir()
    (empty / "tasks.py").write_text("raise RuntimeError('the module of the user')\n")
    run = [str(tmp_path / "clean" / "bin" / "swiftwrf"), "inspect", str(write_survey(tmp_path / "walk"))]
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    subprocess.run([*run, "--out", "page"], cwd=empty, env=environment, check=True)
    assert (empty / "page" / "report.html").is_file()
