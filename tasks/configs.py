"""Options of each command, and their checks. Importable without torch."""

from __future__ import annotations

import math
from dataclasses import KW_ONLY
from pathlib import Path, PurePath
from typing import Annotated, Literal

import tyro
from annotated_types import Ge, Gt, Le, Lt

from augment.choices import AUTO, MAX_STATIONS, MAX_SUGGESTIONS, fraction_key
from swiftwrf.choices import CARRIERS_HZ, FIELD_MODELS, RSSI_PREDICTORS, CalibrationPart, Moving, NotDetected
from swiftwrf.contrib.raytraced.names import RAYTRACE, ROOMS, SCENE_FILE, check_scene
from swiftwrf.errors import InputError
from swiftwrf.runtime.validation import Fraction, NonNegativeInt, PositiveFloat, PositiveInt, Preset
from tasks import labels
from tasks.options import SEEDS, FindingConfig, Options, ReadingConfig, Seed, choice, options
from tasks.records import CONFIG, PARTIAL, Row, read_json

MAP_FILES = (".tif", ".geojson", ".png")  # suffixes of files that hold a map only
FILES = (".csv", ".mat", *MAP_FILES)  # other names are directories
MAX_POWER_CHANGE_DB = 60.0  # of an access point
TABLE_SUFFIX = ".csv"  # suffix of a followed table; other followed files are JSON lines


@options
class StepsConfig(ReadingConfig):
    """Options of a command whose steps may be computed side by side."""

    _: KW_ONLY
    scheduler: str | None = None
    """address of a Dask scheduler whose workers compute the steps of the run (extra: cluster)"""
    processes: PositiveInt | None = None
    """processes of this machine that compute the steps, a gigabyte of memory each (default: one a thread, at most 4; one on
    a GPU)"""

    @property
    def own_processes(self) -> int | None:
        """Number of `processes`: one beside a scheduler, whose workers compute."""
        return 1 if self.scheduler else self.processes

    def check(self) -> None:
        super().check()
        if self.processes is not None and self.scheduler is not None:
            raise InputError("--processes and --scheduler exclude each other; leave out one")


@options
class AoaConfig(StepsConfig):
    """Estimate angles of arrival with few measured spectra, and report the errors.

    Turbo learning is compared with its references and baselines. Without --data the built-in simulated room is used.
    swiftwrf resume DIR.partial continues an interrupted run.

    Example: swiftwrf aoa --mix 0.3 --data DIR --split block
    """

    measured: tuple[float, ...] = ()
    """measured fractions in (0, 1]: 0.3 keeps 30 % of the training spectra and synthesizes the others. Required, except with
    --preset paper"""
    data: str | None = None
    """folder or file of spectra, ray paths or array snapshots, or name of a public data set, see docs/formats.md"""
    station: str | None = None
    """name of the array to take from data of several (default: each of them, one run after the other, and one report)"""
    split: str = "random"
    """a split that comes with the data, or a seeded one: random or block"""
    models: Annotated[
        tuple[str, ...],
        choice(
            f"field models of the synthetic spectra; {AUTO} chooses the one that predicts held-out measured spectra best",
            FIELD_MODELS,
            labels.FIELD_MODELS,
            AUTO,
            "--synthesizer",
        ),
    ] = (AUTO,)
    only: tuple[str, ...] = ()
    """estimators that are compared, e.g. kernel_regression, which saves time: other ones, other field models and the room
    that these need are left out (default: all)"""
    scene: str | None = None
    """room of swiftwrf scenes or Mitsuba scene (FILE.xml) for --models raytrace, in the coordinates of the data
    (default: the room that it estimates from the spectra)"""
    extra: NonNegativeInt | None = None
    """number of extra synthetic positions in the region of the measured ones (default: 3000 if cross-validation on the
    measured spectra shows a gain, else none; none with --preset paper)"""
    suggest: Annotated[int, Ge(0), Le(MAX_SUGGESTIONS)] = 0
    """number of positions to suggest for the next measurements, those that reduce the uncertainty over the region most"""
    moving: Moving | None = None
    """which end moves in the built-in room (default: transmitter)"""
    preset: Preset = "quick"
    """quick: sized for a CPU; paper: the paper's model, network and measured fractions, and a long training, for a GPU"""
    repeats: PositiveInt = 1
    """runs with different measured spectra and networks, pooled"""
    seed: Seed = 0
    """seed of everything random"""
    out: str | None = None
    """directory of the run; must not exist (default: a new one under runs/aoa)"""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """device to compute on"""

    def __post_init__(self) -> None:
        if self.preset == "paper":
            # the paper's training sets contain synthetic spectra at the withheld positions alone
            object.__setattr__(self, "measured", self.measured or (0.1, 0.3, 0.5, 0.7))
            object.__setattr__(self, "extra", self.extra or 0)

    def check(self) -> None:
        super().check()
        if not self.models:
            raise InputError("--models takes at least one name")
        if AUTO in self.models and len(self.models) > 1:
            raise InputError(f"--models takes {AUTO} or names, not both: {' '.join(self.models)}")
        for name in self.models:
            if name != AUTO:
                FIELD_MODELS.check(name)
        if self.scene is not None:
            if RAYTRACE not in self.models:
                raise InputError(f"--scene is for the model {RAYTRACE}; add it to --models, or leave --scene out")
            check_scene(self.scene, "--scene ")
        if self.station is not None and self.data is None:
            raise InputError("--station is for --data with several arrays; the built-in room has one")
        if self.moving is not None and self.data is not None:
            raise InputError("--moving is for the built-in room; with --data the data determine which end moves")
        given_mix = " ".join(map(fraction_key, self.measured))
        if not self.measured or not all(0 < fraction <= 1 for fraction in self.measured):
            raise InputError(f"--measured takes measured fractions in (0, 1], got {given_mix or 'none'}")
        if len(set(self.measured)) < len(self.measured):
            raise InputError(f"--measured names a fraction twice: {given_mix}")
        self.check_read()
        check_repeats(self.seed, self.repeats)


