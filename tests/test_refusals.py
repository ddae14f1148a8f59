"""Calls that have no answer: each is refused in one sentence, with the words of its row."""

import math
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import torch
from fuzz import kinds
from fuzz.misuse import fitted, locator, planes, rssi, rssi_model, spectra
from hard_cases import GRID, HARD_CASES, random_scene

from augment import choose_model, mix, synthetic_positions, turbo_learning, withhold
from augment.estimators import make_estimator
from augment.suggest import suggest, suggest_positions
from swiftwrf import (
    AngularGrid,
    ArrayPose,
    GeometryModel,
    InputError,
    MatchedField,
    Prediction,
    Rssi,
    RssiLocator,
    RssiModel,
    Snapshots,
    Spectra,
    SwiftWRF,
    fit,
    fit_rssi,
    inspect,
    load,
    load_snapshots,
    load_spectra,
    make_model,
    predict,
    rasterize,
    rssi_room,
    simulated_room,
)
from swiftwrf.array.planar import PlanarArray
from swiftwrf.choices import RSSI_PREDICTORS
from swiftwrf.contrib.comparison.predictors import compared, make_predictor
from swiftwrf.contrib.online import Follower, prequential
from swiftwrf.contrib.raytraced import Tracing
from swiftwrf.contrib.subspace import esprit
from swiftwrf.data.simulated import ShoeboxRoom
from swiftwrf.data.splits import folds
from swiftwrf.data.store import Store
from swiftwrf.gp import Kernel
from swiftwrf.locate import Posterior, smoothed
from swiftwrf.metrics import ssim
from swiftwrf.models.geometry import Plane
from swiftwrf.models.swiftwrf_paper import SwiftWRFPaperConfig
from swiftwrf.rssi import RssiComparison, RssiPaperModel, compare, estimate_floor_attenuation, estimate_offsets
from swiftwrf.rssi.maps import RssiMap

ROOM = simulated_room(n=24, grid=AngularGrid.hemisphere(9, 36))
NAN_POSITION = ROOM.position.where(torch.arange(24)[:, None] != 3, torch.nan)
FACING_X = ArrayPose((0.1, 2.4, 1.2), (0.0, math.sqrt(0.5), 0.0, math.sqrt(0.5)))
FOUR, POINT = PlanarArray.square(2, 1e9), PlanarArray([[0.0, 0.0]], 0.1)
NAN, INF = math.nan, math.inf
WAVE = torch.ones(2, 5, 4, dtype=torch.complex128)  # (positions, snapshots, elements)
WIDE = PlanarArray.grid(2, 2, spacing=0.1, frequency_hz=2.4e9)
ROWS = rssi_room(n=20)


def of_spectra(values=ROOM.spectrum, position=ROOM.position, **options):
    return lambda: Spectra(values, position, **options)


def of_room(**changes):
    return lambda: replace(ROOM, **changes)


def of_snapshots(channel, **options):
    return lambda: Snapshots(channel, torch.rand(5, 3), array=FOUR, **options)


def of_rssi(values, position=((0, 0, 0),), **options):
    return lambda: Rssi(values, position, **options)


def of_table(table, **options):
    return lambda: Rssi.from_frame(table, **options)


