"""A room of mirror planes, and the spectra that follow from it at any position."""

from __future__ import annotations

import math
from copy import copy
from dataclasses import replace
from typing import Any, Self

import pandas as pd
import torch
from torch import Tensor

from swiftwrf.array.angles import AngularGrid
from swiftwrf.array.beamforming import unit_power
from swiftwrf.array.planar import LIGHT_SPEED
from swiftwrf.data.dataset import Numbers
from swiftwrf.data.spectra import Spectra, fingerprint
from swiftwrf.data.splits import folds
from swiftwrf.errors import InputError
from swiftwrf.models.base import ARRAY, FIXED_END, FieldModel, bounding_box
from swiftwrf.models.geometry.channels import Channels, superposed, waves
from swiftwrf.models.geometry.fit import GeometryConfig, decided_room, refine_room, search_room, update_room
from swiftwrf.models.geometry.furniture import Furniture, find_furniture, fit_furniture, orders
from swiftwrf.models.geometry.images import LinkAt, PhaseObservations, PlaneSet, Sequence, images, mirror
from swiftwrf.models.geometry.planes import Plane, RoomEstimate, plane_set, refine
from swiftwrf.models.link import Link, Linked
from swiftwrf.positions import check_positions
from swiftwrf.runtime.threads import single_thread
from swiftwrf.runtime.validation import checked

MAX_SNAPSHOTS = 8  # of a measurement, which furniture and locating use; more take time in proportion


def kept_snapshots(number: int) -> Tensor:
    """Return the numbers of at most 8 snapshots, evenly chosen, that furniture is fitted to and positions are located by."""
    return torch.linspace(0, number - 1, min(MAX_SNAPSHOTS, number)).long()


