"""The numbers of README and docs are those of the committed results, and their Python blocks run."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import torch
from tables import FILES, rewrite

from augment import Mixed
from swiftwrf import AngularGrid, load, simulated_room
from swiftwrf.data.writing import write_spectra

ROOT = Path(__file__).parent.parent


@pytest.mark.parametrize("name", FILES)
def test_tables_come_from_the_results(name):
    text = (ROOT / name).read_text()
    assert rewrite(text) == text, "run python benchmarks/tables.py"


@pytest.mark.parametrize(
    "name",
    [*FILES, "docs/architecture.md", "docs/conventions.md", "docs/formats.md", "docs/locating.md", "docs/view.md"],
)
def test_every_file_that_a_page_names_is_there(name):
    for target in re.findall(r"\]\(([^)#:]+)\)", (ROOT / name).read_text()):
        assert ((ROOT / name).parent / target).exists(), target


def run_blocks(name: str) -> dict[str, object]:
    """Run the Python blocks of a page in the working directory and return their names."""
    names: dict[str, object] = {"__name__": "documented"}
    for block in re.findall(r"```python\n(.*?)```", (ROOT / name).read_text(), flags=re.DOTALL):
        exec(block, names)
    return names


def test_readme_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "DIR").mkdir()
    write_spectra(simulated_room(n=60, grid=AngularGrid.hemisphere(15, 60)), tmp_path / "DIR")
    names = run_blocks("README.md")
    assert names["prediction"].std.shape == names["prediction"].mean.shape == (len(names["test"]), 15, 60)


def test_documented_extensions_work(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = run_blocks("docs/architecture.md")
    room = simulated_room(n=30, grid=AngularGrid.hemisphere(15, 60))
    mean = names["MeanModel"]().fit(room)
    mean.save("mean.safetensors")
    torch.testing.assert_close(
        load("mean.safetensors").predict(room.position[:2]).mean, mean.predict(room.position[:2]).mean
    )
    np.save("spectra.npy", room.spectrum)
    np.save("positions.npy", room.position)
    reader = names["TwoArrays"]()
    assert reader.recognises(tmp_path)
    torch.testing.assert_close(reader.read(tmp_path, None).spectrum, room.spectrum)
    estimator = names["MeanDirection"]().fit(Mixed.measured(room))
    torch.testing.assert_close(estimator.predict(room.spectrum)[0], room.label.mean(dim=0))