NUMBERS = np.arange(24.0)
LINKS = pd.DataFrame({"rx_x": NUMBERS, "rx_y": 0.0, "tx_x": NUMBERS % 4, "tx_y": 1.0, "rssi": -50.0 - NUMBERS})
RADIOS = pd.DataFrame({"x": NUMBERS, "y": 0.0, "a4:56:cc:00:10:b0": -50.0, "a4:56:cc:00:10:b1": -60.0})
DATA = [
    ("5 positions, but store has 24", of_spectra(position=ROOM.position[:5])),
    (r"spectra must have shape \(n, n, n\)", of_spectra(ROOM.spectrum[0])),
    (r"magnitudes in \[0, 1\]", of_spectra(-20 * ROOM.spectrum)),  # decibels
    ("spectra must be finite; row 0", of_spectra(ROOM.spectrum * torch.nan)),
    ("position must be finite; row 3", of_spectra(position=NAN_POSITION)),
    (r"position must have shape \(n, 3\)", of_spectra(position=ROOM.position[:, :2])),
    ("position must be numbers", of_spectra(position=[["a", "b", "c"]] * 24)),
    (r"none empty or with tabs or line breaks, got 'a\\tb'$", of_rssi([[0.0, 0.0]], receiver_names=["b", "a\tb"])),
    ("label has 7 rows", of_room(label=ROOM.label[:7])),
    ("label must have shape", of_spectra(label=ROOM.label[:, 0])),
    ("line_of_sight has 3 rows", of_room(line_of_sight=torch.ones(3))),
    ("moving must be 'transmitter' or", of_spectra(moving="reciever")),
    ("do not fit a grid", of_spectra(grid=AngularGrid.hemisphere(9, 30))),
    ("leave them out", of_spectra(pose=FACING_X, fixed_position=(0, 0, 0))),
    ("position 2 of spectra is that of the fixed end", of_spectra(pose=ArrayPose((*ROOM.position[2].tolist(),)))),
    ("Spectra has no colour", of_spectra(colour="red")),
    ("spectra and their positions", lambda: Spectra(ROOM.spectrum)),
    ("'day' .* outside 0 to 23", of_room(named_splits={"day": (torch.arange(20), torch.tensor([24]))})),
    ("needs the pose", of_snapshots(torch.ones(5, 4).cfloat())),
    (r"channel must have shape \(5, 4\)", of_snapshots(torch.ones(5, 3).cfloat(), pose=FACING_X)),
    ("channel must be complex64 numbers", of_snapshots(torch.ones(5, 4), pose=FACING_X)),
    ("channel must be finite", of_snapshots(np.full((5, 4), 1e300j), pose=FACING_X)),
    ("spectra must be real", of_spectra(ROOM.spectrum + 0j)),
    ("has masked values", of_spectra(np.ma.masked_less(ROOM.spectrum, 0.1))),
    ("must be float32 numbers", of_spectra(ROOM.spectrum > 0.5)),
    ("position must be real", of_spectra(position=ROOM.position + 0j)),
    ("position must be .* at most 1e.09; row 0", of_spectra(position=1e9 * ROOM.position)),
    ("fixed_position must be .* at most 1e.09", of_spectra(fixed_position=(0, 0, 1e300))),
    ("line_of_sight must be True or False, got 0.3", of_room(line_of_sight=[0.3] * 24)),
    ("convert degrees by deg2rad", of_room(label=torch.full((24, 2), 200.0))),
    ("label must be finite, or nan", of_room(label=torch.full((24, 2), INF))),
    ("index must be whole numbers, got 0.5", of_room(index=torch.arange(24) + 0.5)),
    ("must be a rotation matrix", of_room(rotation=2 * torch.eye(3))),
    ("must be a rotation matrix", of_room(rotation=-torch.eye(3))),
    ("rssi_dbm must be finite, or nan", of_rssi([[-INF]])),
    ("4 positions, but rssi_dbm has 3 rows", of_rssi([[-50.0]] * 3, torch.rand(4, 3))),
    ("2 receivers, but the names", of_rssi([[-50.0, -60]], receiver_names=["a", "a"])),
    ("row 2, receiver receiver1: 60 dBm", of_rssi([[-50.0], [60.0]], torch.rand(2, 3))),
    ("-99999 dBm is no received power", of_rssi([[-99999.0]])),
    ("rssi_dbm must be float64 numbers", of_rssi([[True]])),
    ("rssi_dbm must be real", of_rssi([[-50j]])),
    ("has masked values", of_rssi(np.ma.masked_values([[-50.0, 100.0]], 100.0))),
    ("transmitter_position must be .* at most 1e.09", of_rssi([[-50.0]], [[0, 0, 2e9]])),
    ("receiver_position must be .* at most 1e.09", of_rssi([[-50.0]], receiver_position=[[2e9, 0, 0]])),
    ("receiver_position must be real", of_rssi([[-50.0]], receiver_position=[[1j, 0, 0]])),
    ("time must be finite, or nan", of_rssi([[-50.0]], time=[INF])),
    ("must be a list, of which each is a text", of_rssi([[-50.0, -60]], receiver_names="ab")),
    ("must be a list of texts", of_rssi([[-50.0]], receiver_names=[" "])),
    ("must be a list, of which each is a text", of_rssi([[-50.0]], receiver_names=[1])),
    ("must be a list of texts", of_rssi([[-50.0]], receiver_names=["a\r\nb"])),
    ("where it is unknown; row 1", of_rssi([[-50.0, -60]], receiver_position=[[0, 0, 0], [0, 0, NAN]])),
    ("seed must be a whole number at least 0, got 0.5", lambda: ROOM.split("block", 0.5)),
    ("seed must be a whole number", lambda: ROWS.split(seed="a")),
    ("rows of simulated-room must be a list of numbers below 24", lambda: ROOM.subset([24])),
    ("a mask of that length", lambda: ROOM.subset(torch.ones(10, dtype=torch.bool))),
    ("a list of numbers below 24", lambda: ROOM[[0.5]]),
    ("must be a list of numbers", lambda: ROOM[3]),
    ("moving must be", lambda: simulated_room(moving="reciever")),
    ("n must be a whole number at least 1", lambda: simulated_room(n=0)),
    ("phase_noise must be", lambda: simulated_room(phase_noise=-1.0)),
    ("n must be", lambda: rssi_room(n=-1)),
    ("validation must be 'random' or 'block'", lambda: folds(ROOM.position, "blok", 0)),
    ("every must be", lambda: load_spectra("x", every=0)),
    ("station must be", lambda: load_snapshots("x", station=-1)),
    ("order must be", lambda: Tracing(order=-1)),
    ("size must be", lambda: ShoeboxRoom(size=(0.0, 1.0, 1.0))),
    ("takes the columns of x, y", of_table(LINKS, transmitter=["tx_x", "nowhere"])),
    ("takes the columns of x, y", of_table(LINKS, transmitter=["tx_x", "tx_x"])),
    ("RSSI of 2 receivers; name one", of_table(LINKS.assign(rssi2=-50.0), transmitter=())),
    ("no column 'tag'", of_table(LINKS, transmitter=["tag"])),
    ("pool by their names", of_table(RADIOS, pool_by="x")),
    ("no column and no regular expression", of_table(RADIOS, pool_by="(")),
    ("a regular expression with one group", of_table(RADIOS, pool_by="a4.*")),
    ("matches no receiver", of_table(RADIOS, pool_by="(hall).*")),
    ("needs measurements with sessions", lambda: folds(ROOM.position, "session", 0)),
    ("session has 2 rows", of_rssi([[-60.0]] * 20, torch.rand(20, 3), session=["monday", "tuesday"])),
    *(
        ("frequency_hz", of_snapshots(torch.ones(5, 2, 4).cfloat(), pose=FACING_X, frequency_hz=frequency))
        for frequency in ([2.4e9], [2.4e3, 2.41e3], [2.4e9, 5.2e9])  # one, in MHz, two bands
    ),
    ("no receiver 'c'", lambda: rssi().plot("c")),
    ("outside the room", lambda: ShoeboxRoom().paths(torch.tensor([[-1.0, 1, 1]]), torch.ones(1, 3))),
    ("one place", lambda: ShoeboxRoom().paths(torch.ones(1, 3), torch.ones(1, 3))),
]
ARRAYS = [
    ("side must be a whole number at least 1", lambda: PlanarArray.square(0, 1e9)),
    ("frequency_hz must be a number above 0", lambda: PlanarArray.square(4, 0)),
    ("frequency_hz must be", lambda: PlanarArray.square(4, NAN, 0.1)),
    ("wavelength must be", lambda: PlanarArray.square(4, INF, 0.1)),
    ("spacing must be a number above 0", lambda: PlanarArray.square(4, 1e9, spacing=-1.0)),
    ("spacing must be", lambda: PlanarArray.square(4, 1e9, NAN)),
    ("rows must be a whole number", lambda: PlanarArray.grid(2.5, 2, 0.1, 1e9)),
    ("spacing must be a number above 0", lambda: PlanarArray.grid(2, 2, 0.0, 1e9)),
    ("element must be real", lambda: PlanarArray([[0.0, 1j]], 1.0)),
    ("wavelength must be a number above 0", lambda: PlanarArray([[0.0, 0.0]], "1 m")),
    ("n_azimuth must be a whole number", lambda: AngularGrid.hemisphere(10, 40.0)),
    ("n_elevation must be a whole number at least 2", lambda: AngularGrid.hemisphere(0, 40)),
    ("elevation_start must be", lambda: AngularGrid(NAN, 0.1, 90, 0.0, 360)),
    ("elevation_step must be", lambda: AngularGrid(0.0, NAN, 90, 0.0, 360)),
    ("elevation_step must be", lambda: AngularGrid(0.0, -0.1, 90, 0.0, 360)),
    (r"position must have shape \(3\), got \(2,\)", lambda: ArrayPose((0.0, 1.0))),
    ("unit quaternion", lambda: ArrayPose((0, 0, 0), (0, 0, 0, 2))),
    ("finite", lambda: ArrayPose((0, NAN, 0))),
    ("at least as many snapshots", lambda: FOUR.spectrum(WAVE[:, :3], GRID, "capon")),
    ("unknown beamformer 'music'", lambda: FOUR.spectrum(WAVE, GRID, "music")),
    ("at most half a wavelength, along two directions; use MUSIC", lambda: esprit(WIDE, WAVE)),
    ("at least 7 x 7", lambda: ssim(torch.zeros(6, 20), torch.zeros(6, 20))),
    ("matern12_length must be", lambda: Kernel(matern12_length=NAN)),
    ("matern32_length must be", lambda: Kernel(matern32_length=0.0)),
    ("matern12_weight must be", lambda: Kernel(matern12_weight=2.0)),
    ("noise must be", lambda: Kernel(noise=-1.0)),
]


