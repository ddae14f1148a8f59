"""Every block of the tutorial runs in a new shell, in order, in one directory, and prints what is shown."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from unittest import mock

import pytest
from printed import blocks, check_printed
from quick import PREDICTORS_KEPT, TASKS, QuickNetwork, QuickRssiConfig
from small import glances, with_defaults

from augment import cross_validation
from augment.estimators import ESTIMATORS
from augment.turbo.condition import NETWORKS
from swiftwrf import RssiModel
from swiftwrf.choices import RSSI_PREDICTORS
from swiftwrf.locate import MatchedField, MatchedFieldConfig
from tasks.command_line import command_line

FEW_CELLS = MatchedFieldConfig(max_cells=2000, n_best=40, n_background=20, n_rounds=1, n_calibration=16)
TEXT = (Path(__file__).parent.parent / "docs" / "tutorial.md").read_text()
PARTS = re.split(r"^## ", TEXT, flags=re.MULTILINE)[1:]


@pytest.mark.long
@pytest.mark.parametrize("part", PARTS, ids=[part.splitlines()[0] for part in PARTS])
def test_every_block_runs_and_prints_what_is_shown(part, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for language, block, shown in blocks(part):
        if language == "python":
            exec(block, {})
        else:
            program, name, *arguments = shlex.split(block)
            assert program == "swiftwrf"
            config, function = TASKS[name]
            with nullcontext() if shown or ".safetensors" in block else _cheap():
                assert command_line(f"tasks.{name}", config, function, arguments) == 0, block
            out = Path(arguments[arguments.index("--out") + 1] if "--out" in arguments else arguments[-1])
            assert (out if out.suffix else out / "report.html").is_file()
        check_printed(shown, capsys.readouterr().out)


@contextmanager
def _cheap() -> Iterator[None]:
    """Replace what takes long: a run without shown output is a real one of cheap parts."""
    predictors = {name: RSSI_PREDICTORS[name] for name in PREDICTORS_KEPT}
    with (
        glances(),
        mock.patch.object(MatchedField, "config_type", with_defaults(FEW_CELLS)),
        mock.patch.object(cross_validation, "FOLD_LOCATOR", FEW_CELLS),
        mock.patch.dict(ESTIMATORS._registered, dict.fromkeys(NETWORKS.values(), QuickNetwork)),
        mock.patch.object(RssiModel, "config_type", QuickRssiConfig),
        mock.patch.object(RSSI_PREDICTORS, "_registered", predictors),
    ):
        yield
