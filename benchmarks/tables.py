"""Rewrite the tables of README and docs from the committed results: python benchmarks/tables.py."""

from __future__ import annotations

import re
import statistics
import warnings
from typing import Any

import aoa_tables
import constant_tables
import field_tables
import rssi_tables
import speed_tables
import tyro
from record import ROOT, age, load, loaded, markdown

from augment.turbo.condition import LOCATED
from swiftwrf.choices import RSSI_PREDICTORS
from swiftwrf.contrib.comparison.localizers import LOCALIZERS
from swiftwrf.contrib.datasets import catalogue
from swiftwrf.contrib.raytraced.names import ROOMS
from swiftwrf.data.formats import RSSI_FORMATS, SNAPSHOT_FORMATS, SPECTRA_FORMATS
from tasks import configs, labels
from tasks.command import COMMANDS
from tasks.options import General, ReadingOptions, meanings


def random_rooms() -> str:
    """Return how many of the random rooms are found, and how many planes are called certain."""
    rows = []
    studies = ("random_rooms", "built_in_rooms", "newrf_rooms")
    for case, rooms in (item for study in studies for item in load(study).get("rooms", {}).items()):
        kind, _, noise = case.partition(", ")
        found, near = sum(room["near"] == 6 for room in rooms), sum(room["near"] for room in rooms)
        certain, wrong = (sum(room[key] for room in rooms) for key in ("certain", "certain_and_wrong"))
        seconds = statistics.mean(room["cpu_seconds"] for room in rooms)
        cells = [
            f"{found} of {len(rooms)}",
            f"{near} of {6 * len(rooms)}",
            str(certain),
            str(wrong),
            f"{seconds:.0f} s",
        ]
        rows.append([kind, noise, *cells])
    return markdown(
        [
            "gains or scene",
            "phase noise or spectra",
            "rooms",
            "planes",
            "identifiable",
            "of them wrong",
            "processor time",
        ],
        rows,
    )


def explanations() -> str:
    """Return how often the inspection names the cause of an error, and a cause of errors that have no name."""
    rows = []
    for kind, counted in (("known", "right"), ("unknown", "false")):
        cases = [one for one in load(f"explanations_{kind}").values() if isinstance(one, dict) and counted in one]
        scenes, found = (sum(one[key] for one in cases) for key in ("scenes", counted))
        cells = [f"{found} of {scenes}", ""]
        rows.append([f"{kind}, {len(cases)} kinds", *(cells if kind == "known" else cells[::-1])])
    return markdown(["cause", "named rightly", "a cause named wrongly"], rows)


def fuzz_containers() -> str:
    """Return how many random files of each form give the values of their plain form."""
    found = {form: one for form, one in load("fuzz_containers").items() if isinstance(one, dict) and "wrong" in one}
    rows = [[form, *(str(one[key]) for key in ("inputs", "read", "refused", "wrong"))] for form, one in found.items()]
    return markdown(["form", "files", "read", "refused", "wrong"], rows)


def hard_cases() -> str:
    """Return the largest errors over cutoffs of each backend in each case."""
    found: dict[str, dict[str, list[dict[str, Any]]]] = {}
    for row in load("stability_cpu")["backends"]:
        found.setdefault(row["case"], {}).setdefault(row["backend"], []).append(row)
    rows = []
    for case, backends in found.items():
        cells = []
        for entries in backends.values():
            value = {entry["cutoff"]: entry["value"] for entry in entries}
            gradient = max(max(entry["gradient"], entry["magnitude_gradient"]) for entry in entries)
            cells.append(f"{value[None]:.0e}, {value[1e-4]:.0e}; {gradient:.0e}")
        rows.append([case, next(iter(backends.values()))[0]["rule"].replace("|", "\\|"), *cells])
    return markdown(["case", "rule", *(f"`{backend}` (float32)" for backend in found[rows[0][0]])], rows)