def check_repeats(seed: int, repeats: int) -> None:
    """Refuse a seed that leaves too few seeds for repeats.

    Raises:
        InputError: The seed of the last repeat is too large.
    """
    if seed + repeats > SEEDS:
        raise InputError(f"--seed {seed} leaves no seeds for {repeats} repeats; choose a smaller one")


@options
class FloorPlanConfig(StepsConfig):
    """Options of a command whose maps lie on an image of the floor."""

    _: KW_ONLY
    floor_plan: str | None = None
    """an image to draw behind the maps, PNG or JPEG"""
    floor_extent: tuple[float, float, float, float] | None = None
    """x0 x1 y0 y1 of that image [m] (default: as pixels of the image are the positions in the table)"""

    def check(self) -> None:
        super().check()
        if self.floor_plan is None and self.floor_extent is not None:
            raise InputError("--floor-extent needs --floor-plan FILE")
        if self.floor_extent is not None:
            x0, x1, y0, y1 = self.floor_extent
            if not (x0 < x1 and y0 < y1):
                raise InputError(
                    f"--floor-extent must be x0 x1 y0 y1 with x0 < x1 and y0 < y1, got {self.floor_extent}"
                )


@options
class RssiTaskConfig(FloorPlanConfig):
    """Predict RSSI maps of receivers, and report the errors.

    Without --data the built-in simulated floor is used. swiftwrf resume DIR.partial continues an interrupted run.

    Example: swiftwrf rssi walk.csv
    """

    receivers: tuple[str, ...] = ("all",)
    """receivers: names, numbers counted from 1, or all"""
    data: str | None = None
    """survey table (CSV, Parquet, JSON, GPX, KML), folder with tx_pos.csv, gateway_rssi.csv and gateway_position.yml (NeRF2
    layout), or name of a public data set, see docs/formats.md"""
    split: str = "random"
    """a split that comes with the data, or a seeded one: random, block, or place (a fifth of the receivers is held out)"""
    also: tuple[str, ...] = ()
    """predictors that are compared only when named: nerf2 takes minutes; pairs and knn_pairs are for data with both ends
    moving, where they are compared anyway"""
    only: tuple[str, ...] = ()
    """predictors that are compared with the model and the mean, e.g. knn, which saves time (default: all that suit the
    data)"""
    not_detected: NotDetected = "auto"
    """meaning of an empty cell: weak, the signal was below the limit of detection; unknown, it is ignored; auto decides for
    each receiver by the data"""
    validation: Literal["auto", "random", "block", "session"] = "auto"
    """folds of the training rows that choose all settings; auto takes those that are like the test rows"""
    above: tuple[float, ...] = ()
    """thresholds of the coverage [dBm], the first one that of the maps (default: -67 for Wi-Fi, else -75)"""
    below: tuple[float, ...] = ()
    """thresholds of another quantity than RSSI where smaller is better, e.g. latency, in its unit; in place of --above"""
    rooms: str | None = None
    """rooms as polygons: GeoJSON, or a table of their corners with columns room, x, y and floor (default: rooms.csv or
    rooms.geojson beside the data)"""
    preset: Preset = "quick"
    """of SwiftWRF and NeRF2: quick, or paper for the published head and field"""
    suggest: Annotated[int, Ge(0), Le(MAX_SUGGESTIONS)] = 0
    """number of positions to suggest for the next measurements, those that make the coverage more certain"""
    repeats: PositiveInt = 1
    """number of random splits, over which errors have a mean and a standard deviation"""
    seed: Seed = 0
    """seed of everything random"""
    out: str | None = None
    """directory of the run; must not exist (default: a new one under runs/rssi)"""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """where to compute; RSSI models are small, so auto is the CPU"""

    def check(self) -> None:
        super().check()
        for name in (*self.also, *self.only):
            RSSI_PREDICTORS.check(name)
        check_repeats(self.seed, self.repeats)
        if self.above and self.below:
            raise InputError("--above and --below exclude each other; give the one whose side is good")
        self.check_read()