def of_primitives(change=lambda m, c, w: (m, c, w), **options):
    """Rasterize random primitives after a change of their mean, Cholesky factor and weight."""
    return lambda: rasterize(*change(*(x.detach() for x in random_scene())), GRID, **options)


def of_case(name, value, backend):
    """Rasterize primitives, of which one value is not finite."""

    def call():
        case = HARD_CASES["both sides of the seam"]
        inputs = dict(zip(("mean", "cholesky", "weight"), (x.clone() for x in case.inputs), strict=True))
        inputs[name].view(-1)[1] = value
        rasterize(**inputs, grid=case.grid, backend=backend)

    return call


PRIMITIVES = [
    ("mean must have shape", of_primitives(lambda m, c, w: (m[..., :1], c, w))),
    ("cholesky must have shape", of_primitives(lambda m, c, w: (m, c[:-1], w))),
    ("weight must have", of_primitives(lambda m, c, w: (m, c, w[:, :-1]))),
    ("one dtype", of_primitives(lambda m, c, w: (m, c.double(), w))),
    ("zero on its diagonal", of_primitives(lambda m, c, w: (m, c * torch.tensor([0.0, 1, 1]), w))),
    ("floating point", of_primitives(lambda m, c, w: (m.int(), c.int(), w.int()))),
    ("float32 tensors on cpu", of_primitives(lambda m, c, w: (m.double(), c.double(), w.double()), backend="cpu")),
    ("backend must be 'auto' or 'reference' or 'cpu' or 'cuda', got 'opengl'", of_primitives(backend="opengl")),
    (r"cutoff must be a number above 0 and below 1 or None, got 1\.0", of_primitives(cutoff=1.0)),
    *(
        (f"{name} contains a value that is not finite", of_case(name, value, backend))
        for name in ("mean", "cholesky", "weight")
        for value in (NAN, INF)
        for backend in ("reference", "cpu")
    ),
]