def headline() -> str:
    """Return one row for each question: the simplest method, the best other method, and this project."""
    located = {name: one["localizers"] for name, one in load("locating_rssi")["sets"].items()}
    rssi = load("rssi")["sets"]["tetam-tracks spatial"]
    decibel = {name: f"{found['abs_error_db']['median']:.2f} dB" for name, found in rssi["methods"].items()}
    baseline = rssi["best_baseline"]
    metre = {name: found["position_error_m"]["median"] for name, found in located["tetam-tracks spatial"].items()}
    other = min(metre.keys() - {"posterior"}, key=lambda name: float(metre[name]))
    mean = {name: found["position_error_m"]["mean"] for name, found in located["ts-tut5 published"].items()}
    csi = load("channels_8_conference")["scenes"]["newrf-conference"]["0.3"]["median"]
    coherence = {name: f"{found['coherence']:.2f}" for name, found in csi["channel"].items()}
    channels = (
        f"{coherence['furniture']} ({100 * csi['position_m']['median']:.1f} cm, {csi['angle_deg']['median']:.2f}° off)"
    )
    by_channels = [_by_channels(name) for name in ("channels_8_rooms", "channels_8_adarf")]
    degree = {}
    for share, mix, result in aoa_tables.aoa_shares():
        errors = {name: f"{m['great_circle_deg']['median']:.2f}°" for name, m in mix["methods"].items()}
        errors["other"] = f"{aoa_tables.reference(mix)} {errors[mix['reference']]}"
        errors["synthetic"] = f"{errors[aoa_tables.turbo_condition(mix).method]} with synthetic spectra"
        degree[result["metrics"]["data"], result["metrics"]["split"], share] = errors
    office, tag = degree["newrf-office", "random", "0.3"], degree["s23-200", "block", "0.3"]
    csi_error = load("channels_8_office")["scenes"]["newrf-office"]["0.3"]["median"]["angle_deg"]["median"]
    room = f"{office['synthetic']}, {office[LOCATED]} by the room, {csi_error:.2f}° by CSI of 8 subcarriers"
    rows = [
        ["RSSI where nobody measured", "tetam-tracks, spatial"],
        ["position from RSSI", "tetam-tracks, spatial"],
        ["position from Wi-Fi RSSI, public benchmark, mean 3D error", "ts-tut5, published"],
        ["wideband CSI where nobody measured, coherence", "newrf-conference, 8 subcarriers in 80 MHz"],
        ["direction by wideband CSI (position)", "ten furnished rooms, 20 MHz, 20 dB"],
        ["direction by CSI of RFID tags (position)", "adarf-d1, published"],
        ["direction, ray-traced furnished room", "newrf-office, random"],
        ["direction, measured spectra of an RFID tag", "s23-200, block"],
    ]
    cells = [
        [f"path loss {decibel['mri_receiver']}", f"`{baseline}` {decibel[baseline]}", decibel["swiftwrf"]],
        [f"mean {metre['mean']:.2f} m", f"`{other}` {metre[other]:.2f} m", f"{metre['posterior']:.2f} m"],
        [f"1-NN {mean['nearest']:.2f} m", f"`knn` {mean['knn']:.2f} m", f"{mean['posterior']:.2f} m"],
        [f"nearest {coherence['nearest']}", f"Gaussian process {coherence['gaussian_process']}", channels],
        *by_channels,
        [f"strongest peak {office['peak']}", office["other"], room],
        [f"mean {tag['constant']}", tag["other"], tag["synthetic"]],
    ]
    columns = ["question", "data, split", "simplest method", "best other method", "SwiftWRF"]
    return markdown(columns, [[*row, *three] for row, three in zip(rows, cells, strict=True)])


def _by_channels(name: str) -> list[str]:
    """Return the direction by the strongest peak, by the best other estimator, and by matched-field processing."""
    (scene,) = load(name)["scenes"].values()
    (found,) = (fraction["median"] for fraction in scene.values())
    other, error = aoa_tables.best_other(found)
    own = f"{found['angle_deg']['median']:.2f}° ({100 * found['position_m']['median']:.1f} cm)"
    return [f"strongest peak {found['peak_angle_deg']['median']:.2f}°", f"{other} {error:.2f}°", own]