@options
class LocateConfig(FloorPlanConfig):
    """Locate transmitters from RSSI, or from the spectra of several antenna arrays, and report the errors.

    Without --data the built-in simulated floor is used, with --stations 3 an office with arrays on three walls.
    swiftwrf resume DIR.partial continues an interrupted run. Positions of new rows: swiftwrf predict.

    Example: swiftwrf locate walk.csv
    """

    data: str | None = None
    """survey table (CSV, Parquet, JSON, GPX, KML), folder in NeRF2 layout, folder with a folder of spectra or snapshots for
    each array, or name of a public data set"""
    receivers: tuple[str, ...] = ("all",)
    """receivers: names, numbers counted from 1, or all"""
    split: str = "random"
    """a split that comes with the data, or a seeded one: random or block"""
    rooms: str | None = None
    """rooms as polygons: GeoJSON, or a table of their corners with columns room, x, y and floor (default: rooms.csv or
    rooms.geojson beside the data)"""
    stations: Annotated[int, Ge(0), Le(4)] = 0
    """number of antenna arrays in the built-in office, whose spectra locate the transmitter in place of RSSI"""
    cells: Annotated[int, Ge(10), Le(1_000_000)] = 4000
    """number of candidate positions of the posterior"""
    suggest: Annotated[int, Ge(0), Le(MAX_SUGGESTIONS)] = 0
    """number of positions to measure next that are suggested: where position errors are large and radio maps uncertain; of
    several antenna arrays, number of poses of a next array (at most 24)"""
    seed: Seed = 0
    """seed of everything random"""
    out: str | None = None
    """directory of the run (default: a new one under runs/locate); must not exist"""

    def check(self) -> None:
        super().check()
        self.check_read()
        if self.stations and self.data is not None:
            raise InputError("--stations is for the built-in office; with --data the data determine the stations")
        if self.stations and self.receivers != ("all",):
            raise InputError("--receivers is for RSSI; leave it out with --stations")
        if self.stations:
            self.check_stations()

    def check_stations(self) -> None:
        """Refuse options that do not apply to several arrays.

        Raises:
            InputError: Rooms, or more poses of a next array than are compared.
        """
        if self.rooms is not None:
            raise InputError("--rooms is for RSSI; positions by several arrays get rooms by swiftwrf predict --rooms")
        if self.suggest > MAX_STATIONS:
            raise InputError(f"--suggest takes at most {MAX_STATIONS} poses of a next array, got {self.suggest}")