def of_plane(normal=(0.0, 0.0, -1.0), offset=0.0, gain=-0.6, order=2, count=1):
    return lambda: GeometryModel.of_planes(spectra(), [Plane(normal, offset, gain)] * count, order)


MODELS = [
    ("unknown field model 'swiftwarf'; choose from", lambda: make_model("swiftwarf")),
    ("train must be an instance of Spectra, got <Rssi", lambda: fit(rssi())),
    ("train must be an instance of Spectra, got None", lambda: make_model("gp").fit(None)),
    ("new must be an instance of Spectra", lambda: fitted("gp").update(rssi())),
    ("train must be an instance of Rssi, got <Spectra", lambda: fit_rssi(spectra())),
    ("new must be an instance of Rssi", lambda: rssi_model().update(spectra())),
    ("positions must be numbers", lambda: fitted("gp").predict(spectra())),
    ("positions must be real", lambda: fitted("gp").predict(torch.zeros(1, 3) + 0j)),
    ("positions must be .* at most 1e.09", lambda: fitted("gp").predict([[2e9, 0, 0]])),
    ("None is not a readable safetensors file", lambda: load(None)),
    ("device must be .* got 'gpu'", lambda: make_model("gp").fit(spectra(), device="gpu")),
    ("device must be .* got 'meta'", lambda: make_model("gp").fit(spectra(), device="meta")),
    ("cuda:99 needs an NVIDIA GPU", lambda: make_model("gp").fit(spectra(), device="cuda:99")),
    ("cuda:99 needs an NVIDIA GPU", lambda: RssiModel().fit(rssi(), device="cuda:99")),
    ("folder of the pixel Gaussian process none/model does not", lambda: fitted("gp").save("none/model")),
    ("n_gaussians must be a whole number at least 4", lambda: make_model("wrfgs", n_gaussians=3)),
    ("level must be", lambda: fitted("gp").predict(spectra().position).interval("0.8")),
    ("level must be", lambda: fitted("gp").predict(spectra().position).interval(1.0)),
    ("lacks positions, or directions or receivers", Prediction(torch.zeros(2, 3), position=torch.zeros(2, 3)).to_frame),
    ("neither directions nor positions", lambda: Prediction(torch.zeros(3, 2)).plot()),
    ("locates nothing", lambda: predict(rssi_model(), rssi().transmitter_position, track=1.0)),
    ("needs measurements with sessions", lambda: make_model("gp", validation="session").fit(spectra())),
    ("seed must be a whole number at least 0, got np", lambda: make_model("gp", seed=np.int64(-1))),
    ("seed must be", lambda: make_model("gp", seed=np.float64(1.5))),
    ("n_primitives must be", lambda: SwiftWRF(n_primitives=0)),
    ("n_primitives must be", lambda: SwiftWRF(n_primitives=2.5)),
    ("n_primitives must be", lambda: SwiftWRF(n_primitives="many")),
    ("max_azimuths must be a whole number at least 0", lambda: SwiftWRF(max_azimuths=-1)),
    ("no option 'steps'", lambda: SwiftWRF(steps=5)),
    ("no option 'presets'", lambda: SwiftWRF(presets="paper")),
    ("takes a SwiftWRFConfig", lambda: SwiftWRF(config=SwiftWRFPaperConfig())),
    ("unit vector, got .* of length 2; divide", of_plane(normal=(0.0, 0.0, -2.0))),
    ("unit vector", of_plane(normal=(INF, 0.0, 0.0))),
    ("offset and gain of a plane must be finite", of_plane(offset=INF)),
    ("offset and gain of a plane must be finite", of_plane(gain=-INF)),
    ("order must be a whole number at least 0 and at most 4, got 5", of_plane(order=5)),
    ("order must be a whole number", of_plane(order=-1)),
    ("order must be a whole number", of_plane(order=1.0)),
    ("number of planes must be a whole number at most 64", of_plane(count=65)),
    ("another grid", lambda: fitted("coarray").update(ROOM)),
    ("correlation", lambda: fitted("coarray").aged(0.0)),
    ("fit it again", lambda: fitted("nearest").update(spectra())),
    ("fit it again", lambda: fitted("idw").update(spectra())),
    ("fewer than 10", lambda: planes().update(spectra().subset(torch.arange(3)))),
    ("one measurement, got 2", lambda: Follower(fitted("coarray")).step(spectra().subset(torch.arange(2)))),
    ("one measurement, got 0", lambda: Follower(fitted("coarray")).step(spectra().subset(torch.arange(0)))),
    ("positions of the 14 spectra", lambda: Follower(fitted("coarray"), spectra().subset(torch.arange(12)))),
    ("in their order", lambda: Follower(fitted("coarray"), spectra().subset(torch.arange(14).flip(0)))),
    ("batch must be a whole number at least 1", lambda: prequential(fitted("coarray"), spectra(), batch=0)),
]


