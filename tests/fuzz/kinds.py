"""Kinds of fuzzed files: one function for each kind writes a well-formed sample and returns its reader.

A format or a kind of model joins by a sample here (a test fails for one without), a task by its options in
`commands.py`.
"""

import functools
import json
import random
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
from samples import (
    snapshot_arrays,
    snapshots,
    survey,
    write_captures,
    write_deepmimo,
    write_dichasus,
    write_espargos,
    write_nerf2,
    write_nerf2_rssi,
    write_paths,
    write_snapshots,
    write_survey,
)
from scipy.io import savemat
from small import FLOOR, PUBLISHED, PUBLISHED_RSSI

from augment import Mixed
from augment.estimators.baselines import NearestSpectrum
from augment.estimators.kernel_regression import KernelRegression
from fuzz import containers, runs
from fuzz.commands import config_file
from fuzz.misuse import CALLS, misuse
from swiftwrf import (
    AngularGrid,
    MatchedField,
    Rssi,
    RssiLocator,
    Spectra,
    fit,
    fit_rssi,
    load,
    load_rssi,
    load_spectra,
    make_model,
    rssi_room,
    simulated_room,
)
from swiftwrf.array.planar import LIGHT_SPEED
from swiftwrf.contrib.published import NeRF2Rssi
from swiftwrf.data.coordinates import Floors
from swiftwrf.data.rssi import Offsets
from swiftwrf.data.writing import write_rssi, write_spectra
from swiftwrf.gp import Kernel
from swiftwrf.models import FIELD_MODELS
from swiftwrf.models.coarray import CoarrayModel
from swiftwrf.models.geometry import GeometryModel, HybridModel
from swiftwrf.models.geometry.fit import observe
from swiftwrf.models.geometry.path_gains import fit_path_gains
from swiftwrf.models.swiftwrf_paper import SwiftWRFPaper
from swiftwrf.rssi import PairModel, RssiPaperModel

N = 12
GRID = AngularGrid.hemisphere(8, 32)
SNAPSHOTS = snapshots(n=N, count=2, side=2)
TINY = SwiftWRFPaper(n_primitives=3, steps=12, check_every=6).config
Reader = Callable[[Path], object]
Attempt = Callable[[random.Random, Path], object]


def spectra_nerf2(folder: Path) -> None:
    write_nerf2(folder, [np.arange(8 * 32, dtype=np.uint8).reshape(8, 32)] * N, "[0, 0, 0, 1]\nname: a")
    (folder / "train_index.txt").write_text("".join(f"{i:05d}\n" for i in range(1, 11)))
    (folder / "test_index.txt").write_text("00011\n00012\n")


def rssi_nerf2(folder: Path) -> None:
    write_nerf2_rssi(folder, "a,b", "a: [0, 0, 1]\nb: [5, 0, 1]\n", ["-50,-100"] * N)
    (folder / "train_index.txt").write_text("".join(f"{i}\n" for i in range(10)))
    (folder / "test_index.txt").write_text("10\n11\n")


def spectra_as_written(folder: Path) -> None:
    data = SNAPSHOTS.spectra(GRID)
    label, frequency = data.label.flip(0), LIGHT_SPEED / data.array.wavelength + 1e6 * torch.arange(2).double()
    write_spectra(replace(data, label=label, frequency_hz=frequency), folder)


