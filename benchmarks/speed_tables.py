"""Tables of rates, seconds and memory: on a GPU, and against the amount of data."""

from __future__ import annotations

from record import load, markdown

DEVICES = {"cpu": "CPU", "cuda": "GPU"}


def gpu_rates() -> str:
    """Return spectra per second on a GPU by number of primitives and batch size."""
    rates = ("forward", "forward_backward", "model", "synthesize")
    rows = [
        [f"{row['n']:,}", f"{row['batch']:,}", *(f"{row[f'{name}_per_s']['median']:,.0f}" for name in rates)]
        for row in load("gpu_rates")["rows"]
    ]
    columns = ["primitives", "batch", "forward", "forward and backward", "model", "synthesize"]
    return markdown(columns, rows)


def gpu_targets() -> str:
    """Return the rates of the GPU beside their targets."""
    rows = []
    for target in load("gpu_rates")["targets"]:
        values = [target[key] for key in ("least", "measured")]
        cells = [f"{value:.0%}" if target["least"] < 1 else f"{value:,.0f}" for value in values]
        rows.append([target["what"], *cells, "met" if target["met"] else "missed"])
    return markdown(["spectra per second, 90 x 360", "at least", "measured", ""], rows)


def gpu_seconds() -> str:
    """Return seconds of the fits on a GPU."""
    return markdown(["fit", "seconds"], [[name, f"{s:.1f}"] for name, s in load("gpu_training")["seconds"].items()])


def gpu_single() -> str:
    """Return milliseconds for one spectrum on a machine with a GPU."""
    learning, locating = load("gpu_update"), load("gpu_locating")
    rows = [
        [f"score and learn, `{row['model']}` of {row['n']:,}", DEVICES[row["device"]], f"{row['ms_per_spectrum']:.1f}"]
        for row in learning["rows"]
    ]
    rows.append(["locate, `matched_field`", DEVICES["cpu"], f"{1e3 * locating['seconds']['spectrum']:.1f}"])
    return markdown(["one spectrum", "device", "milliseconds"], rows)


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


def scaling_rssi() -> str:
    """Return processor seconds and peak memory of the RSSI model."""
    content = load("scaling_rssi")
    rows = [
        [
            f"{row['rows']:,.0f}",
            f"{row['receivers']:.0f}",
            f"{row['fit seconds']:.1f} s",
            f"{row['predict seconds']:.2f} s",
            f"{row['rss_gib']:.1f}",
        ]
        for row in content["rows"]
    ]
    return markdown(["rows", "receivers", "fit", f"{content['predicted']:,} positions", "peak [GiB]"], rows)


def scaling_quality() -> str:
    """Return the median PSNR between the positions of the walk."""
    content = load("scaling")
    names = [stage for stage, values in content["rows"][0]["stages"].items() if "psnr_db" in values]
    rows = [[f"{row['n']:,}", *(f"{row['stages'][name]['psnr_db']:.1f}" for name in names)] for row in content["rows"]]
    return markdown(["spectra", *names], rows)
