"""Public data sets by name: downloaded once, checked by their checksums, converted to the toolkit's layouts and cached.

Each is pinned to one commit of its repository. Needs pooch (extra `data`), unless the data set is in the cache or in the
folder that the environment variable `SWIFTWRF_DATA` names.
"""

from __future__ import annotations

import os
import secrets
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal
from urllib.parse import quote

import pandas as pd

from swiftwrf.data import Rssi, Spectra, load_rssi, load_spectra
from swiftwrf.datasets import conversions
from swiftwrf.errors import InputError, optional_module
from swiftwrf.runtime.durable import cache_folder, refusing_unwritable, rename, write_text

FOLDER = "SWIFTWRF_DATA"  # environment variable with a folder of converted data sets


@dataclass(frozen=True)
class DataSet:
    """A public data set, pinned to one commit of a repository on GitHub.

    Args:
        kind: What it holds: "spectra" or "rssi".
        content: What was measured, one sentence.
        repository: Owner and name on GitHub.
        commit: Commit of the raw files.
        licence: Licence of the data.
        citation: Authors, title, year.
        convert: Writes the toolkit's layout (second folder) from the raw files (first folder).
        checksums: File with path and sha256 of each raw file.

    Example:
        >>> DATA_SETS["kolak"].url
        'https://raw.githubusercontent.com/marckolak/ble-rss-fingerprints-calib2021/0a69aaa7006909d3f8f9f3a14fcba9405d404fa5/'
    """

    kind: Literal["spectra", "rssi"]
    content: str
    repository: str
    commit: str
    licence: str
    citation: str
    convert: Callable[[Path, Path], None]
    checksums: Path

    @property
    def source(self) -> str:
        """Address of the repository."""
        return f"https://github.com/{self.repository}"

    @property
    def url(self) -> str:
        """Address that the paths of the raw files are appended to."""
        return f"https://raw.githubusercontent.com/{quote(self.repository)}/{self.commit}/"


def _read_sets(folder: Path) -> dict[str, DataSet]:
    """Return the data sets by name: sets.csv describes them, checksums/NAME.txt lists their raw files."""
    sets = {}
    for name, row in pd.read_csv(folder / "sets.csv", index_col="name").to_dict("index").items():
        convert, checksums = getattr(conversions, row.pop("convert")), f"{str(name).replace('/', '-')}.txt"
        sets[str(name)] = DataSet(**row, convert=convert, checksums=folder / "checksums" / checksums)
    return sets


DATA_SETS = _read_sets(Path(__file__).parent)


def catalogue() -> pd.DataFrame:
    """Return a table of all data sets: kind, licence, source and what they contain, by name.

    Example:
        >>> catalogue().loc["tetam-tracks", "licence"]
        'CC0 1.0'
    """
    columns = ("kind", "licence", "source", "content")
    rows = {name: [getattr(found, column) for column in columns] for name, found in DATA_SETS.items()}
    return pd.DataFrame.from_dict(rows, orient="index", columns=list(columns))


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
            _convert(name, DATA_SETS[name], folder)
    return folder


def load(name: str) -> Spectra | Rssi:
    """Return a data set as spectra or RSSI; arguments and errors as `fetch`."""
    folder = fetch(name)
    return load_spectra(folder) if DATA_SETS[name].kind == "spectra" else load_rssi(folder)


def _convert(name: str, data: DataSet, folder: Path) -> None:
    """Download and convert a data set; the folder appears when it is complete."""
    raw = _download(name, data)
    unfinished = folder.with_name(f".{folder.name}.{secrets.token_hex(4)}")
    unfinished.mkdir(parents=True)
    try:
        data.convert(raw, unfinished)
        page = f"# {name}\n\n{data.content}\n\nSource: {data.url}\nLicence: {data.licence}\nCite: {data.citation}\n"
        write_text(unfinished / "README.md", f"{page}Converted from the raw files by swiftwrf.datasets.\n")
        if not folder.exists():
            rename(unfinished, folder)
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)


def _download(name: str, data: DataSet) -> Path:
    """Return the folder of the raw files."""
    folder = cache_folder() / "datasets" / "raw" / name
    pooch = optional_module("pooch", f"data set {name} is downloaded by pooch", "data")
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
                f"data set {name}: {reason}: {source.get_url(file)}; put the file at {folder / file}"
            ) from None
    return folder
