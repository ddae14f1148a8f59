"""Received power at fixed receivers, measured at known positions of the transmitter."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from swiftwrf.data.coordinates import Floors, GeodeticOrigin
from swiftwrf.data.dataset import Arrays, Numbers, PositionedData, position_coordinates, to_positions
from swiftwrf.data.options import TableOptions
from swiftwrf.data.powers import check_powers
from swiftwrf.data.splits import MIN_PLACES, MIN_SPLIT_ROWS, MIN_TRAINING, Validation, matching_validation, random_split
from swiftwrf.data.survey import read_survey
from swiftwrf.errors import InputError, listed
from swiftwrf.plotting import MARK, Axes, plan
from swiftwrf.positions import to_tensor
from swiftwrf.runtime.validation import NonNegativeInt, checked

RSSI = "RSSI"
META = "meta.csv"  # file of the NeRF2 layout with a row for each measurement
SURVEY = "survey.yml"  # file of the toolkit's own layout with properties of all measurements
PLACE = "place"  # split by receiver, a fifth of which is held out

NO_NAME = re.compile("[\x00-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff]")  # line breaks, controls, halves of characters


@dataclass(frozen=True, eq=False, init=False, repr=False)
class Rssi(PositionedData):
    """RSSI of a moving transmitter at R fixed receivers.

    Args:
        rssi_dbm: RSSI, (n, R) [dBm], nan where a receiver did not detect the transmitter.
        transmitter_position: Positions of the transmitter, (n, 3) [m].
        receiver_position: Positions of the receivers, (R, 3) [m], nan where unknown. Defaults to nan for all.
        receiver_names: Names of the receivers. Defaults to receiver1, receiver2, ...
        bands: Band of each receiver, by which coverage is given, e.g. 5 GHz; None where it is unknown.
        origin: Latitude and longitude of x = y = 0, if the positions were projected from degrees.
        groups: Name of each row's group, e.g. a device, between which RSSI has constant offsets; named as their column.
        offsets: Offsets that were removed from the RSSI.
        labels: Names of columns of the table that distinguish groups of rows.
        floors: Floors of the building, by height.
        receiver_moves: Whether the receivers are positions of one receiver that moves, too.
        plan_scale: Pixels in a metre if positions were pixels of a floor plan, whose upper left corner is x = y = 0.
        session: Session of measurements that each row is of, e.g. a walk or a day: n names, or their numbers, int64 (n,).
        margin_db: How far an empty cell may be above the weakest value of its row [dB], if rows list the strongest or the
            associated receivers only; infinite for single packets; see `swiftwrf.data.scans.list_margin`.
        quantity: What `rssi_dbm` contains: RSSI, or another quantity, e.g. throughput, whose maps have neither path loss
            nor a limit of detection.
        unit: Its unit: dBm of RSSI.
        time: Time of each measurement [s], (n,), nan where unknown.
        name: Name of the data set.
        details: index, named_splits, source and notes of `PositionedData`.

    Raises:
        InputError: A length that does not match, a name that is no text, or a value that is no RSSI or position.

    Example:
        >>> data = Rssi([[-60.0, float("nan")]] * 20, torch.rand(20, 3), receiver_names=["hall", "office"])
        >>> data
        <Rssi 'rssi': 20 rows at 2 receivers, 50% detected,
         positions over ... m>
    """

    rssi_dbm: Tensor
    transmitter_position: Tensor
    receiver_position: Tensor
    receiver_names: tuple[str, ...]
    bands: tuple[str, ...] | None
    origin: GeodeticOrigin | None
    groups: pd.Series | None
    offsets: Offsets | None
    labels: tuple[str, ...]
    floors: Floors | None
    receiver_moves: bool
    plan_scale: float | None
    margin_db: float | None
    quantity: str
    unit: str
    session: Tensor | None
    time: Tensor | None

    row_fields: ClassVar[tuple[str, ...]] = ("transmitter_position", "rssi_dbm", "index", "groups", "session", "time")

    @checked
    def __init__(
        self,
        rssi_dbm: Numbers,
        transmitter_position: Numbers,
        *,
        receiver_position: Numbers | None = None,
        receiver_names: Sequence[str] | None = None,
        bands: Sequence[str] | None = None,
        origin: GeodeticOrigin | None = None,
        groups: pd.Series | None = None,
        offsets: Offsets | None = None,
        labels: tuple[str, ...] = (),
        floors: Floors | None = None,
        receiver_moves: bool = False,
        plan_scale: float | None = None,
        margin_db: float | None = None,
        quantity: str = RSSI,
        unit: str = "dBm",
        session: Tensor | Sequence[str | int] | None = None,
        time: Numbers | None = None,
        name: str = "rssi",
        **details: Any,
    ) -> None:
        position = to_positions("transmitter_position", transmitter_position)
        rssi = to_tensor("rssi_dbm", rssi_dbm, torch.float64, (None, None), missing=True)
        count = rssi.shape[1]
        default = (f"receiver{number}" for number in range(1, count + 1))
        names = tuple(default if receiver_names is None else receiver_names)
        if wrong := [x for x in names if not x.strip() or NO_NAME.search(x)]:
            raise InputError(
                f"{name}: receiver_names must be a list of texts, none empty or with tabs or line breaks, got {wrong[0]!r}"
            )
        if len(names) != count or len(set(names)) < count:
            raise InputError(
                f"{name} has {count} receivers, but the names {listed(names)}; give each receiver one of its own"
            )
        if bands is not None and len(bands) != count:
            raise InputError(f"{name} has {count} receivers, but {len(bands)} bands; give one of each receiver")
        if session is not None and not isinstance(session, Tensor):
            session = torch.from_numpy(pd.factorize(np.asarray(session, dtype=object))[0])
        places = torch.full((count, 3), torch.nan) if receiver_position is None else receiver_position
        super().__init__(
            name,
            **details,
            rssi_dbm=rssi,
            transmitter_position=position,
            receiver_position=to_positions("receiver_position", places, (count, 3), missing=True),
            receiver_names=names,
            bands=None if bands is None else tuple(bands),
            origin=origin,
            groups=None if groups is None else groups.astype("category"),
            offsets=offsets,
            labels=labels,
            floors=floors,
            receiver_moves=receiver_moves,
            plan_scale=plan_scale,
            margin_db=margin_db,
            quantity=quantity,
            unit=unit,
            session=None if session is None else session.long(),
            time=None if time is None else to_tensor("time", time, torch.float64, (None,), missing=True),
        )
        if self.is_power:
            check_powers(name, rssi.numpy(), names, self.index.numpy()[:, None])
        elif self.located or not unit or bool(rssi.isinf().any()):
            raise InputError(f"{name} has {quantity}, which needs a unit, finite values, and no positions of receivers")

    @classmethod
    @checked
    def from_frame(
        cls,
        frame: pd.DataFrame,
        *,
        receiver_position: Mapping[str, Sequence[float]] | None = None,
        name: str = "rssi",
        **options: Any,
    ) -> Rssi:
        """Return the RSSI of a table: one column a receiver (wide) or one row a packet (long).

        Args:
            frame: Columns of positions [m] and RSSI [dBm], recognised by their names as in docs/formats.md.
            receiver_position: Positions [m] by name of the receiver; those of others are unknown.
            name: Name of the data set.
            options: `columns`, `filler` and the others that `load_rssi` takes.

        Raises:
            InputError: A column that is missing or ambiguous, or a value that is no position or received power.

        Example:
            >>> Rssi.from_frame(pd.DataFrame({"x": [0, 1], "y": [0, 1], "z": [1, 1], "hall": [-50, -60]})).receiver_names
            ('hall',)
        """
        arguments = read_survey("the table", frame, TableOptions(**options))
        if receiver_position:
            places = [
                list(receiver_position.get(receiver, [float("nan")] * 3)) for receiver in arguments["receiver_names"]
            ]
            arguments["receiver_position"] = places
        return cls(**arguments, name=name)

    @property
    def is_power(self) -> bool:
        """True for RSSI, False for another quantity."""
        return self.quantity == RSSI

    def check_power(self, model: str) -> None:
        """Raise InputError for another quantity than RSSI, which a model of received power cannot take."""
        if not self.is_power:
            raise InputError(f"{self.name} has {self.quantity}, but {model} needs RSSI; read RSSI, without quantity")

    @property
    def located(self) -> bool:
        """True if the position of a receiver is known."""
        return bool(self.receiver_located.any())

    @property
    def receiver_located(self) -> Tensor:
        """Mask of the receivers whose position is known, bool (R,)."""
        return self.receiver_position.isfinite().all(dim=1)

    @property
    def detected(self) -> Tensor:
        """True where a receiver detected the transmitter, bool (n, R)."""
        return ~self.rssi_dbm.isnan()

    def as_measured(self) -> Rssi:
        """Return the data with the offsets that were removed from them."""
        if self.offsets is None:
            return self
        return self.derived(rssi_dbm=self.rssi_dbm + self.offsets.of(self)[:, None], offsets=None)

    def about(self, origin: GeodeticOrigin | None) -> Rssi:
        """Return the data in local metres about another origin. With None, or if the data have none, nothing changes."""
        if origin is None or self.origin is None or origin == self.origin:
            return self
        origin_of_data = self.origin

        def moved(position: Tensor) -> Tensor:
            xy = origin.to_metres(origin_of_data.to_degrees(position[:, :2].numpy()))
            return torch.cat([torch.from_numpy(xy), position[:, 2:]], dim=1)

        places = self.receiver_position.clone()
        places[self.receiver_located] = moved(places[self.receiver_located])
        position = moved(self.transmitter_position)
        return replace(self, transmitter_position=position, receiver_position=places, origin=origin)

    @checked
    def split(self, name: str = "random", seed: NonNegativeInt = 0) -> tuple[Rssi, Rssi]:
        """Return the training and the test part.

        Args:
            name: A split that came with the data, or else "random", "block", or "place", which holds out all measurements of
                a fifth of the receivers.
            seed: Seed of the random, block and place splits.

        Raises:
            InputError: An unknown name, fewer than 10 training rows, or fewer than 5 receivers of known position.
        """
        if name != PLACE or name in self.named_splits:
            return super().split(name, seed)
        located = self.receiver_located.nonzero()[:, 0]
        if len(located) < 5:  # a fifth of which is held out
            raise InputError(
                f"split {PLACE!r} needs at least 5 receivers of known position; {self.name} has {len(located)}"
            )
        places = self.receiver_position[located]
        is_test = torch.zeros(len(self.receiver_names), dtype=torch.bool)
        is_test[located[random_split(places, seed)[1]]] = True
        parts = []
        for kept in (~is_test, is_test):
            rssi = self.rssi_dbm.where(kept, torch.nan)
            parts.append(replace(self, rssi_dbm=rssi).subset((~rssi.isnan()).any(dim=1)))
        if len(parts[0]) < MIN_TRAINING:
            raise InputError(
                f"split {PLACE!r} of {self.name} has {len(parts[0])} training rows, too few to fit anything"
            )
        return parts[0], parts[1]

    def validation_for(self, split: str, test: Rssi) -> Validation:
        """Return the kind of folds of this training part that resembles the test part of a split.

        Folds are single rows for random splits, and regions for splits by block or place. For a split that comes with the
        data, distances of its test rows to the training positions decide, and measurements of test rows have no part. Folds
        are whole sessions if the test rows are of other sessions than the training rows.

        Example:
            >>> import swiftwrf
            >>> train, test = swiftwrf.rssi_room(n=60).split("block")
            >>> train.validation_for("block", test)
            'block'
        """
        sessions, others = ({*data.session.tolist()} if data.session is not None else {0} for data in (self, test))
        if len(sessions) > 1 and sessions.isdisjoint(others):
            return "session"
        if split in ("block", PLACE):
            return "block"
        return (
            "random" if split == "random" else matching_validation(self.transmitter_position, test.transmitter_position)
        )

    @checked
    def receivers(self, asked: Sequence[str]) -> Rssi:
        """Return the data of some receivers.

        Fewer than 10 rows are too few of a receiver, and fewer than 5 in a survey of fewer than 13 rows.

        Args:
            asked: Names, numbers counted from 1 in file order, or "all", which omits receivers that detected the transmitter
                in too few rows and adds a note. Positions of one receiver that moves are all kept.

        Raises:
            InputError: An unknown receiver, one asked for twice, or one that detected the transmitter in too few rows.
        """
        least = MIN_PLACES if len(self) < MIN_SPLIT_ROWS else MIN_TRAINING
        if list(asked) == ["all"] and self.receiver_moves:
            return self
        if list(asked) == ["all"]:
            enough = self.detected.sum(dim=0) >= least
            if not bool(enough.any()):
                raise InputError(f"no receiver of {self.name} detected the transmitter in {least} rows")
            kept = self.columns(enough.nonzero()[:, 0].tolist())
            rare = [name for name in self.receiver_names if name not in kept.receiver_names]
            note = f"receivers that detected fewer than {least} rows are left out: {listed(rare)}"
            return replace(kept, notes=(*kept.notes, note)) if rare else kept
        columns = [receiver_row(self.receiver_names, name, self.name) for name in asked]
        if not columns:
            raise InputError("no receiver is asked for; give names, numbers from 1, or all")
        if len(set(columns)) < len(columns):
            raise InputError(f"ask for each receiver once, got {' '.join(asked)}")
        for column in columns:
            count = int(self.detected[:, column].sum())
            if count < least:
                raise InputError(
                    f"receiver {self.receiver_names[column]!r} of {self.name} detected the transmitter in {count} rows; "
                    f"at least {least} are needed"
                )
        return self.columns(columns)

    def columns(self, columns: list[int]) -> Rssi:
        """Return the data of the receivers of these columns, in this order."""
        return replace(
            self,
            receiver_names=tuple(self.receiver_names[c] for c in columns),
            bands=None if self.bands is None else tuple(self.bands[c] for c in columns),
            receiver_position=self.receiver_position[columns],
            rssi_dbm=self.rssi_dbm[:, columns],
        )

    @property
    def receivers_by_band(self) -> dict[str, list[int]]:
        """Numbers of the receivers of each band, counted from 0; empty without bands."""
        bands = self.bands or ()
        return {name: [i for i, band in enumerate(bands) if band == name] for name in sorted({*bands} - {""})}

    def plot(self, receiver: str | None = None, ax: Axes | None = None) -> Axes:
        """Draw the RSSI where it was detected, seen from above, and the known positions of the receivers.

        Args:
            receiver: Name or number of a receiver as in `receivers`. Defaults to the strongest RSSI at each position.
            ax: Axes to draw into. Defaults to those of a new figure.

        Raises:
            InputError: An unknown receiver.

        Example:
            >>> import swiftwrf
            >>> swiftwrf.rssi_room(n=40).plot("2").get_title()
            'simulated-floor, receiver02'
        """
        shown = self if receiver is None else self.columns([receiver_row(self.receiver_names, receiver, self.name)])
        strongest = shown.rssi_dbm.nan_to_num(-torch.inf).amax(dim=1)
        detected = strongest.isfinite()
        ax = plan(self.transmitter_position[detected], strongest[detected], f"{self.quantity} [{self.unit}]", ax)
        x, y, _ = shown.receiver_position[shown.receiver_located].T.numpy()
        ax.plot(x, y, "^", color=MARK)
        ax.set_title(f"{self.name}, {'strongest receiver' if receiver is None else shown.receiver_names[0]}")
        return ax

    def _columns(self) -> dict[str, Any]:
        return dict(zip(self.receiver_names, self.rssi_dbm.numpy().T, strict=True))

    def coordinates(self) -> Arrays:
        position = position_coordinates(self.transmitter_position.numpy(), self.origin)
        return super().coordinates() | position | {"receiver": (("receiver",), np.array(self.receiver_names))}

    def variables(self) -> Arrays:
        return {
            "rssi": (("position", "receiver"), self.rssi_dbm.numpy(), {"units": "dBm"}),
            "receiver_position": (("receiver", "axis"), self.receiver_position.numpy(), {"units": "m"}),
        }

    def _summary(self) -> str:
        fraction = float(self.detected.double().mean()) if len(self) else 0.0
        return f"{len(self)} rows at {len(self.receiver_names)} receivers, {fraction:.0%} detected"


@dataclass(frozen=True)
class Offsets:
    """Offsets of RSSI between groups of rows.

    Args:
        column: Name of the column with the groups' names.
        reference: Group whose offset is 0.
        offset_db: Offset of each group [dB].
        explained: Fraction of the variance about the field that the offsets explain.
    """

    column: str
    reference: str
    offset_db: Mapping[str, float]
    explained: float

    def of(self, data: Rssi) -> Tensor:
        """Return the offset of each row, float64 (n,) [dB]; 0 for a group without an estimate, or without groups."""
        labels = [self.reference] * len(data) if data.groups is None else data.groups.tolist()
        return torch.tensor([self.offset_db.get(label, 0.0) for label in labels], dtype=torch.float64)

    def removed(self, data: Rssi) -> Rssi:
        """Return the data as the reference group would have measured them."""
        return data.derived(rssi_dbm=data.as_measured().rssi_dbm - self.of(data)[:, None], offsets=self)

    def note(self) -> str:
        """Return a sentence with all offsets."""
        each = listed(f"{name} {db:+.1f} dB" for name, db in self.offset_db.items() if name != self.reference)
        return f"offsets of {self.column} relative to {self.reference}, which maps are of: {each}"


@checked
def receiver_row(names: Sequence[str], asked: str, owner: str) -> int:
    """Return the index of a receiver that is asked for by its name or its number from 1; the owner is for the message.

    Raises:
        InputError: An unknown receiver.

    Example:
        >>> receiver_row(["hall", "office"], "office", "floor"), receiver_row(["hall", "office"], "1", "floor")
        (1, 0)
    """
    if asked in names:
        return list(names).index(asked)
    if asked.isdecimal() and 1 <= int(asked) <= len(names):
        return int(asked) - 1
    known = ", ".join(f"{number} {name}" for number, name in enumerate(names, start=1))
    raise InputError(f"{owner} has no receiver {asked!r}; there are {known}")
