"""The README's numbers are those of the committed results."""

from __future__ import annotations

import re
from pathlib import Path

from tables import rewrite

ROOT = Path(__file__).parent.parent


def test_tables_come_from_the_results():
    text = (ROOT / "README.md").read_text()
    assert rewrite(text) == text, "run python benchmarks/tables.py"


def test_every_file_that_the_readme_names_is_there():
    for target in re.findall(r"\]\(([^)#:]+)\)", (ROOT / "README.md").read_text()):
        assert (ROOT / target).exists(), target
