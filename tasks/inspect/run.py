"""Inspect measurements before a model is fitted."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from swiftwrf.array.beamforming import PHASE
from swiftwrf.data import Rssi, Snapshots
from swiftwrf.data.formats import RSSI_FORMATS, SNAPSHOT_FORMATS, SPECTRA_FORMATS, read
from swiftwrf.diagnostics.inspection import inspect, propose_offsets
from swiftwrf.runtime.durable import write_json
from tasks.directory import new_directory
from tasks.environment import stamp
from tasks.inspect.options import InspectConfig
from tasks.inspect.page import page
from tasks.page.page import write_page
from tasks.source import located, reading
from tasks.terminal import terminal


def run(config: InspectConfig) -> None:
    """Print the findings, and write a page and inspect.json.

    Raises:
        InputError: Measurements that cannot be read.
    """
    source, options = located(config.source), reading(config.spectra, config.table)
    out = Path(config.out) if config.out else Path("runs") / "inspect" / stamp()
    with new_directory(out, "an inspection") as folder:
        data = read(source, options, SPECTRA_FORMATS, SNAPSHOT_FORMATS, RSSI_FORMATS)
        kind = "RSSI" if isinstance(data, Rssi) else "array snapshots" if isinstance(data, Snapshots) else "spectra"
        findings = inspect(data, grid=options.grid, beamformer=options.beamformer or PHASE)
        for column in data.labels if isinstance(data, Rssi) else ():
            propose_offsets(read(source, replace(options, offset_by=column), RSSI_FORMATS), findings)
        content = {
            "source": config.source,
            "kind": kind,
            "findings": [{"level": finding.level, "text": finding.text} for finding in findings.sentences],
            "numbers": findings.numbers,
        }
        write_json(folder / "inspect.json", content)
        write_page(folder, page(findings, kind, str(config.source)))
    terminal.page(content, f"{config.source}: {kind}\n{findings}", out / "report.html")