@options
class PredictConfig(ReadingConfig):
    """Apply a saved model to new measurements or positions, and write a table.

    An estimator gives the directions of spectra, and a locator the positions of transmitters. A field model gives spectra,
    and an RSSI model powers, at the positions of a table.

    Example: swiftwrf predict runs/aoa/first DIR

    Example: swiftwrf predict runs/rssi/first/model.safetensors positions.csv --out predicted.csv
    """

    opens = False
    model: Annotated[str, tyro.conf.Positional]
    """file of a model, or directory of a run: then the estimator that cross-validation chose, the locator or the RSSI
    model"""
    source: Annotated[str, tyro.conf.Positional]
    """measurements of any format that swiftwrf aoa or rssi takes, RSSI without positions included; a .npy file (n,
    elevations, azimuths) of magnitudes in [0, 1]; or, for a field or RSSI model, a table of positions: x, y, z [m], or
    latitude, longitude, altitude"""
    track: float | None = None
    """rows of SOURCE are a walk: smooths its positions by this typical speed [m/s]. Rows without times are 1 s apart"""
    rooms: str | None = None
    """rooms as polygons: GeoJSON, or a table of their corners with columns room, x, y and floor (default: rooms.csv or
    rooms.geojson beside the data)"""
    ignore_receivers: bool = False
    """leave out receivers in SOURCE that the locator does not have (default: refuse them)"""
    out: str | None = None
    """table to write; of a field or RSSI model also .mat; must not exist (default: a new predicted-TIME.csv)"""


@options
class PlanConfig(Options):
    """Plan access points: the coverage that further ones add, and that changes of existing ones cost.

    The maps, the path loss and the floors are those of a run of swiftwrf rssi. To move an access point, switch it off and
    add one.

    Example: swiftwrf plan runs/rssi/first --aps 2

    Example: swiftwrf plan runs/rssi/first --aps 0 --off AP3 --power AP1=+3
    """

    run: Annotated[str, tyro.conf.Positional]
    """directory of a run of swiftwrf rssi"""
    aps: Annotated[int, Ge(0), Le(20)] = 1
    """number of further access points, chosen one after the other"""
    at: str | None = None
    """table of the places that are compared: x, y, z [m], or latitude, longitude, altitude (default: a grid inside of what
    was walked)"""
    above: float | None = None
    """threshold of the coverage [dBm] (default: that of the run)"""
    off: tuple[str, ...] = ()
    """access points that are switched off, by name or number counted from 1"""
    power: tuple[str, ...] = ()
    """changes of the transmit power [dB]: NAME=+3 NAME=-6 ..."""
    seed: Seed = 0
    """seed of the samples of the maps"""
    out: str | None = None
    """directory of the plan; must not exist (default: a new one under runs/plan)"""

    def check(self) -> None:
        super().check()
        _ = self.power_db
        if not (self.aps or self.off or self.power):
            raise InputError("--aps 0 changes nothing; give --off or --power, too")

    @property
    def power_db(self) -> dict[str, float]:
        """Changes of the transmit power by name [dB].

        Raises:
            InputError: A change that is not NAME=NUMBER, or a name twice.
        """
        found: dict[str, float] = {}
        for text in self.power:
            name, _, db = text.rpartition("=")
            try:
                value = float(db)
            except ValueError:
                value = math.nan
            if not name or name in found or not abs(value) <= MAX_POWER_CHANGE_DB:
                raise InputError(
                    f"--power takes NAME=DB once for each access point, within {MAX_POWER_CHANGE_DB:g} dB, e.g. AP1=+3, got "
                    f"{' '.join(self.power)}"
                )
            found[name] = value
        return found


@options
class ReportConfig(Options):
    """Merge finished runs of one task into one report.

    Example: swiftwrf report runs/rssi/first runs/rssi/second --out runs/report
    """

    runs: Annotated[tuple[str, ...], tyro.conf.Positional]
    """directories of the runs"""
    pdf: bool = False
    """write the figures as PDF, too, for a paper"""
    out: str | None = None
    """directory of the report; must not exist (default: a new one under runs/report)"""


@options
class InspectConfig(FindingConfig):
    """Inspect measurements: counts, extents, frames, calibration, suspicious columns.

    Example: swiftwrf inspect DIR
    """

    source: Annotated[str, tyro.conf.Positional]
    """folder or file of measurements, or name of a public data set"""
    out: str | None = None
    """directory of the page; must not exist (default: a new one under runs/inspect)"""


