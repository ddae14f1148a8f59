"""Tables of the studies of field models, with the paper's numbers beside the measured ones."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

from pandas import DataFrame
from pareto import pareto
from record import RESULTS, interval, load, markdown

from augment.turbo.condition import NETWORK

Row = dict[str, Any]
Scores = dict[str, tuple[float, float, float]]  # median PSNR [dB], median SSIM and mean L1 by method, on other spectra
PAPER_S23: Scores = {
    "vae": (18.62, 0.7133, 0.1033),
    "dcgan": (18.81, 0.7189, 0.0967),
    "nerf2": (21.76, 0.7732, 0.0712),
    "wrfgs": (20.72, 0.7588, 0.0788),
    "swiftwrf": (24.75, 0.8714, 0.0582),
}
PAPER_ROOMS: dict[str, Scores] = {  # of rooms of these names
    "conference-transmitter": {
        "vae": (21.54, 0.7095, 0.0656),
        "dcgan": (22.41, 0.7290, 0.0600),
        "nerf2": (26.12, 0.8122, 0.0555),
        "wrfgs": (25.53, 0.7888, 0.0514),
        "swiftwrf_paper": (30.75, 0.9039, 0.0410),
    },
    "conference-receiver": {
        "vae": (23.93, 0.7664, 0.0524),
        "dcgan": (21.26, 0.7164, 0.0608),
        "nerf2": (28.21, 0.8528, 0.0387),
        "wrfgs": (26.64, 0.7916, 0.0423),
        "swiftwrf_paper": (30.54, 0.9137, 0.0315),
    },
    "office-transmitter": {
        "vae": (23.51, 0.7647, 0.0549),
        "dcgan": (22.55, 0.7441, 0.0559),
        "nerf2": (27.52, 0.8118, 0.0497),
        "wrfgs": (24.00, 0.7422, 0.0534),
        "swiftwrf_paper": (32.96, 0.9376, 0.0355),
    },
    "office-receiver": {
        "vae": (22.75, 0.7562, 0.0612),
        "dcgan": (20.95, 0.7809, 0.0529),
        "nerf2": (24.16, 0.7863, 0.0515),
        "wrfgs": (24.07, 0.7460, 0.0510),
        "swiftwrf_paper": (28.01, 0.8755, 0.0406),
    },
    "bedroom-transmitter": {
        "vae": (22.90, 0.7468, 0.0612),
        "dcgan": (21.66, 0.7314, 0.0625),
        "nerf2": (25.99, 0.8004, 0.0608),
        "wrfgs": (26.10, 0.7995, 0.0534),
        "swiftwrf_paper": (30.17, 0.9166, 0.0442),
    },
    "bedroom-receiver": {
        "vae": (22.57, 0.7414, 0.0609),
        "dcgan": (21.79, 0.7208, 0.0601),
        "nerf2": (25.51, 0.8057, 0.0505),
        "wrfgs": (25.50, 0.7901, 0.0482),
        "swiftwrf_paper": (28.15, 0.9023, 0.0398),
    },
}
# median elevation and azimuth errors [deg] of the paper at each measured fraction, on its own spectra
PAPER_ANGLES = {
    "0.1": {"swiftwrf": (0.592, 1.769), "nerf2": (0.957, 2.548), "wrfgs": (1.056, 4.506)},
    "0.3": {"swiftwrf": (0.553, 1.737), "nerf2": (0.850, 1.903), "wrfgs": (0.948, 2.364)},
    "0.5": {"swiftwrf": (0.410, 1.498), "nerf2": (0.704, 1.663), "wrfgs": (0.878, 1.854)},
    "0.7": {"swiftwrf": (0.370, 1.173), "nerf2": (0.674, 1.478), "wrfgs": (0.727, 1.629)},
}
PAPER_RESOLUTION = {"seen at 0.5 degrees": "0.898 / 0.039"}  # SSIM and mean L1
SHOWN_MODELS = ("mean", "nearest", "gp", "coarray", "swiftwrf")
SHOWN_ESTIMATORS = ("peak", "constant", "nearest_spectrum", "kernel_regression", "aann_kernel")


def pivot(head: str, cells: Iterable[tuple[str, str, str]]) -> str:
    """Return a table of cells (row, column, text). Rows and columns are in the order in which they come first."""
    table = DataFrame(cells, columns=["row", "column", "text"])
    rows, columns = table["row"].unique(), table["column"].unique()
    table = table.pivot(index="row", columns="column", values="text").reindex(rows, columns=columns).fillna("")
    return markdown([head, *columns], [[name, *texts] for name, texts in zip(rows, table.to_numpy(), strict=True)])


def bold(text: str, is_best: bool) -> str:
    """Return the text, bold if it is the best."""
    return f"**{text}**" if is_best else text


def label(row: Row) -> str:
    """Return scene and split."""
    return f"{row['scene']} {row['split']}"


def synthesis() -> str:
    """Return median SSIM and PSNR of each field model on each scene, and seconds and coverage of swiftwrf."""
    rows = load("synthesis")["rows"]
    cells = [(label(r), r["method"], f"{r['ssim']['median']:.3f} / {r['psnr_db']['median']:.1f}") for r in rows]
    for row in rows:
        if row["method"] == "swiftwrf":
            cells.append((label(row), "fit of swiftwrf", f"{row['fit_seconds']:.0f} s"))
            cells.append((label(row), "its 80 % interval covers", f"{row['covered_by_80']:.0%}"))
    return pivot("scene, split", cells)


def size() -> str:
    """Return the size that the fit chose beside the best of all sizes."""
    cells = []
    for scene, found in _by_scene(load("model_size")["rows"], label).items():
        auto, fixed = found.pop("auto"), list(found.values())
        quality = {entry["n_primitives"]: entry["psnr_db"]["median"] for entry in fixed}
        best = max(quality, key=lambda n: quality[n])
        enough = next(entry for entry in fixed if entry["psnr_db"]["median"] >= quality[best] - 0.1)
        own = next(entry for entry in fixed if entry["n_primitives"] == auto["n_primitives"])
        row = {
            "N, K": f"{auto['n_primitives']}, {auto['rank']}",
            "PSNR [dB]": f"{auto['psnr_db']['median']:.2f}",
            "of N = 16 ... 1024 (best)": f"{min(quality.values()):.2f} to {quality[best]:.2f} ({best})",
            "smallest within 0.1 dB": str(enough["n_primitives"]),
            "parameters over its": f"{auto['parameters'] / enough['parameters']:.1f}",
            "time over that of a fit of fixed N": f"{auto['fit_seconds'] / own['fit_seconds']:.1f}",
        }
        cells += [(scene, column, text) for column, text in row.items()]
    return pivot("scene, split", cells)


def ablation() -> str:
    """Return median SSIM / mean L1 / median PSNR of every variant of the ablation on every scene."""
    rows = [*load("ablation")["rows"], *load("ablation_large")["rows"]]
    cells = [(row["method"], label(row), row.get("refusal") or _ablated(row)) for row in rows]
    paper = [(name, "paper: SSIM / L1", text) for name, text in PAPER_RESOLUTION.items()]
    return pivot("variant", cells + paper)


def _ablated(row: Row) -> str:
    return f"{row['ssim']['median']:.3f} / {row['l1']['mean']:.4f} / {row['psnr_db']['median']:.1f}"


def measured_spectra() -> str:
    """Return the median PSNR of field models and the median angular error of estimators on each set, the best in bold."""
    content, cells = load("measured_spectra"), []
    for scene, found in _by_scene(content["rows"], lambda row: f"{row['scene']}, {row['split']}").items():
        n = content["described"][scene.partition(",")[0]]["n"]
        cells.append((scene, "tested", f"{next(iter(found.values()))['n_test']} of {n}"))
        for names, key, what, best in (
            (SHOWN_MODELS, "psnr_db", "PSNR [dB]", max),
            (SHOWN_ESTIMATORS, "angle_deg", "angle [deg]", min),
        ):
            digits = 1 if key == "psnr_db" else 2
            texts = {name: f"{found[name][key]['median']:.{digits}f}" for name in names if name in found}
            top = best(texts.values(), key=float)
            for name, text in texts.items():
                cells.append((scene, f"{what}: {name}" if name == names[0] else name, bold(text, text == top)))
    return pivot("data, split", cells)


def raytracing() -> str:
    """Return the median PSNR of every method in the furnished rooms, and the number of planes."""
    content, cells = load("raytracing"), []
    for scene, found in _by_scene(content["rows"], lambda row: str(row["scene"])).items():
        cells.append((scene, "paths a position", f"{content['described'][scene]['traced']['paths_per_position']:.0f}"))
        cells += [(scene, name, f"{row['psnr_db']['median']:.1f}") for name, row in found.items()]
        planes = found["geometry"]["planes"]
        certain = sum(plane["certain"] for plane in planes)
        cells.append((scene, "identifiable planes", f"{certain} of {len(planes)}"))
    return pivot("scene, moving end", cells)


def _by_scene(rows: Sequence[Row], name: Callable[[Row], str]) -> dict[str, dict[str, Row]]:
    """Return the rows by scene and method, of a method with several numbers of training spectra that with most."""
    found: dict[str, dict[str, Row]] = {}
    for row in rows:
        own = found.setdefault(name(row), {})
        own[row["method"]] = max(own.get(row["method"], row), row, key=lambda row: row.get("n_train", 0))
    most = {name: max(row.get("n_train", 0) for row in own.values()) for name, own in found.items()}
    return {
        name: {method: row for method, row in own.items() if row.get("n_train", 0) == most[name]}
        for name, own in found.items()
    }


def scores(scenes: dict[str, dict[str, Row]], paper: dict[str, Scores]) -> str:
    """Return a row for each method and a column for each scene, the best PSNR of a scene in bold, and rows of the paper."""
    best = {name: max(row["psnr_db"]["median"] for row in rows.values()) for name, rows in scenes.items()}
    cells = []
    for method in dict.fromkeys(method for rows in scenes.values() for method in rows):
        for name, rows in scenes.items():
            if method in rows:
                psnr, ssim, l1 = (rows[method][key] for key in ("psnr_db", "ssim", "l1"))
                text = bold(f"{psnr['median']:.2f}", psnr["median"] == best[name])
                cells.append((f"`{method}`", name, f"{text} / {ssim['median']:.3f} / {l1['mean']:.4f}"))
        for name in scenes:
            if found := paper.get(name, {}).get(method):
                text = f"{found[0]:.2f} / {found[1]:.3f} / {found[2]:.4f}"
                cells.append((f"paper: {method.removesuffix('_paper')}", name, text))
    return pivot("method", cells)


def costs(scenes: dict[str, dict[str, Row]]) -> str:
    """Return seconds and size of every method, from the least to the greatest scene."""
    cells = []
    for method in dict.fromkeys(method for rows in scenes.values() for method in rows):
        rows = [own[method] for own in scenes.values() if method in own]
        if any("steps" in row for own in scenes.values() for row in own.values()):
            cells.append((f"`{method}`", "steps", f"{rows[0]['steps']:,}" if rows[0].get("steps") else ""))
        cells.append((f"`{method}`", "fit [s]", _range([row["fit_seconds"] for row in rows])))
        cells.append((f"`{method}`", "ms a spectrum", _range([row["ms"]["median"] for row in rows], 1)))
        cells.append((f"`{method}`", "MB", _range([row["megabytes"] for row in rows], 2)))
    return pivot("method", cells)


def _range(values: Sequence[float], digits: int = 0) -> str:
    low, high = (f"{value:,.{digits}f}" for value in (min(values), max(values)))
    return low if low == high else f"{low} to {high}"


def comparison() -> str:
    """Return the scores of every method on every scene with all training spectra, and those of the paper."""
    paper = {
        name: {"psnr_db": {"median": psnr}, "ssim": {"median": ssim}, "l1": {"mean": l1}}
        for name, (psnr, ssim, l1) in PAPER_S23.items()
    }
    return scores(_by_scene(load("comparison")["rows"], label) | {"paper, other spectra of s23": paper}, {})


def comparison_cost() -> str:
    """Return seconds and size of every method with all training spectra."""
    return costs(_by_scene(load("comparison")["rows"], label))


def comparison_counts() -> str:
    """Return the median SSIM of every method against the number of training spectra."""
    rows = [row for row in load("comparison")["rows"] if label(row) == "s23-200 random"]
    methods = list(dict.fromkeys(row["method"] for row in rows))
    rows.sort(key=lambda row: (row["n_train"], methods.index(row["method"])))
    cells = [(row["method"], str(row["n_train"]), f"{row['ssim']['median']:.3f}") for row in rows]
    return pivot("s23-200, random: training spectra", cells)


def comparison_turbo() -> str:
    """Return median errors of the network with the spectra of several methods, elevation / azimuth."""
    return angles(load("comparison")["aoa"])


def _at_paper_scale(name: str, split: str) -> dict[str, dict[str, Row]]:
    rows = [row for row in load(name)["rows"] if row["split"] == split]
    return _by_scene(rows, lambda row: str(row["scene"]))


def paper_scale() -> str:
    """Return the scores of every method on the random split of every scene, and those of the paper."""
    return scores(_at_paper_scale("paper_scale", "random"), PAPER_ROOMS)


def paper_scale_block() -> str:
    """Return the scores of every method on the block split of every scene."""
    return scores(_at_paper_scale("paper_scale", "block"), {})


def paper_scale_gpu() -> str:
    """Return the scores of the fits by gradient descent on a GPU, and those of the paper."""
    return scores(_at_paper_scale("paper_scale_gpu", "random"), PAPER_ROOMS)


def paper_scale_cost() -> str:
    """Return seconds and size of the fits on the random split, from the least to the greatest scene."""
    return costs(_at_paper_scale("paper_scale", "random"))


def paper_scale_gpu_cost() -> str:
    """Return seconds and size of the fits on a GPU."""
    return costs(_at_paper_scale("paper_scale_gpu", "random"))


def paper_scale_density() -> str:
    """Return how densely the positions of each scene lie."""
    cells = []
    for name, scene in load("paper_scale")["described"].items():
        row = {
            "positions": f"{scene['traced']['positions']:,}",
            "spacing [wavelengths]": f"{scene['spacing_wavelengths']:.2f}",
            "nearest training position [wavelengths]": f"{scene['nearest_training_wavelengths']:.2f}",
            "line of sight": f"{scene['traced']['line_of_sight'] / scene['traced']['positions']:.0%}",
            "paths a position": f"{scene['traced']['paths_per_position']:.0f}",
        }
        cells += [(name, column, text) for column, text in row.items()]
    return pivot("scene", cells)


def paper_scale_counts() -> str:
    """Return the scores of swiftwrf against the number of training spectra."""
    rows = [r for r in load("paper_scale")["rows"] if r["split"] == "random" and r["method"] == "swiftwrf"]
    scenes = [row["scene"] for row in rows]
    table = []
    for row in sorted(rows, key=lambda row: (scenes.index(row["scene"]), row["n_train"])):
        if scenes.count(row["scene"]) > 1:
            ssim = f"{row['ssim']['median']:.3f} [{row['ssim']['low']:.3f}, {row['ssim']['high']:.3f}]"
            cells = [f"{row['psnr_db']['median']:.2f}", f"{row['fit_seconds']:.0f}", f"{row['megabytes']:.2f}"]
            table.append([row["scene"], f"{row['n_train']:,}", ssim, *cells])
    return markdown(["scene, random split", "training spectra", "SSIM", "PSNR [dB]", "fit [s]", "MB"], table)


def angles(fractions: dict[str, dict[str, Row]]) -> str:
    """Return elevation and azimuth errors of the network with each synthesizer, and those of the paper."""

    def cell(errors: Row) -> str:
        return f"{errors['elevation_deg']['median']:.2f} / {errors['azimuth_deg']['median']:.2f}"

    paper = [
        (f"paper: {NETWORK}, measured + synthetic ({name})", _measured(fraction), f"{elevation:.2f} / {azimuth:.2f}")
        for fraction in fractions
        for name, (elevation, azimuth) in PAPER_ANGLES[fraction].items()
    ]
    return _by_fraction(fractions, "azimuth_deg", cell, lambda name: name.startswith(NETWORK), paper)


def paper_scale_angles() -> str:
    """Return elevation and azimuth errors of the network with each synthesizer, and those of the paper."""
    return angles(load("paper_scale")["aoa"])


def paper_scale_aoa() -> str:
    """Return the angular errors of each method at each measured fraction; only the network has all synthesizers."""

    def cell(errors: Row) -> str:
        return f"{interval(errors['great_circle_deg'])} / {errors['great_circle_deg']['p90']:.1f}"

    def is_shown(method: str) -> bool:
        return method.startswith(NETWORK) or "synthetic" not in method or method.endswith("(hybrid)")

    return _by_fraction(load("paper_scale")["aoa"], "great_circle_deg", cell, is_shown)


def _by_fraction(
    fractions: dict[str, dict[str, Row]],
    angle: str,
    cell: Callable[[Row], str],
    is_shown: Callable[[str], bool],
    further: Sequence[tuple[str, str, str]] = (),
) -> str:
    """Return the table of some methods at each measured fraction, the best at the first fraction first, then other rows."""
    first = next(iter(fractions.values()))
    names = sorted(filter(is_shown, first), key=lambda name: float(first[name][angle]["median"]))
    cells = [(f"`{name}`", _measured(key), cell(rows[name])) for name in names for key, rows in fractions.items()]
    return pivot("method", [*cells, *further])


def _measured(fraction: str) -> str:
    return f"{float(fraction):.0%} measured"


def speed() -> str:
    """Return milliseconds a spectrum, held-out PSNR and seconds of the fit of every model on every scene."""
    cells = []
    for content in _speeds():
        front = pareto({p["setting"]: (p["seconds"]["median"], p["held_out"]) for p in content["models"]})
        for point in content["models"]:
            text = f"{point['seconds']['median'] * 1e3:.2f} / {point['psnr_db']:.2f}"
            text += f" / {point['fit_seconds']:.1f}" if point["fit_seconds"] else ""
            setting = point["setting"].partition(" (")[0]
            cells.append((setting, f"{content['data']} {content['split']}", bold(text, point["setting"] in front)))
    return pivot("setting", cells)


def drawing() -> str:
    """Return milliseconds a spectrum and numerical error of the default model of each scene, in single precision."""
    cells = []
    for content in _speeds():
        for p in content["drawing"]:
            if p["own_grid"] and "weights" not in p["setting"]:
                text = f"{p['seconds']['median'] * 1e3:.2f} / {p['numerical']:.0e}"
                cells.append((p["setting"].rpartition(", ")[0], f"{content['data']} {content['split']}", text))
    return pivot("setting", cells)


def _speeds() -> list[Row]:
    return [load(file.stem) for file in sorted(RESULTS.glob("speed_*.json"))]


def networks() -> str:
    """Return the median error and the training time of every estimator on the training sets that are partly measured."""
    cells = []
    for scene, trainings in load("networks")["scenes"].items():
        for training, entry in trainings.items():
            if not training.startswith("all"):
                points = {
                    name: (method["seconds"]["train"], method["great_circle_deg"]["median"])
                    for name, method in entry["methods"].items()
                }
                front = pareto(points)
                column = f"{scene}, {training.partition(',')[0]}, {entry['n_train']}"
                for name, (seconds, error) in points.items():
                    cells.append((name, column, bold(f"{error:.2f} / {seconds:.0f}", name in front)))
    return pivot("estimator", cells)
