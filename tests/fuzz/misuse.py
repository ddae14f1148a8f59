"""Calls of the public interface with values of the wrong type, shape or size: plausible results, or one sentence."""

import random
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch

from swiftwrf import (
    AngularGrid,
    ArrayPose,
    FieldModel,
    FitError,
    GeometryModel,
    InputError,
    MatchedField,
    PairModel,
    Prediction,
    Rssi,
    RssiLocator,
    RssiModel,
    Snapshots,
    Spectra,
    calibrate,
    fit,
    fit_rssi,
    load,
    load_rssi,
    load_spectra,
    make_model,
    rssi_room,
    simulated_room,
)
from swiftwrf.array.planar import PlanarArray
from swiftwrf.contrib.online import Follower
from swiftwrf.locate import Posterior
from swiftwrf.models.geometry import Plane
from swiftwrf.positions import MAX_COORDINATE_M
from swiftwrf.rssi.base import RssiPredictor

# of any plausible prediction, and of its standard deviation: path loss of 50 dB a decade, 100 km away
MAX_RSSI_DB = 300.0
FLOOR = {"x": [0.0, 1.0], "y": [0.0, 1.0], "z": [1.0, 1.0], "hall": [-50.0, -60.0]}
SPECTRA_OPTIONS = (
    "array", "pose", "moving", "grid", "label", "line_of_sight", "name", "fixed_position", "rotation", "index", "notes",
)  # fmt: skip
RSSI_OPTIONS = ("receiver_position", "receiver_names", "origin", "session", "time", "name", "index")
FRAME_OPTIONS = (
    "columns", "filler", "coordinates", "offset_by", "transmitter", "pool_by", "scale", "y_down", "up", "window",
    "quantity", "unit",
    "receiver_position", "name",
)  # fmt: skip
Call = Callable[[Any], object]


@cache
def spectra() -> Spectra:
    return simulated_room(n=14, grid=AngularGrid.hemisphere(4, 8))


@cache
def rssi() -> Rssi:
    return rssi_room(n=36).receivers(["1", "2", "3"])


@cache
def fitted(name: str) -> FieldModel:
    options = {"n_primitives": 2} if name == "swiftwrf" else {}
    return make_model(name, **options).fit(spectra())


@cache
def rssi_model() -> RssiModel:
    """Return a model of the first rows, which the others update."""
    return RssiModel().fit(rssi().subset(torch.arange(30)))


@cache
def locator() -> RssiLocator:
    return RssiLocator(n_cells=50).fit(rssi())


@cache
def planes() -> GeometryModel:
    return GeometryModel.of_planes(spectra(), [Plane((0.0, 0.0, -1.0), 0.0, -0.6)])


@cache
def strange() -> tuple[Any, ...]:
    """Return values that a call does not expect."""
    arrays = [
        np.zeros(0), np.zeros(3), np.zeros((2, 3)), np.full((2, 3), np.nan), np.full((2, 3), np.inf), np.full((2, 3), 1e300),
        np.full((2, 3), 1e20), np.ones((2, 3), complex), np.array([["a", "b", "c"]]), np.array([[None, 1, 2]], dtype=object),
        np.ones((2, 3), bool), np.ones((2, 3), np.uint64), np.ma.masked_array(np.ones((2, 3)), np.eye(2, 3)),
        np.array(["2020-01-01"], "M8[D]"), np.zeros((1, 2, 3, 4)), np.full((2, 3), -1e30), np.float64(2), np.zeros((3, 0)),
    ]  # fmt: skip
    tensors = [
        torch.from_numpy(array) for array in arrays if isinstance(array, np.ndarray) and array.dtype.kind in "bfc"
    ]
    others = [
        torch.ones(2, 3, requires_grad=True), torch.ones(2, 3).to_sparse(), torch.ones(2, 3, device="meta"),
        torch.full((2, 3), 7e4, dtype=torch.float64).half(), pd.DataFrame(FLOOR), pd.DataFrame(), pd.Series([1.0, 2.0]),
        spectra(), rssi(), fitted("gp"), rssi_model(), locator(), torch.device("cuda"), AngularGrid.hemisphere(2, 4),
        RssiModel(), make_model("gp"), Path("nowhere"), slice(None), range(3), object(), int, Exception("a"),
    ]  # fmt: skip
    plain = [
        None, True, False, 0, -1, 1, 3, 2.5, float("nan"), float("inf"), -float("inf"), 1e300, 1e-320, 10**400, -(10**400),
        2**63, "", "a", "1", "nan", "cuda", "cpu", "\0", "\udcff", "x" * 5000, "/", b"a", 1j, [], [[]], [None], ["a"],
        [1, "a"], [[1, 2], [3]], [[1, 2, 3]], [[10**400, 0, 0]], [[1e300, 0, 0]], [[True, 0, 0]], (), (0,), (1, 2, 3),
        [5, -1], (1.0, 2.0, float("nan")), {}, {"x": 1}, {"a": [1, 2, 3]}, {1, 2}, iter([1.0, 2.0]), [[[0.5] * 8] * 4],
        0.9999999999999999, ["a", "a", "b"], ("receiver01",),
    ]  # fmt: skip
    return (*plain, *arrays, *tensors, *others)


