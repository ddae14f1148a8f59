"""README, docs and notebooks: their numbers are those of the committed results, they run, and print what they show."""

import ast
import json
import re
import shlex
from contextlib import nullcontext
from pathlib import Path

import matplotlib
import numpy as np
import pytest
import torch
from matplotlib import pyplot
from packaging.version import Version
from quick import cheap, command, sketched
from record import RESULTS, loaded, origins
from small import FLOOR, known_planes
from tables import FILES, rewrite

import swiftwrf
from swiftwrf import AngularGrid, simulated_room
from swiftwrf.testing import check_reader

ROOT = Path(__file__).parent.parent
FENCES = re.compile(r"```(python|bash)\n(.*?)```(?:\n+```text\n(.*?)```)?", flags=re.DOTALL)  # with its output
NUMBER = re.compile(r"-?\d[\d,]*\.?\d*")
# results with rows that are older than the release: hours or days of processor time. Tables name the oldest commit.
OLD = {"aoa_newrf_office", "comparison", "locating_rssi", "paper_scale"}
TOLERANCE = 0.15  # of a number, relative: processors round differently, by which networks differ, and library versions
TUTORIAL = re.split(r"^## ", (ROOT / "docs" / "tutorial.md").read_text(), flags=re.MULTILINE)[1:]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
MAX_BYTES = 300_000  # of a notebook


@pytest.mark.parametrize("name", FILES)
def test_tables_come_from_the_results(name):
    text = (ROOT / name).read_text()
    assert rewrite(text) == text, "run python benchmarks/tables.py"


def shown_results() -> list[str]:
    """Return the names of the results that tables of README and docs show."""
    first = len(loaded)
    for name in FILES:
        rewrite((ROOT / name).read_text())
    return sorted(set(loaded[first:]))


@pytest.mark.parametrize("name", shown_results())
def test_a_shown_result_is_of_the_last_release_or_later_and_of_a_command_that_exists(name):
    if name in OLD:
        oldest = min(origins(name), key=lambda row: (row["date"], row["commit"]))
        assert f"commit {oldest['commit']})" in (ROOT / "docs" / "results.md").read_text()
        return
    released = re.findall(r"^## \[(\d[\d.]*)\]", (ROOT / "CHANGELOG.md").read_text(), flags=re.MULTILINE)[0]
    for row in origins(name):
        assert Version(row["versions"]["swiftwrf-tasks"]) >= Version(released), f"measure again: {row}"
        assert "dirty" not in row["commit"]
        script = row["command"].removeprefix("python ").split()[0]
        assert script in {"swiftwrf", "-m"} or (ROOT / "benchmarks" / script).is_file(), row["command"]


def test_each_result_is_shown():
    assert sorted(file.stem for file in RESULTS.glob("*.json")) == shown_results()


def test_each_public_name_has_a_line_in_the_reference():
    documented = re.findall(r"^::: swiftwrf\.\S*?(\w+)$", (ROOT / "docs" / "api.md").read_text(), flags=re.MULTILINE)
    assert [name for name in swiftwrf.__all__ if documented.count(name) != 1] == []
    assert len(swiftwrf.__all__) <= 31, "a new name takes the place of another one"


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


def check_printed(shown: str, printed: str) -> None:
    """Compare the lines of a document with the lines of a program. `...` stands for any number of lines."""
    found = iter([" ".join(line.split()) for line in printed.splitlines()])
    for line in (" ".join(line.split()) for line in shown.splitlines() if line.strip() not in {"", "..."}):
        assert any(_alike(line, other) for other in found), f"not printed, or in another order: {line}\n{printed}"


def _alike(line: str, other: str) -> bool:
    if NUMBER.sub("#", line) != NUMBER.sub("#", other):
        return False
    numbers = ([float(number.replace(",", "")) for number in NUMBER.findall(text)] for text in (line, other))
    return all(abs(a - b) <= TOLERANCE * max(abs(a), abs(b)) for a, b in zip(*numbers, strict=True))


