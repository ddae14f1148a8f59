"""Provenance of the numbers of a report."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from tasks.page.page import Section, Table
from tasks.page.records import Records


def number(value: float | None, digits: int = 2) -> str:
    """Return the value with `digits` decimal places, or a dash for None."""
    return "-" if value is None else f"{value:.{digits}f}"


def provenance(runs: Sequence[Records[Any]]) -> Section:
    """Command, code, versions, machine, input and time of each run."""
    tables = []
    for run in runs:
        environment = run.environment
        packages = ", ".join(f"{name} {version}" for name, version in environment["packages"].items())
        resumed = ", ".join(
            f"{session['start']} ({_changed(session, environment)})" for session in environment.get("resumed", [])
        )
        processes = environment.get("processes", 1)
        rows = [
            *([["run", f"{run.number}: {run.folder.name}"]] if run.number else []),
            ["command", run.config["command"]],
            ["code", f"version {environment['version']}, commit {environment['commit'] or 'unknown'}"],
            ["packages", f"Python {environment['python']}, {packages}"],
            ["machine", f"{environment['device']}"],
            *([["workers", "; ".join(environment["workers"])]] if "workers" in environment else []),
            [
                "threads",
                f"{environment['threads']}; like the seed, another number changes the networks, by up to degrees",
            ],
            *([["processes", f"{processes}; as the threads"]] if processes > 1 else []),
            ["time", f"{environment['start']} to {environment.get('end', '-')}"],
            *([["resumed", resumed]] if resumed else []),
            *([f"sha256 of {name}", digest] for name, digest in environment["input_sha256"].items()),
        ]
        tables.append(Table(["", ""], rows, long=True))
    return Section("Provenance", tables=tables)


def _changed(session: dict[str, Any], first: dict[str, Any]) -> str:
    """The code of a session that went on, and what else was not as at the beginning."""
    differing = [
        f"{name} {session[name]}"
        for name in ("device", "processes")
        if name in session and session[name] != first.get(name)
    ]
    return "; ".join([f"commit {session['commit']}", *differing])
