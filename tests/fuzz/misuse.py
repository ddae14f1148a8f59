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
from swiftwrf.locate import Posterior
from swiftwrf.models.geometry import Plane
from swiftwrf.online import Follower
from swiftwrf.positions import MAX_COORDINATE_M
from swiftwrf.rssi.base import RssiPredictor

MAX_RSSI_DB = (
    300.0  # of any plausible prediction, and of its standard deviation: path loss of 50 dB a decade, 100 km away
)
FLOOR = {"x": [0.0, 1.0], "y": [0.0, 1.0], "z": [1.0, 1.0], "hall": [-50.0, -60.0]}
SPECTRA_OPTIONS = (
    "array", "pose", "moving", "grid", "label", "line_of_sight", "name", "fixed_position", "rotation", "index", "notes",
)  # fmt: skip
QUATERNION = (0.0, 0.0, 0.0, 1.0)
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


DATA: dict[str, Call] = {
    "Spectra(x, position)": lambda x: Spectra(x, spectra().position),
    "Spectra(spectra, x)": lambda x: Spectra(spectra().store[:], x),
    **{
        f"Spectra({name}=x)": lambda x, name=name: Spectra(spectra().store[:], spectra().position, **{name: x})
        for name in SPECTRA_OPTIONS
    },
    "Rssi(x, position)": lambda x: Rssi(x, rssi().transmitter_position),
    "Rssi(rssi, x)": lambda x: Rssi(rssi().rssi_dbm, x),
    **{
        f"Rssi({name}=x)": lambda x, name=name: Rssi(rssi().rssi_dbm, rssi().transmitter_position, **{name: x})
        for name in ("receiver_position", "receiver_names", "origin", "session", "time", "name", "index")
    },
    "from_frame(x)": Rssi.from_frame,
    "from_frame, a column": lambda x: Rssi.from_frame(pd.DataFrame(FLOOR | {"hall": [-50.0, x]}, dtype=object)),
    "from_frame, a coordinate": lambda x: Rssi.from_frame(pd.DataFrame(FLOOR | {"x": [0.0, x]}, dtype=object)),
    **{
        f"from_frame({name}=x)": lambda x, name=name: Rssi.from_frame(pd.DataFrame(FLOOR), **{name: x})
        for name in (
            "columns",
            "filler",
            "coordinates",
            "offset_by",
            "transmitter",
            "pool_by",
            "scale",
            "y_down",
            "up",
            "window",
            "receiver_position",
            "name",
        )
    },
    "split(x)": lambda x: rssi().split(x),
    "split(seed=x)": lambda x: spectra().split("block", x),
    "subset(x)": lambda x: spectra().subset(x),
    "rssi[x]": lambda x: rssi()[x],
    "receivers(x)": lambda x: rssi().receivers(x),
    "Snapshots(x, position)": lambda x: Snapshots(x, spectra().position, array=spectra().array),
    "Snapshots(array=x)": lambda x: Snapshots(torch.ones(14, 1, 16) + 0j, spectra().position, array=x),
    "calibrate(x)": calibrate,
    "load(x)": load,
    "load_spectra(x)": load_spectra,
    "load_rssi(x)": load_rssi,
    "simulated_room(n=x)": lambda x: simulated_room(n=x, grid=AngularGrid.hemisphere(2, 4)),
    "simulated_room(seed=x)": lambda x: simulated_room(n=2, seed=x, grid=AngularGrid.hemisphere(2, 4)),
    "simulated_room(grid=x)": lambda x: simulated_room(n=2, grid=x),
    "rssi_room(n=x)": lambda x: rssi_room(n=x),
    "rssi_room(seed=x)": lambda x: rssi_room(n=2, seed=x),
}
ARRAYS: dict[str, Call] = {
    "PlanarArray(x, 0.1)": lambda x: PlanarArray(x, 0.1),
    "PlanarArray(element, x)": lambda x: PlanarArray(torch.rand(4, 2), x),
    "square(x)": lambda x: PlanarArray.square(x, 1e9),
    "square(frequency_hz=x)": lambda x: PlanarArray.square(2, x),
    "square(spacing=x)": lambda x: PlanarArray.square(2, 1e9, x),
    "grid(x, 2)": lambda x: PlanarArray.grid(x, 2, 0.1, 1e9),
    "grid(spacing=x)": lambda x: PlanarArray.grid(2, 2, x, 1e9),
    "AngularGrid.hemisphere(x, 4)": lambda x: AngularGrid.hemisphere(x, 4),
    "AngularGrid(x, ...)": lambda x: AngularGrid(x, 0.1, 4, 0.0, 8),
    "AngularGrid(n_azimuth=x)": lambda x: AngularGrid(0.0, 0.1, 4, 0.0, x),
    "ArrayPose(x)": lambda x: ArrayPose(x, QUATERNION),
    "ArrayPose(orientation=x)": lambda x: ArrayPose((0.0, 0.0, 1.0), x),
    "Plane(x)": lambda x: Plane(x, 0.0, -0.5),
    "Plane(offset_m=x)": lambda x: Plane((1.0, 0.0, 0.0), x, -0.5),
    "Plane(gain=x)": lambda x: Plane((1.0, 0.0, 0.0), 0.0, x),
    "Plane(std_mm=x)": lambda x: Plane((1.0, 0.0, 0.0), 0.0, -0.5, x),
    "of_planes(x)": lambda x: GeometryModel.of_planes(x, []),
    "of_planes(spectra, x)": lambda x: GeometryModel.of_planes(spectra(), x),
    "of_planes(order=x)": lambda x: GeometryModel.of_planes(spectra(), [], x),
}
MODELS: dict[str, Call] = {
    "make_model(x)": make_model,
    "make_model(preset=x)": lambda x: make_model("gp", preset=x),
    "make_model(seed=x)": lambda x: make_model("gp", seed=x),
    "make_model(validation=x)": lambda x: make_model("coarray", validation=x),
    "SwiftWRF(n_primitives=x)": lambda x: make_model("swiftwrf", n_primitives=x),
    "GeometryModel(x)": GeometryModel,
    "fit(x)": fit,
    "fit_rssi(x)": fit_rssi,
    "fit_rssi(rssi, x)": lambda x: fit_rssi(rssi(), x),
    "RssiModel(x)": RssiModel,
    "RssiModel(seed=x)": lambda x: RssiModel(seed=x),
    "PairModel().fit(x)": lambda x: PairModel().fit(x),
    **{
        f"gp.fit({name}=x)": lambda x, name=name: make_model("gp").fit(spectra(), **{name: x})
        for name in ("like", "device", "checkpoint")
    },
    **{
        f"rssi.fit({name}=x)": lambda x, name=name: RssiModel(n_primitives=0).fit(rssi(), **{name: x})
        for name in ("pool", "device")
    },
    **{
        f"{name}.{method}(x)": lambda x, name=name, method=method: getattr(fitted(name), method)(x)
        for name in ("gp", "idw", "swiftwrf", "coarray", "nearest")
        for method in ("fit", "predict", "synthesize", "update", "forget", "aged", "plot")
        if method != "fit" or name != "swiftwrf"
    },
    "gp.predict(grid=x)": lambda x: fitted("gp").predict(spectra().position, x),
    "coarray.predict(grid=x)": lambda x: fitted("coarray").predict(spectra().position, x),
    "geometry.predict(x)": lambda x: planes().predict(x),
    "geometry.update(x)": lambda x: planes().update(x),
    "rssi.predict(x)": lambda x: rssi_model().predict(x),
    "rssi.update(x)": lambda x: rssi_model().update(x),
    "rssi.predict_detected(x)": lambda x: rssi_model().predict_detected(x),
    "rssi.plot(x)": lambda x: rssi_model().plot(x),
    "interval(x)": lambda x: rssi_model().predict(rssi().transmitter_position).interval(x),
    "save(x)": lambda x: fitted("nearest").save(x) if not isinstance(x, str | Path) else None,
    "Follower(x)": Follower,
    "Follower(gp, x)": lambda x: Follower(fitted("gp"), x),
    "step(x)": lambda x: Follower(rssi_model()).step(x),
    "Follower(false_alarm_rate=x)": lambda x: Follower(rssi_model(), None, x),
}
LOCATORS: dict[str, Call] = {
    "RssiLocator(x)": RssiLocator,
    "RssiLocator(n_cells=x)": lambda x: RssiLocator(n_cells=x),
    "RssiLocator().fit(x)": lambda x: RssiLocator(n_cells=50).fit(x),
    "RssiLocator().fit(model=x)": lambda x: RssiLocator(n_cells=50).fit(rssi(), model=x),
    "RssiLocator().fit(region=x)": lambda x: RssiLocator(n_cells=50).fit(rssi(), region=x),
    "locate(x)": lambda x: locator().locate(x),
    "credible_radius(x)": lambda x: locator().locate(rssi().rssi_dbm).credible_radius(x),
    "sample(x)": lambda x: locator().sample(x, 2, torch.Generator()),
    "sample(n=x)": lambda x: locator().sample(rssi().transmitter_position[:2], x, torch.Generator()),
    "MatchedField(x)": MatchedField,
    "MatchedField(spacing=x)": lambda x: MatchedField(spacing=x),
    "MatchedField().fit(x)": lambda x: MatchedField().fit(x),
    "MatchedField().fit(room=x)": lambda x: MatchedField().fit(simulated_room(n=16), room=x) if x is not None else None,
    "MatchedField().locate(x)": lambda x: MatchedField().locate(x),
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
