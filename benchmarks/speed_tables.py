"""Tables of rates, seconds and memory: on a GPU, and against the amount of data."""

from __future__ import annotations

from record import load, markdown


def gpu_rates() -> str:
    """Return spectra per second on a GPU by number of primitives and batch size."""
    rates = ("forward", "forward_backward", "model", "synthesize")
    rows = [
        [f"{row['n']:,}", f"{row['batch']:,}", *(f"{row[f'{name}_per_s']['median']:,.0f}" for name in rates)]
        for row in load("gpu_rates")["rows"]
    ]
    columns = ["primitives", "batch", "forward", "forward and backward", "model", "synthesize"]
    return markdown(columns, rows)


def gpu_seconds() -> str:
    """Return seconds of the fits on a GPU."""
    return markdown(["fit", "seconds"], [[name, f"{s:.1f}"] for name, s in load("gpu_training")["seconds"].items()])


def gpu_launches() -> str:
    """Return the number of operations of a model for a batch, and the seconds that a batch of 64 takes on a GPU."""
    row = next(row for row in load("gpu_rates")["rows"] if (row["n"], row["batch"]) == (1000, 64))
    milliseconds = [f"{64e3 / row[f'{name}_per_s']['median']:.2f} ms" for name in ("forward", "model", "synthesize")]
    rows = [[str(load("gpu_launches")["operations"]), *milliseconds]]
    columns = ["operations before the rasterizer", "forward, 64 spectra", "model", "synthesize"]
    return markdown(columns, rows)


def profiles(min_share: float = 0.1) -> str:
    """Return the steps, models and locators that take a tenth of the time of a command or more."""
    kinds = (
        "augment.turbo.stages",
        "augment.choose",
        "augment.cross",
        "swiftwrf.models.geometry",
        "swiftwrf.locate",
        "tasks.page",
    )
    rows = [
        [f"{name}, {found['seconds']:.0f} s", f"`{row['function']}`", f"{row['below']:.0%}"]
        for name, found in load("profiles").items()
        if isinstance(found, dict) and "functions" in found
        for row in found["functions"]
        if row["function"].startswith(kinds) and row["below"] >= min_share and "<" not in row["function"]
    ]
    return markdown(["command", "function", "share, with all below"], rows)


def surveys() -> str:
    """Return seconds and memory of surveys of many receivers and rows, beside those of an earlier commit."""
    names = {
        "first": "`swiftwrf rssi` on the simulated floor",
        "one": "`swiftwrf rssi --rx 6` on that floor",
        "aoa": "`swiftwrf aoa --mix 0.3` in the simulated room",
        "packets": "5 million packets are read",
        "map": "a map of 100 receivers is fitted to 2,000 scans",
        "receivers": "`swiftwrf rssi` on 2,000 scans of 100 receivers",
        "scans": "1,000 scans are located among 500 receivers",
        "channels": "200 channels of 8 subcarriers are located in the office",
        "circular turned": "`swiftwrf aoa --mix 0.7` on 83 measured channels of a circular array",
    }
    rows, cases = [], load("survey_speed")["cases"]
    for name in dict.fromkeys([*names, *cases]):
        if "here" in (found := cases.get(name, {})):
            here, against = found["here"], found.get("against")
            earlier = f"{against['seconds']:.1f} s" if against else "-"
            rows.append([names.get(name, f"`swiftwrf {name}`"), f"{here['seconds']:.1f} s", earlier])
            rows[-1].append(f"{here['peak_gib']:.1f} GiB")
    return markdown(["case", "seconds", "earlier commit", "peak memory of a process"], rows)


def workers() -> str:
    """Return seconds of a run by the number of workers of a cluster."""
    found = load("survey_speed")["cases"]["workers"]
    rows = [[n, f"{seconds:.0f} s", f"{found['efficiency'][n]:.0%}"] for n, seconds in found["seconds"].items()]
    return markdown(["workers", "seconds", "efficiency"], rows)


def scaling() -> str:
    """Return processor seconds and peak memory of each stage at each size, and the growth to the largest size."""
    content = load("scaling")
    sizes = [row["n"] for row in content["rows"]]
    rows = []
    for label, growth in content["slopes"].items():
        stage, part = label.split(", ")
        cells = [f"{row['stages'][stage][part]:.1f} s" for row in content["rows"]]
        peaks = [f"{row['stages'][stage]['rss_gib']:.1f}" for row in content["rows"]]
        anonymous = content["rows"][-1]["stages"][stage]["anonymous_gib"]
        name = f"{stage}, {part.removesuffix(' seconds')}" if " " in part else stage
        rows.append([name, *cells, f"{list(growth.values())[-1]:.2f}", " / ".join(peaks), f"{anonymous:.1f}"])
    columns = ["stage", *(f"{n:,}" for n in sizes), f"exponent to {sizes[-1]:,}", "peak of each size [GiB]"]
    return markdown([*columns, "not from files [GiB]"], rows)