class GeometryModel(Linked, FieldModel):
    """Image sources of the fixed end in mirror planes that are estimated from the spectra.

    Example:
        >>> import swiftwrf
        >>> train, test = swiftwrf.simulated_room(n=50).split()
        >>> room = GeometryModel(beam_width=1, max_extra_planes=0).fit(train)
        >>> room.predict(test.position).mean.shape
        torch.Size([10, 30, 120])
    """

    name = "geometry"
    kind = "geometry model"
    config_type = GeometryConfig
    requires = (ARRAY, FIXED_END)
    searches = True
    updates = True
    any_grid = True
    batch = 256

    saved = "estimate fingerprint furniture"
    estimate: RoomEstimate
    """planes with their uncertainty"""
    fingerprint: str
    """digest of the training spectra"""
    furniture: Furniture | None = None
    """what stands in the room; None if the training spectra have no channels, or if these do not need it"""

    @classmethod
    def accepts_like(cls, model: FieldModel) -> bool:
        return model.room is not None

    @classmethod
    @checked
    def of_planes(cls, link: Spectra, planes: list[Plane], order: int = 2) -> Self:
        """Return the model of a room whose planes are known.

        Args:
            link: Any spectra of the scene, for array, rotation, fixed end and grid.
            planes: Planes of the room.
            order: Highest number of reflections of an image source, at most 4.

        Raises:
            InputError: As `RoomEstimate`, or spectra that do not describe array, rotation and fixed end.

        Example:
            >>> import swiftwrf
            >>> floor = Plane((0.0, 0.0, -1.0), offset_m=0.0, gain=-0.6)
            >>> GeometryModel.of_planes(swiftwrf.simulated_room(n=10), [floor]).image_sources()[2]
            tensor([0, 1])
        """
        certain = torch.diag(torch.tensor([(plane.std_mm / 1000) ** 2 for plane in planes], dtype=torch.float64))
        model, estimate = cls(), RoomEstimate(planes, order, 0.0, 0.0, "given planes", certain)
        model._check_described(link)
        model.grid, model.bounds, model.link = link.grid, bounding_box(link.position), Link.from_spectra(link)
        model.estimate, model.fingerprint = estimate, ""
        return model

    def _fit(self, train: Spectra, *, like: FieldModel | None = None, progress: bool = False, **_: Any) -> None:
        owner, known = fingerprint(train), like.room if like else None
        self.fingerprint = owner
        if known is None:
            self.estimate = search_room(train, self.config, progress)
            self.furnish(train)
            return
        self.estimate, self.furniture = known.estimate, known.furniture
        if known.fingerprint != owner:
            self.estimate = refine_room(known.estimate, train, self.config)
            if train.channel is not None:  # what stands in the room is fitted again, and not searched either
                self.furniture = self.furnished_on(train).furniture

    def furnish(self, train: Spectra) -> None:
        """Estimate what stands in the room, if there are channels."""
        self.furniture = None
        if train.channel is not None and self.planes:
            measured, fold = self.channels(train), folds(train.position, self.config.validation, self.config.seed)
            free = self.gains(measured.scene)
            self.furniture = find_furniture(self.tensors(), free, measured, self.region(), fold)

    def decided_on(self, train: Spectra) -> Self:
        """Return the room with those of its planes that other spectra show, and what these show to stand in it.

        The search took all spectra to find the planes; what held-out spectra are predicted with is decided without them.

        Args:
            train: Spectra of the same link, usually a part of those that the room was found in.

        Raises:
            InputError: As `search_room`, or spectra of another link.

        Example:
            >>> import swiftwrf
            >>> room = swiftwrf.simulated_room(n=50)
            >>> model = GeometryModel.of_planes(room, [Plane((0.0, 0.0, -1.0), offset_m=0.0, gain=-0.6)])
            >>> len(model.decided_on(room[:30]).planes)
            1
        """
        train, model = self.link.aligned(train), copy(self)
        model.estimate, model.fingerprint = decided_room(self.estimate, train, self.config), fingerprint(train)
        model.furnish(train)
        return model

    def furnished_on(self, train: Spectra) -> Self:
        """Return the room with its furniture fitted to the channels of other spectra, without another choice of options."""
        model = copy(self)
        if self.furniture is not None:
            model.furniture = fit_furniture(self.reflectors, self.channels(train), self.furniture)
        return model

    def channels(self, data: Spectra) -> Channels:
        """Return the channels of spectra as the room predicts them, of at most 8 snapshots and of unit power.

        Raises:
            InputError: Spectra without channels, or of another link.
        """
        data = self.link.aligned(data)
        if data.channel is None:
            raise InputError(f"{data.name} contains spectra alone; give snapshots, or ray paths with --subcarriers")
        rows = kept_snapshots(data.channel.shape[1])
        carrier = LIGHT_SPEED / self.array.wavelength
        frequency = torch.ones(len(rows)).double() if data.frequency_hz is None else data.frequency_hz[rows] / carrier
        return Channels(self.link_at(data.position), unit_power(data.channel[:, rows]), frequency)

    def _update(self, new: Spectra) -> None:
        if self.planes:
            self.estimate, self.fingerprint = update_room(self.estimate, new, self.config), ""

    @single_thread()
    def refined_on(self, scene: PhaseObservations) -> Self:
        """Return the room with offsets and gains refined on the observed phases of some spectra, without a search."""
        model, new = copy(self), refine(scene, self.tensors())
        refined = zip(self.planes, new.offset[0].tolist(), new.gain[0].tolist(), strict=True)
        model.estimate = replace(self.estimate, planes=[replace(p, offset_m=o, gain=g) for p, o, g in refined])
        return model

    def with_order(self, order: int) -> Self:
        """Return the same planes with image sources of up to `order` reflections."""
        model = copy(self)
        model.estimate = replace(self.estimate, order=order)
        return model

    @property
    def room(self) -> GeometryModel:
        """The model itself."""
        return self

    @property
    def planes(self) -> list[Plane]:
        """Planes of the room."""
        return self.estimate.planes

    @property
    def order(self) -> int:
        """Highest number of reflections of an image source."""
        return self.estimate.order

    @property
    def conclusion(self) -> str:
        """Result of the search in one sentence."""
        return self.estimate.conclusion

    def _predict(self, position: Tensor, grid: AngularGrid, with_std: bool) -> tuple[Tensor, Tensor | None]:
        return self.array.spectrum(self.channel(position), grid), None

    def channel(self, position: Tensor, frequency_hz: Tensor | None = None) -> Tensor:
        """Predict the channel of each element, up to one complex factor.

        Args:
            position: Positions of the moving end, (n, 3) [m].
            frequency_hz: Frequencies (F,) [Hz]. Defaults to the carrier alone.

        Returns:
            Channels, complex64 (n, F, K), or (n, K) at the carrier.

        Example:
            >>> import swiftwrf
            >>> room = swiftwrf.simulated_room(n=20)
            >>> model = GeometryModel.of_planes(room, [Plane((0.0, 0.0, -1.0), offset_m=0.0, gain=-0.6)])
            >>> model.channel(room.position[:3], torch.tensor([2.40e9, 2.42e9])).shape
            torch.Size([3, 2, 16])
        """
        scene = self.link_at(position)
        ratio = torch.ones(1) if frequency_hz is None else frequency_hz * self.array.wavelength / LIGHT_SPEED
        channel = superposed(self.gains(scene), waves(self.reflectors, scene, ratio))
        return channel[:, 0] if frequency_hz is None else channel

    def gains(self, scene: LinkAt) -> Tensor:
        """Return the gains of the direct path and of each image at positions, float32 (n, 1 + S)."""
        room = self.reflectors
        if self.furniture is not None:
            return self.furniture.gains(room, scene)
        if not room.sequence:
            return torch.ones(len(scene), 1)
        reflected = room.image_gain[0] * room.angular_factor(scene)[0].T
        return torch.nn.functional.pad(reflected, (1, 0), value=1.0).expand(len(scene), -1)

    @checked
    def paths(self, position: Numbers) -> pd.DataFrame:
        """Return the paths between one position of the moving end and the fixed end, strongest first.

        Args:
            position: Position (3,) [m].

        Returns:
            Each path that exists in a row. `reflections`: numbers of the planes, those of surfaces of the furniture follow
            those of the room. `length_m`. `level_db`: amplitude, relative to a direct path that nothing hides. `hidden_db`:
            part of the level that is lost in furniture. `points`: places of reflection from the transmitter to the
            receiver, both included, (2 + D, 3) [m].

        Raises:
            InputError: Another shape, or a position that is not finite.

        Example:
            >>> import swiftwrf
            >>> room = swiftwrf.simulated_room(n=20)
            >>> model = GeometryModel.of_planes(room, [Plane((0.0, 0.0, -1.0), offset_m=0.0, gain=-0.6)])
            >>> model.paths(room.position[0]).reflections.tolist()
            [(), (0,)]
        """
        scene, room = self.link_at(check_positions(position, "position", (3,))[None]), self.reflectors
        gain = free = self.gains(scene)[0]
        if self.furniture is not None:
            nothing = torch.zeros_like(self.furniture.absorption)
            free = replace(self.furniture, absorption=nothing).gains(room, scene)[0]
        direct, rows = float(torch.dist(scene.transmitter[0], scene.receiver[0])), []
        for number, sequence in enumerate([(), *room.sequence]):
            points = _points(scene, room, sequence)
            if points is not None:
                length = float(points.diff(dim=0).norm(dim=1).sum())
                level, hidden = (20 * math.log10(max(abs(float(x[number])), 1e-9)) for x in (gain, free))
                spread = 20 * math.log10(direct / length)
                rows.append((sequence, length, level + spread, hidden - level, points.numpy()))
        table = pd.DataFrame(rows, columns=["reflections", "length_m", "level_db", "hidden_db", "points"])
        return table.sort_values("level_db", ascending=False, ignore_index=True)

    def link_at(self, position: Tensor) -> LinkAt:
        """Return the link at positions of the moving end (n, 3) [m]."""
        return LinkAt.of(position, self.link)

    def tensors(self) -> PlaneSet:
        """Return the planes as tensors."""
        return plane_set(self.planes, self.order)

    @property
    def reflectors(self) -> PlaneSet:
        """Planes and, after them, further surfaces of the furniture, whose paths have the `gains`."""
        return self.tensors() if self.furniture is None else self.furniture.joined(self.tensors())

    def image_sources(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return the fixed end and its mirror images: positions (S, 3) [m], gains (S,) and numbers of reflections (S,)."""
        at, strength, order = self.fixed_position[None], torch.ones(1), torch.zeros(1, dtype=torch.int64)
        room = self.tensors()
        if not room.sequence:
            return at, strength, order
        link = replace(self.link_at(at), transmitter=at)
        mirrored, reflections = images(link, room)[0, :, 0], torch.tensor([len(s) for s in room.sequence])
        return torch.cat([at, mirrored]), torch.cat([strength, room.image_gain[0]]), torch.cat([order, reflections])

    def to_json(self) -> dict[str, Any]:
        """Return the room as plain values, see `RoomEstimate.to_json`, and the `Furniture`, if there is any."""
        furniture = None if self.furniture is None else self.furniture.to_json()
        return self.estimate.to_json() | ({} if furniture is None else {"furniture": furniture})

    def region(self) -> Tensor:
        """Return the middle of the room and two opposite corners (3, 3) [m]."""
        low, high = self.bounds[0].clone(), self.bounds[1].clone()
        for plane in self.planes:
            axis = max(range(3), key=lambda axis: abs(plane.normal[axis]))
            at = plane.offset_m / plane.normal[axis]
            (high if plane.normal[axis] > 0 else low)[axis] = at
        return torch.stack([(low + high) / 2, low, high])

    def _restored(self) -> None:
        super()._restored()
        if self.furniture is not None:
            self.furniture.check(len(self.planes))


def _points(scene: LinkAt, room: PlaneSet, sequence: Sequence) -> Tensor | None:
    """Return the ends and the places of reflection of one path at the only position of a scene, (2 + D, 3), if it exists."""
    normal, offset = room.normal[0], room.offset[0]
    for planes in orders((sequence,), tuple(map(tuple, normal.tolist())))[0].tolist():
        image, points = [scene.transmitter[0]], [scene.receiver[0]]
        for plane in planes:
            image.append(mirror(image[-1], normal[plane], offset[plane]))
        for plane in reversed(planes):
            towards = image.pop() - points[-1]
            fraction = float((offset[plane] - points[-1] @ normal[plane]) / (towards @ normal[plane]))
            if not 0 < fraction < 1:
                break
            points.append(points[-1] + fraction * towards)
        else:
            return torch.stack([scene.transmitter[0], *reversed(points)])
    return None