def datasets() -> str:
    """Return the public data sets that have a name."""
    rows = [
        [f"`{row.Index}`", str(row.content), str(row.licence), f"[{str(row.source).rpartition('/')[2]}]({row.source})"]
        for row in catalogue().itertuples()
    ]
    return markdown(["name", "content", "licence", "source"], rows)


def _options(config: type[Any]) -> dict[str, str]:
    """Return the help of each option of a command or group, by name."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        actions = tyro.extras.get_parser(config)._actions
    found = {}
    for action in actions:
        # of a flag, the option that sets it
        names = [name for name in action.option_strings if name.startswith("--") and not name.startswith("--no-")]
        if names:
            name = names[-1].lstrip("-").rpartition(".")[2]
            found[f"--{name}"] = " ".join(str(action.help).split()).replace("%%", "%")
    return found


def read_options() -> str:
    """Return the options of reading, and the formats that take them."""
    readers = {"spectra": SPECTRA_FORMATS, "snapshots": SNAPSHOT_FORMATS, "rssi": RSSI_FORMATS}
    rows = []
    for name, meaning in _options(ReadingOptions).items():
        field = name.removeprefix("--").replace("-", "_")
        formats = dict.fromkeys(one for found in readers.values() for one in found if field in found[one].takes)
        rows.append([f"`{name}`", ", ".join(formats), meaning])
    return markdown(["option", "formats", "meaning"], rows)


def commands() -> str:
    """Return all options of the commands but those of reading, with the commands that have them."""
    reading = _options(ReadingOptions)
    found: dict[tuple[str, str], list[str]] = {}
    for command, (config, _) in COMMANDS.items():
        for name, meaning in _options(getattr(configs, config)).items():
            if reading.get(name) != meaning:
                found.setdefault((name, meaning), []).append(f"`{command}`")
    found |= {(name, meaning): ["all"] for name, meaning in meanings(General).items()}
    rows = [[f"`{name}`", ", ".join(names), meaning] for (name, meaning), names in sorted(found.items())]
    return markdown(["option", "commands", "meaning"], rows)


def predictors() -> str:
    """Return the predictors of RSSI."""
    return markdown(
        ["predictor", "method"], [[f"`{name}`", text] for name, text in labels.meanings(RSSI_PREDICTORS).items()]
    )


def localizers() -> str:
    """Return the localizers."""
    return markdown(
        ["localizer", "estimate"], [[f"`{name}`", text] for name, text in labels.meanings(LOCALIZERS).items()]
    )


def rooms() -> str:
    """Return the built-in rooms of ray tracing."""
    return markdown(["`--room`", "scene"], [[f"`{name}`", meaning] for name, meaning in ROOMS.items()])


MODULES = (aoa_tables, constant_tables, field_tables, rssi_tables, speed_tables)
FILES = ("README.md", *sorted(file.relative_to(ROOT).as_posix() for file in (ROOT / "docs").rglob("*.md")))


def table(name: str) -> str:
    """Return a table by the name of its function, here or in one of the modules, and the age of what it shows."""
    functions = [getattr(module, name) for module in MODULES if hasattr(module, name)]
    first = len(loaded)
    text: str = (functions[0] if functions else globals()[name])()
    shown = dict.fromkeys(loaded[first:])
    return f"{text}\n\n*{age(shown)}*" if shown else text


def rewrite(text: str) -> str:
    """Return the text with each block between `<!-- NAME -->` and `<!-- /NAME -->` replaced by its table."""
    for name in re.findall(r"<!-- (\w+) -->", text):
        block = f"<!-- {name} -->\n{table(name)}\n<!-- /{name} -->"
        text = re.sub(rf"<!-- {name} -->.*?<!-- /{name} -->", lambda _, block=block: block, text, flags=re.DOTALL)
    return text


if __name__ == "__main__":
    for name in FILES:
        (ROOT / name).write_text(rewrite((ROOT / name).read_text()))