@options
class ConvertConfig(FindingConfig):
    """Convert measurements and RSSI maps to the toolkit's layout or to files.

    SOURCE is measurements of any known format (see docs/formats.md), the directory of a run of rssi or locate,
    or a saved RSSI model. OUT is a directory in that layout, or a file.

    Example: swiftwrf convert DIR converted --calibrate

    Example: swiftwrf convert runs/rssi/first map.tif
    """

    opens = False
    source: Annotated[str, tyro.conf.Positional]
    """folder or file of measurements, name of a public data set, directory of a run, or saved RSSI
    model"""
    out: Annotated[str, tyro.conf.Positional]
    """directory to write, or file: .csv, .mat, and of RSSI maps .tif (GeoTIFF), .geojson, .png (with a world file); must
    not exist"""
    calibrate: tuple[CalibrationPart, ...] | None = None
    """estimate these from the training positions of array snapshots, and correct them: phases of the elements, orientation
    and position of the array (without a word: phases orientation)"""
    split: str | None = None
    """with --calibrate: split whose training part is used (default: random); it is written beside the spectra"""
    seed: Seed = 0
    """seed of that split"""
    deepmimo: bool = False
    """write ray paths (paths.npz) as a folder of DeepMIMO v4"""
    receivers: tuple[str, ...] = ()
    """receivers of the map, names or numbers counted from 1 (default: all); a .png shows the strongest of them"""
    cell: PositiveFloat | None = None
    """edge of the map's cells [m] (default: 1/120 of the longer side)"""
    height: float | None = None
    """height of the transmitter on the map [m] (default: the median of the training positions)"""

    @property
    def suffix(self) -> str:
        """Suffix of the file to write, empty for a directory."""
        suffix = PurePath(self.out).suffix.lower()
        return suffix if suffix in FILES else ""

    def check(self) -> None:
        super().check()
        if (self.split is not None or self.seed) and self.calibrate is None:
            raise InputError("--split and --seed are of the calibration; give --calibrate, too")
        if self.deepmimo and self.suffix:
            raise InputError(f"--deepmimo writes a folder; give a directory instead of {self.out}")
        if self.calibrate is not None and (self.suffix or self.deepmimo):
            raise InputError("--calibrate writes a directory in the toolkit's own layout; give another OUT")


@options
class UpdateConfig(ReadingConfig):
    """Update a fitted model with new measurements, and detect changes.

    Each measurement is predicted before the model learns it, and tested for a change.

    With --follow the measurements come one by one, a JSON object a line: {"position": [x, y, z], "rssi_dbm": {"NAME": -60}}
    or {"position": [x, y, z], "spectrum": [[...], ...]}; or rows of RSSI in a CSV table, which has a column a receiver. The
    model in --out is replaced after each line.

    Example: swiftwrf update model.safetensors DIR --out updated
    """

    model: Annotated[str, tyro.conf.Positional]
    """file of a fitted model of spectra or RSSI, or directory of a run of rssi"""
    source: Annotated[str, tyro.conf.Positional]
    """measurements of any known format in the order in which they were taken; with --follow a .ndjson or .csv file
    that grows, or - for standard input"""
    out: str
    """directory to write; must not exist. With --follow, one that exists is continued"""
    data: str | None = None
    """training measurements of the model in their order, which calibrate the test for changes of spectra, and show what
    stands in a room"""
    false_alarm_rate: Annotated[float, Gt(0), Lt(1)] = 1e-4
    """false alarms a measurement"""
    follow: bool = False
    """take measurements line by line as they come, and print a line for each"""

    @property
    def endless(self) -> bool:
        return self.follow

    def check(self) -> None:
        super().check()
        if self.follow and self.source != "-" and not self.source.lower().endswith((".ndjson", ".jsonl", TABLE_SUFFIX)):
            raise InputError(f"--follow takes .ndjson or .jsonl or {TABLE_SUFFIX} files or -, got {self.source}")