def run_blocks(name: str, capsys: pytest.CaptureFixture[str] | None = None) -> dict[str, object]:
    """Run the Python blocks of a page in the working directory and return their names; `capsys` compares what they print."""
    names: dict[str, object] = {"__name__": "documented"}
    for language, block, shown in FENCES.findall((ROOT / name).read_text()):
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
@pytest.mark.parametrize("name", ["formats", "locating", "python", "update"])
def test_blocks_of_reference_and_how_to_run(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with cheap(), known_planes(FLOOR):
        run_blocks(f"docs/{name}.md")


def test_the_checks_run_the_test_command_of_the_readme():
    (command,) = re.findall(r"pip install -e '\.\[dev\]' && (pytest .*)", (ROOT / "README.md").read_text())
    assert any(line.startswith(command) for line in (ROOT / ".ci" / "run").read_text().splitlines())


def test_documented_extensions_work(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = run_blocks("docs/development/architecture.md")
    room = simulated_room(n=30, grid=AngularGrid.hemisphere(15, 60))
    np.savez("measured.npz", spectra=room.spectrum, positions=room.position)
    check_reader(names["TwoArrays"], tmp_path)
    torch.testing.assert_close(names["TwoArrays"]().read(tmp_path, None).spectrum, room.spectrum)


@pytest.mark.long
@pytest.mark.parametrize("part", TUTORIAL, ids=[part.splitlines()[0] for part in TUTORIAL])
def test_every_block_of_the_tutorial_runs_and_prints_what_is_shown(part, tmp_path, monkeypatch, capsys):
    """In order, in one directory. A run without shown output is a real one of cheap parts."""
    monkeypatch.chdir(tmp_path)
    for place in ("augment.turbo.experiment", "augment.choose"):
        monkeypatch.setattr(f"{place}.candidates", lambda data: ["idw", "gp"])
    for language, block, shown in FENCES.findall(part):
        if language == "python":
            exec(block, {})
        else:
            program, *arguments = shlex.split(block)
            assert program == "swiftwrf"
            with nullcontext() if shown else cheap(), sketched():
                assert command(*arguments) == 0, block
            out = Path(arguments[arguments.index("--out") + 1] if "--out" in arguments else arguments[-1])
            assert (out if out.suffix else out / "report.html").is_file()
        check_printed(shown, capsys.readouterr().out)


@pytest.mark.parametrize("file", NOTEBOOKS, ids=lambda file: file.stem)
def test_committed_outputs_are_small_and_without_errors(file):
    cells = [cell for cell in json.loads(file.read_text())["cells"] if cell["cell_type"] == "code"]
    assert file.stat().st_size < MAX_BYTES
    assert [cell["execution_count"] for cell in cells] == [*range(1, len(cells) + 1)], "run the notebook from the top"
    kinds = {output["output_type"] for cell in cells for output in cell["outputs"]}
    assert "display_data" in kinds
    assert "error" not in kinds


@pytest.mark.long
@pytest.mark.parametrize("file", NOTEBOOKS, ids=lambda file: file.stem)
def test_notebooks_run(file, tmp_path, monkeypatch):
    """In this process and of cheap parts: the kernel is that of others, and accuracy has its own tests."""
    monkeypatch.chdir(tmp_path)
    matplotlib.use("agg")
    names: dict[str, object] = {"__name__": "notebook"}
    with cheap(), known_planes(FLOOR):
        for cell in json.loads(file.read_text())["cells"]:
            if cell["cell_type"] == "code":
                exec("".join(cell["source"]), names)
    pyplot.close("all")


def test_refusals_of_the_document_are_those_of_the_code():
    """Each quoted sentence stands in a literal of the code, whose parts are joined as Python joins them."""
    literals = []
    for folder in ("swiftwrf", "tasks"):
        for file in (ROOT / folder).rglob("*.py"):
            for node in ast.walk(ast.parse(file.read_text())):
                if isinstance(node, ast.JoinedStr):
                    parts = (part.value if isinstance(part, ast.Constant) else "\0" for part in node.values)
                    literals.append("".join(map(str, parts)))
                elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                    literals.append(node.value)
    table = (ROOT / "docs" / "troubleshooting.md").read_text().split("\n\n")[2]
    sentences = re.findall(r"^\| `([^`]+)`", table, flags=re.MULTILINE)
    assert len(sentences) == 10
    assert [one for one in sentences if not any(one in literal for literal in literals)] == []