def paper_updated():
    return RssiPaperModel(steps=2).fit(rssi().columns([0])).update(rssi().columns([0]))


PREDICTORS = [
    ("n_primitives must be a whole number at least 0", lambda: RssiModel(n_primitives=-1)),
    ("huber must be a number above 0", lambda: RssiModel(huber=0.0)),
    ("validation must be 'random' or 'block'", lambda: RssiModel(validation="blok")),
    ("max_locations must be", lambda: RssiModel(max_locations=3)),
    ("RssiModel has no option 'plain'", lambda: RssiModel(plain=True)),
    ("preset must be 'quick' or 'paper'", lambda: RssiModel(preset="Paper")),
    ("is not fitted", lambda: RssiModel().state()),
    ("positions must be finite", lambda: rssi_model().predict(torch.tensor([[0.0, 0.0, NAN]]))),
    (r"at most 1e\+09", lambda: rssi_model().predict(torch.tensor([[1e20, 0.0, 0.0]]))),
    (
        "receivers receiver01, .* have 0 training measurements in all; measure at least 4",
        lambda: fit_rssi(replace(rssi(), rssi_dbm=rssi().rssi_dbm * torch.nan)),
    ),
    ("same rows", lambda: fit_rssi(rssi(), pool=rssi_room(n=36, seed=1))),
    (
        "a predictor mean has no map; choose swiftwrf or pairs",
        lambda: RssiMap.predict(RSSI_PREDICTORS["mean"]().fit(rssi())),
    ),
    ("no receiver 'x'", lambda: rssi_model().plot("x")),
    ("region must be finite", lambda: RssiMap.predict(rssi_model(), region=[[NAN, 0.0]])),
    ("a region needs at least one position", lambda: RssiMap.predict(rssi_model(), region=torch.empty(0, 2))),
    ("fit it again", paper_updated),
    ("choose from swiftwrf", lambda: make_predictor("forest")),
    ("validation must be 'random' or 'block'", lambda: make_predictor("knn", validation="blok")),
    ("KNNPredictor has no option 'k'", lambda: RSSI_PREDICTORS["knn"](k=3)),
    ("unknown predictor 'forest'", lambda: compared(ROWS, also=["forest"])),
    ("fewer must be a list, of which each is a number at least 0 and at most 1", lambda: compare(ROWS, fewer=(-0.5,))),
    ("simulated-floor has no floors; give the table a column", lambda: estimate_floor_attenuation(ROWS)),
    (
        "simulated-floor has no phone in row 1; name the group of each row",
        lambda: estimate_offsets(replace(ROWS, groups=pd.Series(["a", None] * 10, name="phone"))),
    ),
]