def each(function: Callable[..., object], *options: str, **valid: Any) -> dict[str, Call]:
    """Return calls of a function, in each of which a strange value takes the place of one argument."""
    return {
        f"{function.__qualname__}({name}=x)": lambda x, name=name: function(**valid | {name: x})
        for name in (*valid, *options)
    }


def named(*functions: Callable[..., object]) -> dict[str, Call]:
    """Return functions by name."""
    return {function.__qualname__: function for function in functions}


DATA: dict[str, Call] = {
    **each(Spectra, *SPECTRA_OPTIONS, spectra=spectra().store[:], position=spectra().position),
    **each(Rssi, *RSSI_OPTIONS, rssi_dbm=rssi().rssi_dbm, transmitter_position=rssi().transmitter_position),
    **each(Rssi.from_frame, *FRAME_OPTIONS, frame=pd.DataFrame(FLOOR)),
    "from_frame, a column": lambda x: Rssi.from_frame(pd.DataFrame(FLOOR | {"hall": [-50.0, x]}, dtype=object)),
    "from_frame, a coordinate": lambda x: Rssi.from_frame(pd.DataFrame(FLOOR | {"x": [0.0, x]}, dtype=object)),
    **named(rssi().split, spectra().subset, rssi().__getitem__, rssi().receivers),
    "split(seed=x)": lambda x: spectra().split("block", x),
    **each(Snapshots, channel=torch.ones(14, 1, 16) + 0j, position=spectra().position, array=spectra().array),
    **named(calibrate, load, load_spectra, load_rssi),
    **each(simulated_room, n=2, seed=0, grid=AngularGrid.hemisphere(2, 4)),
    **each(rssi_room, n=2, seed=0),
}
ARRAYS: dict[str, Call] = {
    **each(PlanarArray, element=torch.rand(4, 2), wavelength=0.1),
    **each(PlanarArray.square, side=2, frequency_hz=1e9, spacing=0.1),
    **each(PlanarArray.grid, rows=2, columns=2, spacing=0.1, frequency_hz=1e9),
    **each(AngularGrid.hemisphere, n_elevation=2, n_azimuth=4),
    **each(AngularGrid, elevation_start=0.0, elevation_step=0.1, n_elevation=4, azimuth_start=0.0, n_azimuth=8),
    **each(ArrayPose, position=(0.0, 0.0, 1.0), orientation=(0.0, 0.0, 0.0, 1.0)),
    **each(Plane, normal=(1.0, 0.0, 0.0), offset_m=0.0, gain=-0.5, std_mm=0.0, probability=0.5, rival_m=1.0),
    **each(GeometryModel.of_planes, link=spectra(), planes=[], order=2),
}
MODELS: dict[str, Call] = {
    **each(make_model, "preset", "seed", name="gp"),
    "make_model(validation=x)": lambda x: make_model("coarray", validation=x),
    "SwiftWRF(n_primitives=x)": lambda x: make_model("swiftwrf", n_primitives=x),
    **named(GeometryModel, fit, PairModel().fit),
    **each(fit_rssi, "config", train=rssi()),
    **each(RssiModel, "config", "seed"),
    **each(make_model("gp").fit, "like", "device", "checkpoint", train=spectra()),
    **each(RssiModel(n_primitives=0).fit, "pool", "device", train=rssi()),
    **{
        f"{name}.{method}(x)": lambda x, name=name, method=method: getattr(fitted(name), method)(x)
        for name in ("gp", "idw", "swiftwrf", "coarray", "nearest")
        for method in ("fit", "predict", "synthesize", "update", "forget", "aged", "plot")
        if method != "fit" or name != "swiftwrf"
    },
    **{
        f"{name}.predict(grid=x)": lambda x, name=name: fitted(name).predict(spectra().position, x)
        for name in ("gp", "coarray")
    },
    **{
        f"geometry.{method}(x)": lambda x, method=method: getattr(planes(), method)(x)
        for method in ("predict", "update")
    },
    **{
        f"rssi.{method}(x)": lambda x, method=method: getattr(rssi_model(), method)(x)
        for method in ("predict", "update", "predict_detected", "plot")
    },
    "interval(x)": lambda x: rssi_model().predict(rssi().transmitter_position).interval(x),
    "save(x)": lambda x: fitted("nearest").save(x) if not isinstance(x, str | Path) else None,
    "Follower(x)": Follower,
    "Follower(gp, x)": lambda x: Follower(fitted("gp"), x),
    "step(x)": lambda x: Follower(rssi_model()).step(x),
    "Follower(false_alarm_rate=x)": lambda x: Follower(rssi_model(), None, x),
}
LOCATORS: dict[str, Call] = {
    **each(RssiLocator, "config", "n_cells"),
    **each(RssiLocator(n_cells=50).fit, "model", "region", train=rssi()),
    "locate(x)": lambda x: locator().locate(x),
    "credible_radius(x)": lambda x: locator().locate(rssi().rssi_dbm).credible_radius(x),
    "sample(x)": lambda x: locator().sample(x, 2, torch.Generator()),
    "sample(n=x)": lambda x: locator().sample(rssi().transmitter_position[:2], x, torch.Generator()),
    **each(MatchedField, "config", "spacing"),
    **named(MatchedField().fit, MatchedField().locate),
    "MatchedField().fit(room=x)": lambda x: MatchedField().fit(simulated_room(n=16), room=x) if x is not None else None,
}
CALLS = {"data": DATA, "arrays and rooms": ARRAYS, "models": MODELS, "locators": LOCATORS}


