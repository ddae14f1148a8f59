"""Table of all sets of measured spectra, from the result of measured_spectra.py."""

from __future__ import annotations

from committed import load, markdown

MODELS = ("mean", "nearest", "gp", "coarray", "swiftwrf")
ESTIMATORS = ("peak", "constant", "nearest_spectrum", "kernel_regression", "aann_kernel")


def measured_spectra() -> str:
    """Return the median PSNR of field models and the median angular error of estimators on each set, the best in bold."""
    rows = []
    for row in load("measured_spectra")["sets"]:
        quality = {name: entry["psnr_db"]["median"] for name, entry in row["models"].items() if name in MODELS}
        error = {name: row["angle_deg"][name]["median"] for name in ESTIMATORS}
        cells = [_cell(quality, name, max(quality.values()), 1) for name in MODELS]
        cells += [_cell(error, name, min(error.values()), 2) for name in ESTIMATORS]
        rows.append([f"{row['set']}, {row['split']}", f"{row['n_test']} of {row['n']}", *cells])
    columns = [f"PSNR [dB]: {MODELS[0]}", *MODELS[1:], f"angle [deg]: {ESTIMATORS[0]}", *ESTIMATORS[1:]]
    return markdown(["data, split", "tested", *columns], rows)


def _cell(values: dict[str, float], name: str, best: float, digits: int) -> str:
    if name not in values:
        return ""
    text = f"{values[name]:.{digits}f}"
    return f"**{text}**" if text == f"{best:.{digits}f}" else text
