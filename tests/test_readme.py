"""The numbers of README and docs are those of the committed results."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from tables import FILES, rewrite

ROOT = Path(__file__).parent.parent


@pytest.mark.parametrize("name", FILES)
def test_tables_come_from_the_results(name):
    text = (ROOT / name).read_text()
    assert rewrite(text) == text, "run python benchmarks/tables.py"


@pytest.mark.parametrize("name", FILES)
def test_every_file_that_a_page_names_is_there(name):
    for target in re.findall(r"\]\(([^)#:]+)\)", (ROOT / name).read_text()):
        assert ((ROOT / name).parent / target).exists(), target
