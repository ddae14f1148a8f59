"""Public data sets by name: downloaded once, checked by their checksums, converted to the toolkit's layouts and cached.

Each is pinned to one commit of its repository. Needs pooch (extra `data`), unless the data set is in the cache or in the
folder that the environment variable `SWIFTWRF_DATA` names.
"""

from __future__ import annotations

import os
import secrets
import shutil
from pathlib import Path
from typing import Any

import pandas as pd

from swiftwrf.contrib.datasets import conversions
from swiftwrf.data import Rssi, Spectra, load_rssi, load_spectra
from swiftwrf.errors import InputError, optional_module
from swiftwrf.runtime.durable import cache_folder, refusing_unwritable, rename, write_text

__all__ = ["DATA_SETS", "catalogue", "fetch", "load"]

FOLDER = "SWIFTWRF_DATA"  # environment variable with a folder of converted data sets


def _read_sets(folder: Path) -> pd.DataFrame:
    """Return the data sets: sets.csv describes them, checksums/NAME.txt has path and sha256 of each raw file.

    Columns are those of the file, the function that converts the raw files (first folder) to the toolkit's layout (second
    folder), the addresses of the repository (source) and of the raw files (url), and the file of checksums.
    """
    sets = pd.read_csv(folder / "sets.csv")
    return sets.assign(
        convert=[getattr(conversions, function) for function in sets["convert"]],
        source="https://github.com/" + sets["repository"],
        url="https://raw.githubusercontent.com/" + sets["repository"] + "/" + sets["commit"] + "/",
        checksums=[folder / "checksums" / f"{name.replace('/', '-')}.txt" for name in sets["name"]],
    )


SETS = _read_sets(Path(__file__).parent)
DATA_SETS: dict[str, Any] = {row.name: row for row in SETS.itertuples(index=False)}


def catalogue() -> pd.DataFrame:
    """Return a table of all data sets: kind, licence, source and what they contain, by name.

    Example:
        >>> catalogue().loc["tetam-tracks", "licence"]
        'CC0 1.0'
    """
    return SETS.set_index("name")[["kind", "licence", "source", "content"]].rename_axis(None)


def fetch(name: str) -> Path:
    """Return the folder of a data set in the toolkit's layout. It is downloaded and converted if it is not there.

    Folders in `$SWIFTWRF_DATA` come first, then those of the cache, `~/.cache/swiftwrf/datasets`.

    Args:
        name: Name in `catalogue()`.

    Raises:
        InputError: An unknown name, pooch is not installed, a file that cannot be downloaded or has another checksum, or
            a cache that cannot be written.

    Example:
        >>> fetch("nowhere")
        Traceback (most recent call last):
        swiftwrf.errors.InputError: there is no data set 'nowhere'; choose from ...
    """
    if name not in DATA_SETS:
        raise InputError(f"there is no data set {name!r}; choose from {', '.join(DATA_SETS)}")
    given = os.environ.get(FOLDER)
    if given and (Path(given) / name).is_dir():
        return Path(given) / name
    folder = cache_folder() / "datasets" / name
    if not folder.is_dir():
        with refusing_unwritable(folder.parent):
            _convert(DATA_SETS[name], folder)
    return folder


def load(name: str) -> Spectra | Rssi:
    """Return a data set as spectra or RSSI; arguments and errors as `fetch`."""
    folder = fetch(name)
    return load_spectra(folder) if DATA_SETS[name].kind == "spectra" else load_rssi(folder)


def _convert(data: Any, folder: Path) -> None:
    """Download and convert a data set; the folder appears when it is complete."""
    raw = _download(data)
    unfinished = folder.with_name(f".{folder.name}.{secrets.token_hex(4)}")
    unfinished.mkdir(parents=True)
    try:
        data.convert(raw, unfinished)
        page = (
            f"# {data.name}\n\n{data.content}\n\nSource: {data.url}\nLicence: {data.licence}\nCite: {data.citation}\n"
        )
        write_text(unfinished / "README.md", f"{page}Converted from the raw files by swiftwrf.contrib.datasets.\n")
        if not folder.exists():
            rename(unfinished, folder)
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)


def _download(data: Any) -> Path:
    """Return the folder of the raw files."""
    folder: Path = cache_folder() / "datasets" / "raw" / data.name
    pooch = optional_module("pooch", f"data set {data.name} is downloaded by pooch", "data")
    pooch.get_logger().setLevel("WARNING")
    source = pooch.create(folder, data.url)
    source.load_registry(data.checksums)
    for file in source.registry:
        try:
            source.fetch(file)
        except (OSError, ValueError) as error:  # no connection or no such file; another checksum
            if getattr(error, "errno", None) is not None:  # of the cache: those of requests have no number
                raise
            reason = "its checksum differs" if isinstance(error, ValueError) else "it cannot be downloaded"
            raise InputError(
                f"data set {data.name}: {reason}: {source.get_url(file)}; put the file at {folder / file}"
            ) from None
    return folder