def of_walk(time, speed):
    """Smooth the posteriors of three observations."""
    posterior = Posterior(torch.eye(3).double()[None], torch.zeros(3, 3).double(), 0.1)
    return lambda: smoothed(posterior, None if time is None else torch.tensor(time), speed)


LOCATORS = [
    ("speed is a number above 0", of_walk(None, 0.0)),
    ("speed is a number above 0", of_walk(None, NAN)),
    ("3 finite times", of_walk([0.0, 1.0], 1.0)),
    ("3 finite times", of_walk([0.0, 1.0, NAN], 1.0)),
    ("number 3 is earlier", of_walk([0.0, 2.0, 1.0], 1.0)),
    ("takes Rssi", lambda: predict(locator(), rssi().transmitter_position)),
    ("has no option 'cells'", lambda: MatchedField(cells=4)),
    ("has no option 'cells'", lambda: RssiLocator(cells=4)),
    ("no receiver detected the transmitter in row 0", lambda: locator().locate(torch.full((2, 3), NAN))),
    (r"rssi must have shape \(n, 3\), got \(2, 5\)", lambda: locator().locate(torch.zeros(2, 5))),
    ("finite", lambda: locator().locate(torch.full((1, 3), INF))),
    ("spectra must have shape", lambda: kinds.fitted("matched-field locator").locate(torch.zeros(1, 30, 120))),
    ("finite", lambda: kinds.fitted("matched-field locator").locate(torch.full((1, 8, 32), NAN))),
    ("array", lambda: MatchedField().fit(replace(ROOM, array=None))),
    *(("between 1 and 500", lambda count=count: suggest(ROOM, count)) for count in (0, -1, 501)),
    ("between 1 and 500", lambda: suggest_positions(locator(), rssi(), 0)),
    ("more cells", lambda: suggest_positions(locator(), rssi(), 500)),
    ("other receivers", lambda: suggest_positions(locator(), rssi().columns([0, 1]), 3)),
]