def rssi_as_written(folder: Path) -> None:
    phones = pd.Series(["old", "new"] * (N // 2), name="phone")
    offsets = Offsets("phone", "new", {"new": 0.0, "old": -8.0}, 0.5)
    known = {"floors": Floors(("0", "1"), (1.0, 4.0)), "time": torch.arange(float(N)), "plan_scale": 20.0}
    data = replace(_floor().subset(range(N)), groups=phones, offsets=offsets, labels=("phone",), **known)
    write_rssi(data, folder)


def captures(folder: Path, **form: Any) -> None:
    pytest.importorskip("csiread", reason="needs the extra csi")
    write_captures(folder, n=3, **form)


def snapshots_mat(folder: Path, **options: Any) -> None:
    arrays = {name: np.atleast_2d(value) for name, value in snapshot_arrays(SNAPSHOTS).items()}
    savemat(folder / "snapshots.mat", arrays, **options)


def survey_parquet(folder: Path) -> None:
    survey().to_parquet(folder / "walk.parquet")


def survey_json(folder: Path) -> None:
    points = [{"at": [row.pop("x"), row.pop("y")], "scan": row} for row in survey().to_dict("records")]
    (folder / "walk.json").write_text(json.dumps({"survey": [{"name": "a", "points": points}]}))


def track_gpx(folder: Path) -> None:
    points = (
        f'<trkpt lat="47.{n}" lon="8.{n}"><extensions><rssi>-{n}</rssi></extensions></trkpt>' for n in range(40, 60)
    )
    (folder / "walk.gpx").write_text(f"<gpx><trk><trkseg>{''.join(points)}</trkseg></trk></gpx>")


@functools.cache
def _room() -> Spectra:
    return simulated_room(n=12, grid=GRID)


@functools.cache
def _floor() -> Rssi:
    return replace(rssi_room(n=40).receivers(["1", "2"]), receiver_names=("NA", "12:34:56"))


def _of_the_floor() -> GeometryModel:
    return GeometryModel.of_planes(_room(), [FLOOR])


def _hybrid() -> HybridModel:
    model = HybridModel().fit(_room(), like=_of_the_floor())
    model.path_gains = fit_path_gains(_of_the_floor(), observe(_room())[0], Kernel(), "tight")
    return model


def _matched_field() -> MatchedField:
    room = simulated_room(n=20, grid=GRID)
    locator = MatchedField(spacing=0.5, n_best=20, n_background=10, n_split=4)
    return locator.fit(room, room=GeometryModel.of_planes(room, [FLOOR]))


MODELS: dict[str, Callable[[], Any]] = {
    "swiftwrf model": lambda: fit(_room(), n_primitives=3),
    "swiftwrf_paper model": lambda: SwiftWRFPaper(TINY).fit(_room()),
    "co-array model": lambda: CoarrayModel().fit(_room()),
    "geometry model": _of_the_floor,
    "hybrid model": _hybrid,
    "pixel Gaussian process": lambda: make_model("gp").fit(_room()),
    "inverse-distance model": lambda: make_model("idw").fit(_room()),
    "nearest-spectrum model": lambda: make_model("nearest").fit(_room()),
    "rssi model": lambda: fit_rssi(_floor()),
    "rssi paper model": lambda: RssiPaperModel(steps=2).fit(_floor()),
    "nerf2 model": lambda: FIELD_MODELS["nerf2"](PUBLISHED["nerf2"]).fit(_room()),
    "wrf-gs model": lambda: FIELD_MODELS["wrfgs"](PUBLISHED["wrfgs"]).fit(_room()),
    "nerf2 rssi model": lambda: NeRF2Rssi(PUBLISHED_RSSI).fit(_floor()),
    "vae model": lambda: FIELD_MODELS["vae"](PUBLISHED["vae"]).fit(_room()),
    "dcgan model": lambda: FIELD_MODELS["dcgan"](PUBLISHED["dcgan"]).fit(_room()),
    "rssi pair model": lambda: PairModel(new_places=False).fit(_floor()),
    "kernel regression": lambda: KernelRegression().fit(Mixed.measured(_room())),
    "nearest spectrum": lambda: NearestSpectrum().fit(Mixed.measured(_room())),
    "RSSI locator": lambda: RssiLocator(n_cells=200).fit(rssi_room(n=40)),
    "matched-field locator": _matched_field,
}


def rssi_survey(folder: Path) -> None:
    write_survey(folder)
    (folder / "receivers.csv").write_text("receiver,x,y,z\n" + "".join(f"{r},1,1,2\n" for r in "abcd"))


def read_spectra(folder: Path) -> Spectra:
    data = load_spectra(folder)
    return _checked(data)


def read_snapshots(folder: Path) -> Spectra:
    return _checked(load_spectra(folder, grid=GRID))


def read_first_station(folder: Path) -> Spectra:
    return _checked(load_spectra(folder, grid=GRID, station=1))


def _checked(data: Spectra) -> Spectra:
    assert all(t.isfinite().all() for t in (data.position, data.spectrum, data.label))
    assert 0 <= float(data.spectrum.min()) <= float(data.spectrum.max()) <= 1 + 1e-6
    return data


def read_rssi(folder: Path) -> Rssi:
    data = load_rssi(folder)
    assert data.transmitter_position.isfinite().all()
    assert data.located or data.receiver_position.isnan().all()
    assert all(isinstance(name, str) and name for name in data.receiver_names)
    return data


def predicted(model: Any) -> torch.Tensor:
    found = model.predict(torch.tensor([[3.0, 2.5, 1.2]]))
    return torch.cat([values.ravel() for values in (found.mean, found.std) if values is not None])


def estimated(estimator: Any) -> torch.Tensor:
    assert isinstance(estimator, KernelRegression | NearestSpectrum)
    return estimator.predict(_room().spectrum[:2].flip(2))


def located(locator: Any) -> torch.Tensor:
    if isinstance(locator, RssiLocator):
        return locator.locate(torch.full((1, len(locator.receiver_names)), -70.0)).median
    assert isinstance(locator, MatchedField)
    return locator.locate(_room().spectrum[:1]).median


ANSWERS = {  # others predict
    **dict.fromkeys(("kernel regression", "nearest spectrum"), estimated),
    **dict.fromkeys(("RSSI locator", "matched-field locator"), located),
}


@functools.cache
def fitted(name: str) -> Any:
    """Return a model of this kind."""
    return MODELS[name]()


def save(name: str, folder: Path) -> None:
    """Save a model of this kind."""
    fitted(name).save(folder / "model")


def answer(name: str, model: Any) -> torch.Tensor:
    """Return what a model of this kind predicts, estimates or locates."""
    found = ANSWERS.get(name, predicted)(model)
    assert found.isfinite().all()
    return found


def go_on(folder: Path) -> SwiftWRFPaper:
    """A fit from its state."""
    return SwiftWRFPaper(TINY).fit(_room(), checkpoint=folder / "state")


DATA: dict[str, tuple[Callable[[Path], object], Reader]] = {
    "format of spectra nerf2": (spectra_nerf2, read_spectra),
    "format of spectra paths": (write_paths, read_spectra),
    "format of spectra deepmimo": (functools.partial(write_deepmimo, n=N), read_snapshots),
    "format of array snapshots snapshots": (functools.partial(write_snapshots, data=SNAPSHOTS), read_snapshots),
    "format of array snapshots records": (write_espargos, read_snapshots),
    "records with offsets": (functools.partial(write_dichasus, offsets=True), read_first_station),
    "format of array snapshots captures": (captures, read_snapshots),
    "captures in pcap": (functools.partial(captures, suffix=".pcap", tones=64), read_snapshots),
    "spectra as an array": (lambda folder: write_spectra(_room(), folder), read_spectra),
    "spectra with channels": (spectra_as_written, read_spectra),
    "RSSI with groups": (rssi_as_written, read_rssi),
    "snapshots in HDF5": (functools.partial(write_snapshots, name="snapshots.h5", data=SNAPSHOTS), read_snapshots),
    "snapshots in MATLAB": (snapshots_mat, read_snapshots),
    "snapshots in compressed MATLAB": (functools.partial(snapshots_mat, do_compression=True), read_snapshots),
    "format of RSSI nerf2": (rssi_nerf2, read_rssi),
    "survey in Parquet": (survey_parquet, read_rssi),
    "format of RSSI survey": (rssi_survey, read_rssi),
    "survey in JSON": (survey_json, lambda folder: read_rssi(folder / "walk.json")),
    "track in GPX": (track_gpx, lambda folder: read_rssi(folder / "walk.gpx")),
}
KINDS = DATA | {
    **{
        name: (functools.partial(save, name), lambda folder, name=name: answer(name, load(folder / "model")))
        for name in MODELS
    },
    "fit state": (go_on, go_on),
    "run of aoa on the page": (runs.run_of_aoa, runs.show),
    "run of rssi on the page": (runs.run_of_rssi, runs.show),
    "run of locate on the page": (runs.run_of_locate, runs.show),
    "followed run on the page": (runs.followed_run, runs.show),
}
ATTEMPTS: dict[str, Attempt] = {
    **{f"followed spectra, {name}": functools.partial(runs.followed_lines, name) for name in ("gp", "geometry")},
    "followed RSSI": functools.partial(runs.followed_lines, "rssi"),
    **{f"followed file {name}": functools.partial(runs.followed_file, name) for name in ("rows.csv", "rows.ndjson")},
    **{f"misuse of {name}": functools.partial(misuse, calls) for name, calls in CALLS.items()},
    "file of options": config_file,
    **containers.ATTEMPTS,
}
