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
from functools import partial
from pathlib import Path
from typing import Literal
from urllib.parse import quote

import pandas as pd

from swiftwrf.data import Rssi, Spectra, load_rssi, load_spectra
from swiftwrf.datasets import conversions
from swiftwrf.errors import InputError, optional_module
from swiftwrf.runtime.durable import cache_folder, refusing_unwritable, rename, write_text

FOLDER = "SWIFTWRF_DATA"  # environment variable with a folder of converted data sets
CHECKSUMS = Path(__file__).parent / "checksums"


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


def _newrf(room: str) -> DataSet:
    return DataSet(
        "spectra",
        f"Ray paths in a {room}, 2.412 GHz, traced with MATLAB's image method; the receiver moves",
        "LuHaofan/NeWRF",
        "78feb38471f766f17764a28e8518a05697944107",
        "MIT",
        "H. Lu, C. Vattheuer, B. Mirzasoleiman, O. Abari, NeWRF, ICML 2024",
        conversions.newrf,
        CHECKSUMS / f"newrf-{room}.txt",
    )


def _wifi_room(room: str) -> DataSet:
    return DataSet(
        "rssi",
        f"Wi-Fi RSSI of a phone in a {room.replace('-', ' ')}, means of at least 10 packets a point",
        "Fx386483710/WiFi_RSS_RTT_Dataset_for_Model_Selection",
        "48e41763ff1dc37aed1746be82f8d073531d9b82",
        "MIT",
        "X. Feng, K. A. Nguyen, Z. Luo, WiFi RSS & RTT dataset, doi 10.5281/zenodo.11558792, 2024",
        partial(conversions.wifi_room, room=room),
        CHECKSUMS / f"wifi-rooms-{room}.txt",
    )


FINGERPRINTS = {  # sets of J. Torres-Sospedra's collection: content, and its citation
    "dsi1": ("Wi-Fi, one floor, 230 places", "A. Moreira, I. Silva, doi 10.5281/zenodo.3778646, 2020"),
    "dsi2": ("Wi-Fi, one floor, 230 places, means", "A. Moreira, I. Silva, doi 10.5281/zenodo.3778646, 2020"),
    "lib1": ("Wi-Fi, two floors of a library, one month", "G. M. Mendoza-Silva et al., Data 3, 3, 2018"),
    "lib2": ("Wi-Fi, two floors of a library, another month", "G. M. Mendoza-Silva et al., Data 3, 3, 2018"),
    "tut1": ("Wi-Fi, four floors", "S. Shrestha, J. Talvitie, E. S. Lohan, ICL-GNSS 2013"),
    "tut2": ("Wi-Fi, three floors", "S. Shrestha, J. Talvitie, E. S. Lohan, ICL-GNSS 2013"),
    "tut3": ("Wi-Fi, five floors, crowdsourced", "E. S. Lohan et al., Data 2, 32, 2017"),
    "tut4": ("Wi-Fi, five floors, crowdsourced, parts of tut3 exchanged", "E. S. Lohan et al., Data 2, 32, 2017"),
    "tut5": ("Wi-Fi, three floors", "P. Richter, E. S. Lohan, J. Talvitie, WLAN RSS database, Zenodo, 2018"),
    "tut6": ("Wi-Fi, four floors", "E. S. Lohan, Additional TAU datasets for Wi-Fi fingerprinting, Zenodo, 2020"),
    "tut7": ("Wi-Fi, three floors", "E. S. Lohan, Additional TAU datasets for Wi-Fi fingerprinting, Zenodo, 2020"),
    "uji1": ("Wi-Fi, UJIIndoorLoc, three buildings of up to five floors", "J. Torres-Sospedra et al., IPIN 2014"),
    "ujib1": ("BLE, one room of University Jaume I", "G. M. Mendoza-Silva et al., Data 4, 12, 2019"),
}


def _fingerprints(name: str) -> DataSet:
    content, citation = FINGERPRINTS[name]
    return DataSet(
        "rssi",
        content,
        "darwinquezada/SURIMI",
        # the tables of BLE are in an earlier commit only
        "bac90d1e715108a34fc5fea4979e4f9fd1ad6b5c" if name == "ujib1" else "d8fa76a3502b1697a5b03aa4639bf1991b0f6c3c",
        "CC BY 4.0",
        citation,
        conversions.fingerprints,
        CHECKSUMS / f"ts-{name}.txt",
    )


DATA_SETS = {
    "s23-200": DataSet(
        "spectra",
        "Measured spectra of a moving RFID tag at 4 x 4 antennas, 915 MHz: the first 200 of the NeRF2 data set s23",
        "wenchaozheng/WRF-GS",
        "2123040698664552b10071d8b708028c77c939ac",
        "MIT (NeRF2)",
        "X. Zhao, Z. An, Q. Pan, L. Yang, NeRF2: Neural Radio-Frequency Radiance Fields, MobiCom 2023",
        conversions.s23,
        CHECKSUMS / "s23-200.txt",
    ),
    "newrf-bedroom": _newrf("bedroom"),
    "newrf-office": _newrf("office"),
    "newrf-conference": _newrf("conference"),
    "tetam-tracks": DataSet(
        "rssi",
        "BLE RSSI at twelve receivers, the beacon carried along nine paths through an office floor",
        "philotuxo/Position-Annotated-BLE-RSSI-Dataset",
        "77474b69dc7d73fc5b07b74d7b4b65f3235a663e",
        "CC0 1.0",
        "F. S. Danis, A. T. Naskali, A. T. Cemgil, C. Ersoy, Pervasive and Mobile Computing 81, 2022",
        conversions.tetam_tracks,
        CHECKSUMS / "tetam-tracks.txt",
    ),
    "kolak": DataSet(
        "rssi",
        "BLE RSSI at six anchors in a flat, the tag carried by a robot",
        "marckolak/ble-rss-fingerprints-calib2021",
        "0a69aaa7006909d3f8f9f3a14fcba9405d404fa5",
        "CC BY 4.0",
        "M. Kolakowski, Automated Calibration of RSS Fingerprinting Based Systems, Sensors 21, 6270, 2021",
        conversions.kolak,
        CHECKSUMS / "kolak.txt",
    ),
    "dcm-rssi": DataSet(
        "rssi",
        "Wi-Fi RSSI of a robot for 92 positions of the router in a room of 5 x 6 m",
        "wenhaol/DCM-RSSI",
        "86d2d21bb7d33569cefd75912f369156d86e42c1",
        "MIT",
        "Y. Yang et al., Integrating Online Learning and Connectivity Maintenance, IROS 2024",
        conversions.dcm,
        CHECKSUMS / "dcm-rssi.txt",
    ),
    "lora-campus": DataSet(
        "rssi",
        "LoRa RSSI over 3 km of a campus, one gateway, on foot and by car",
        "oliveiraleo/LoRa-RSSI-dataset-outdoor",
        "4c3cd274f8b94c01f7e8edbb9d466709de6f5cbd",
        "CC BY-NC-SA 4.0 (not for commercial use)",
        "L. Oliveira, L. Chaves, E. Silva, Explorando o RSSI na Geração de Chaves para LoRaWAN, SBSeg 2023",
        conversions.lora,
        CHECKSUMS / "lora-campus.txt",
    ),
    "wifi-rooms/office": _wifi_room("office"),
    "wifi-rooms/lecture-theatre": _wifi_room("lecture-theatre"),
    "wifi-rooms/corridor": _wifi_room("corridor"),
    **{f"ts-{name}": _fingerprints(name) for name in FINGERPRINTS},
}


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
