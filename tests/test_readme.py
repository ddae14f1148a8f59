"""The numbers of README and docs are those of the committed results, and their Python blocks run."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import torch
from printed import blocks, check_printed
from tables import FILES, rewrite

import swiftwrf
from augment import Mixed
from swiftwrf import AngularGrid, load, simulated_room

ROOT = Path(__file__).parent.parent


@pytest.mark.parametrize("name", FILES)
def test_tables_come_from_the_results(name):
    text = (ROOT / name).read_text()
    assert rewrite(text) == text, "run python benchmarks/tables.py"


def test_each_public_name_has_a_line_in_the_reference():
    documented = re.findall(r"^::: swiftwrf\.\S*?(\w+)$", (ROOT / "docs" / "api.md").read_text(), flags=re.MULTILINE)
    assert [name for name in swiftwrf.__all__ if documented.count(name) != 1] == []
    assert len(swiftwrf.__all__) <= 30, "a new name takes the place of another one"


def anchors(page: Path) -> set[str]:
    """Return the anchors of the headings of a Markdown page."""
    headings = re.findall(r"^#+ (.*)$", re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL), flags=re.MULTILINE)
    return {re.sub(r"[^\w -]", "", heading).strip().lower().replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("name", [*FILES, "CONTRIBUTING.md"])
def test_links_of_a_page_lead_to_files_and_headings(name):
    page = ROOT / name
    for target, _, anchor in (link.partition("#") for link in re.findall(r"\]\(([^):]+)\)", page.read_text())):
        linked = page.parent / target if target else page
        assert linked.exists(), target
        if anchor:
            assert anchor in anchors(linked), f"{target}#{anchor}"


def run_blocks(name: str, capsys: pytest.CaptureFixture[str] | None = None) -> dict[str, object]:
    """Run the Python blocks of a page in the working directory and return their names; `capsys` compares what they print."""
    names: dict[str, object] = {"__name__": "documented"}
    for language, block, shown in blocks((ROOT / name).read_text()):
        if language == "python":
            exec(block, names)
            if capsys and shown:
                check_printed(shown, capsys.readouterr().out)
    return names


@pytest.mark.long
def test_the_readme_prints_what_it_shows(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    names = run_blocks("README.md", capsys)
    assert len(names["measured"]) == 72


@pytest.mark.long
@pytest.mark.parametrize("name", ["formats", "locating", "update"])
def test_blocks_of_reference_and_how_to_run(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run_blocks(f"docs/{name}.md")


def test_the_checks_run_the_test_command_of_the_readme():
    (command,) = re.findall(r"pip install -e '\.\[dev\]' && (pytest .*)", (ROOT / "README.md").read_text())
    assert any(line.startswith(command) for line in (ROOT / ".ci" / "run").read_text().splitlines())


def test_documented_extensions_work(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = run_blocks("docs/development/architecture.md")
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
