"""Every block of the tutorial runs in a new shell, in order, in one directory. Long steps are made cheaper."""

from __future__ import annotations

import re
import shlex
from pathlib import Path
from unittest import mock

import pytest
from quick import PREDICTORS_KEPT, TASKS, QuickNetwork, QuickRssiConfig
from small import glances

from augment.estimators import ESTIMATORS
from augment.turbo.condition import NETWORKS
from swiftwrf import RssiModel
from swiftwrf.choices import RSSI_PREDICTORS
from swiftwrf.rssi import RssiConfig
from tasks.command_line import command_line

TEXT = (Path(__file__).parent.parent / "docs" / "tutorial.md").read_text()
PARTS = re.split(r"^## ", TEXT, flags=re.MULTILINE)[1:]


@pytest.mark.long
@pytest.mark.parametrize("part", PARTS, ids=[part.splitlines()[0] for part in PARTS])
def test_every_block_runs(part, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for language, block in re.findall(r"```(python|bash)\n(.*?)```", part, flags=re.DOTALL):
        if language == "python":
            exec(block, {})
            continue
        python, dash_m, module, *arguments = shlex.split(block)
        assert [python, dash_m] == ["python", "-m"]
        name = module.removeprefix("tasks.")
        config, function = TASKS[name]
        rssi_config = (
            RssiConfig if ".safetensors" in block else QuickRssiConfig
        )  # files open with the class of their kind
        with (
            glances(),
            mock.patch.dict(ESTIMATORS._registered, dict.fromkeys(NETWORKS.values(), QuickNetwork)),
            mock.patch.object(RssiModel, "config_type", rssi_config),
            mock.patch.object(
                RSSI_PREDICTORS, "_registered", {name: RSSI_PREDICTORS[name] for name in PREDICTORS_KEPT}
            ),
        ):
            assert command_line(module, config, function, arguments) == 0, block
        out = Path(arguments[arguments.index("--out") + 1] if "--out" in arguments else arguments[-1])
        assert (out if out.suffix else out / "report.html").is_file()