@options
class ResumeConfig(Options):
    """Continue an interrupted run of aoa, rssi or locate with its options.

    Example: swiftwrf resume runs/aoa/first.partial
    """

    run: Annotated[str, tyro.conf.Positional]
    """directory of the run, DIR.partial"""
    scheduler: str | None = None
    """address of a Dask scheduler whose workers compute the steps (extra: cluster)"""
    processes: PositiveInt | None = None
    """processes of this machine that compute the steps (default: one a thread, at most 4; one on a GPU)"""

    def check(self) -> None:
        super().check()
        self.saved()

    def saved(self) -> Row:
        """Return the content of the run's configuration file: task, command and config.

        Raises:
            InputError: There is no interrupted run, or it stopped before it wrote its configuration.
        """
        folder = Path(self.run)
        if not folder.name.endswith(PARTIAL) or not folder.is_dir():
            raise InputError(f"{folder} is no interrupted run; expected a directory *{PARTIAL} with a {CONFIG}")
        if not (folder / CONFIG).exists():
            raise InputError(
                f"{folder} was stopped before its {CONFIG} was written, so it holds nothing to go on with; start the run "
                "again"
            )
        content = read_json(folder / CONFIG)
        if content.get("task") not in ("aoa", "rssi", "locate") or not isinstance(content.get("config"), dict):
            raise InputError(f"{folder} is a run of the unknown task {content.get('task')!a}; restore its {CONFIG}")
        return content


@options
class ScenesConfig(Options):
    """Trace ray paths in a room or a scene file by Sionna RT (extra: raytrace).

    The directory holds paths.npz, which --data of the tasks reads, and scene.svg, a plan of the room and the positions. With
    several fixed ends each has a folder of its own, which locate --data reads as the arrays.

    Example: swiftwrf scenes --room office --moving receiver --positions 1000 --out office
    """

    room: Annotated[
        str,
        tyro.conf.arg(
            help="a Mitsuba scene with radio materials (FILE.xml), or a built-in room: "
            + "; ".join(f"{name}: {summary}" for name, summary in ROOMS.items())
        ),
    ]
    moving: Moving
    """which end moves; the array lies level at the receiver"""
    positions: Annotated[int, Ge(2), Le(100_000)]
    """number of random positions in the region, none of them in furniture"""
    out: str
    """directory to write; must not exist"""
    frequency: Annotated[float, Ge(CARRIERS_HZ[0]), Le(CARRIERS_HZ[1])] = 2.4e9
    """carrier [Hz]; ITU-R P.2040 knows most materials from 1 GHz on"""
    order: Annotated[int, Ge(0), Le(8)] = 3
    """largest number of reflections (and other interactions) of a path"""
    scattering: Fraction = 0.0
    """fraction of the reflected amplitude that surfaces scatter, 0 to 1"""
    diffraction: bool = False
    """whether to trace paths diffracted at one edge"""
    fixed: tuple[float, ...] = ()
    """position of the fixed end, or of several, with a folder each: x y z x y z ... [m] (default: that of the room)"""
    region: tuple[float, float, float, float, float, float] | None = None
    """region of the moving end: opposite corners x y z x y z [m] (default: that of the room)"""
    seed: Seed = 0
    """seed of positions, rays and scattered phases"""

    def check(self) -> None:
        super().check()
        if self.order == 0 and (self.scattering or self.diffraction):
            raise InputError(
                "--order 0 leaves the direct path alone; scattering and diffraction need at least --order 1"
            )
        check_scene(self.room)
        if len(self.fixed) % 3:
            raise InputError(f"--fixed takes x y z of each fixed end, got {len(self.fixed)} numbers")
        if not self.room.endswith(SCENE_FILE):
            return
        if not self.fixed or self.region is None:
            raise InputError(
                f"{self.room} does not contain the positions of the ends; give --fixed X Y Z and --region X Y Z X Y Z"
            )


@options
class ViewConfig(Options):
    """Explore a fitted model in the browser (extra: view).

    Drag the moving end and see its spectrum, or hover over a map of RSSI. Ctrl-C ends the page.

    Example: swiftwrf view runs/aoa/first
    """

    source: Annotated[str, tyro.conf.Positional]
    """directory of a run of aoa, rssi, locate or update, or a saved model; an update that is being
    followed is shown as it grows"""
    port: Annotated[int, Ge(0), Le(65535)] = 8080
    """port of the page; 0 takes any free port"""
    host: str = "127.0.0.1"
    """address to listen on; with an address of the network, others can see the page and change the floor plan, without a
    password"""

    @property
    def endless(self) -> bool:
        return True