def misuse(calls: dict[str, Call], draw: random.Random, folder: Path) -> None:
    """Call a function with a strange value.

    Raises:
        InputError: As the function.
        AssertionError: Another exception, or an implausible result.
    """
    name, value = draw.choice(list(calls)), draw.choice(strange())
    try:
        check_plausible(calls[name](value))
    except (InputError, FitError):
        raise
    except Exception as error:
        raise AssertionError(f"{name}, {type(value).__name__} {str(value)[:60]!r}: {error!r}") from error


def check_plausible(found: object) -> None:
    """Refuse predictions, measurements, positions and models that no measured scene has."""
    match found:
        case Prediction():
            limit = 1 + 1e-6 if found.grid is not None else MAX_RSSI_DB
            assert found.mean.isfinite().all()
            assert not len(found.mean) or found.mean.abs().max() <= limit
            assert found.std is None or bool(((found.std > 0) & (found.std <= MAX_RSSI_DB)).all())
        case Posterior():
            assert found.median.isfinite().all()
            assert not len(found) or found.median.abs().max() <= 2 * MAX_COORDINATE_M
        case Rssi():
            assert not bool((found.rssi_dbm.abs() > MAX_RSSI_DB).any())
            assert bool((found.transmitter_position.abs() <= MAX_COORDINATE_M).all())
        case Spectra():
            values = found.store[:]
            assert bool(((values >= 0) & (values <= 1 + 1e-6)).all())
            assert bool((found.position.abs() <= MAX_COORDINATE_M).all())
        case RssiPredictor() | FieldModel() if found.is_fitted and not isinstance(found, PairModel):
            check_plausible(found.predict(torch.tensor([[1.0, 2.0, 1.0]])))
        case torch.Tensor():
            assert not found.is_floating_point() or not bool(found.isinf().any())
        case tuple() if len(found) < 10:
            for part in found:
                check_plausible(part)