def turbo(data=ROOM, **options):
    return lambda: turbo_learning(data, **{"measured": 0.5, **options})


def of_half(n):
    """Mix measured spectra with n synthetic ones in place of those of the withheld positions."""
    return lambda: mix(*withhold(ROOM, 0.5, 0), ROOM.spectrum[:n])


def chosen(*candidates, data=ROOM, **options):
    return lambda: choose_model(data, candidates, **options)


AUGMENTATION = [
    (r"in \(0, 1\]", lambda: withhold(ROOM, 0.0, 0)),
    (r"in \(0, 1\]", lambda: withhold(ROOM, 1.1, 0)),
    ("leaves 5 of 24", lambda: withhold(ROOM, 0.2, 0)),
    (r"synthetic spectra must have shape \(12, .*, got \(3,", of_half(3)),
    ("more than 10 measured spectra, got 10", chosen("nearest", data=ROOM.subset(torch.arange(10)))),
    ("unknown field model 'foo'; choose from", chosen("gp", "foo")),
    ("none of the candidates nearest, gp has an option 'width'", chosen("nearest", "gp", width=3)),
    ("two candidates have the name 'idw'", chosen("idw", make_model("idw"))),
    (
        "spectrum of training spectrum 0 is not finite",
        chosen("nearest", "gp", data=replace(ROOM, store=Store(ROOM.spectrum * torch.nan))),
    ),
    (r"in \(0, 1\]", turbo(measured=0.0)),
    ("choose one of block, random", turbo(split="nowhere")),
    ("unknown field model", turbo(models=["oracle"])),
    ("unknown estimator", turbo(estimators=["oracle"])),
    ("leaves 2 of 19", turbo(measured=0.1)),
    ("two field models have the name 'idw'", turbo(models=[make_model("idw"), "idw"])),
    ("two estimators have the name 'Peak'", turbo(measured=1.0, estimators=[make_estimator("peak")] * 2)),
    ("7 x 7", turbo(simulated_room(n=20, grid=AngularGrid.hemisphere(4, 16)))),
]


NONE = torch.arange(0)
EMPTY = [
    (
        "holds no measurement to inspect",
        lambda: inspect(of_snapshots(torch.ones(5, 4).cfloat(), pose=FACING_X)().subset(NONE)),
    ),
    ("holds no measurement to inspect", lambda: inspect(ROOM.subset(NONE))),
    ("holds no measurement to inspect", lambda: inspect(ROWS.subset(NONE))),
    ("holds no measurement to inspect", lambda: inspect(replace(ROWS, rssi_dbm=ROWS.rssi_dbm * NAN))),
    ("all 1 elements of the array are at one place", lambda: POINT.spectrum(WAVE[..., :1], GRID)),
    ("all 4 elements of the array are at one place", lambda: PlanarArray(torch.ones(4, 2), 0.1).spectrum(WAVE, GRID)),
    ("no row to locate", lambda: kinds.fitted("matched-field locator").locate(torch.zeros(0, 8, 32))),
    ("no row to locate", lambda: predict(kinds.fitted("matched-field locator"), kinds._room().subset(NONE))),
    ("no receiver detected", lambda: predict(locator(), rssi().subset(NONE))),
    ("leaves 0 of 0", lambda: withhold(ROOM.subset(NONE), 0.5, 0)),
    ("need the region of known ones", lambda: synthetic_positions(ROOM.subset(NONE), 3, 0)),
    ("number must be .* below 24, got 24", lambda: fitted("gp").predict(ROOM.position).plot(24)),
    ("number must be .* below 3, got 'a'", lambda: rssi_model().predict(rssi().transmitter_position).plot("a")),
    ("row must be .* below 24, got 99", lambda: ROOM.plot(99)),
    ("row must be .* below 0, got 0", lambda: ROOM.subset(NONE).plot()),
    (
        "file must be a text or an instance of Path, got None",
        lambda: RssiComparison(rssi(), rssi(), {}, {}).report(None),
    ),
]


@pytest.mark.parametrize(
    ("words", "call"), [*DATA, *ARRAYS, *PRIMITIVES, *MODELS, *PREDICTORS, *LOCATORS, *AUGMENTATION, *EMPTY]
)
def test_a_call_without_an_answer_is_refused(words, call):
    with pytest.raises(InputError, match=words):
        call()
