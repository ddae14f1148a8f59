"""Geometry plus what is smooth: the strengths of its paths, and a Gaussian process on what these leave of the spectra.

    spectrum(s) = a geometry(s; strengths(s)) + mean + k(s, training positions) w

Strengths vary unless held-out spectra come out clearly better without. Where the paths explain only a part, their fringes
are worth their share a: the least-squares share at training spectra that are held out from the strengths and from the
process, hence never worse there than the better of the two parts.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import ClassVar

import torch
from torch import Tensor

from swiftwrf.data.spectra import Spectra, check_training
from swiftwrf.data.splits import Validation, folds
from swiftwrf.errors import InputError
from swiftwrf.gp import Kernel, choose_kernel, held_out_weights
from swiftwrf.metrics import psnr
from swiftwrf.models.geometry.fit import observe
from swiftwrf.models.geometry.model import GeometryModel
from swiftwrf.models.geometry.planes import advantage
from swiftwrf.models.geometry.strengths import Strengths, fit_strengths, prior
from swiftwrf.positions import check_batch, check_drawn, check_positions
from swiftwrf.runtime.checkpoint import Header, Saved, expect
from swiftwrf.runtime.threads import single_thread

COMPONENTS = 64  # principal components of the difference that are kept at most
PIXELS = 4000  # of a spectrum that are enough to choose kernel and share
MOST = 10_000  # spectra: all their inner products are computed
BATCH = 256  # spectra at a time
NEEDED = 1.0  # standard errors by which constant strengths must be ahead of others, judged from fewer spectra
FIRST = 0.7  # share with which the kernel is chosen


@dataclass(frozen=True, eq=False)
class HybridModel(Saved):
    """What `fit_hybrid` returns.

    Args:
        geometry: the room.
        strengths: of its paths; None where they are the same everywhere.
        share: of its spectra in the prediction, 0 to 1.
        kernel: of the process, lengths in [m].
        anchor: training positions, float64 (n, 3) [m].
        readout: kernel weights to component scores, float32 (n, k).
        component: the mean difference, then the components, float32 (1 + k, pixels).
    """

    kind: ClassVar[str] = "hybrid model"

    geometry: GeometryModel
    strengths: Strengths | None
    share: float
    kernel: Kernel
    anchor: Tensor
    readout: Tensor
    component: Tensor

    @torch.no_grad()
    def synthesize(self, position: Tensor, generator: torch.Generator | None = None, batch: int = BATCH) -> Tensor:
        """Spectra at positions (n, 3) [m] of the moving end, float32 (n, n_elevation, n_azimuth) in [0, 1]; with a generator
        the room's part is drawn.

        Raises:
            InputError: positions of another shape, or not finite.
        """
        position = check_positions(position)
        check_batch(batch)
        spectrum = torch.empty(len(position), *self.geometry.grid.shape)
        for start in range(0, len(position), batch):
            rows = slice(start, start + batch)
            score = self.kernel(position[rows], self.anchor).float() @ self.readout
            smooth = (self.component[0] + score @ self.component[1:]).reshape(-1, *self.geometry.grid.shape)
            sharp = self.share * _room(self.geometry, self.strengths, position[rows], generator) if self.share else 0.0
            spectrum[rows] = (smooth + sharp).clamp(0, 1)
        return check_drawn(spectrum)

    def state(self) -> tuple[dict[str, Tensor], Header]:
        """All there is to save: tensors and plain values."""
        tensors, values = self.geometry.state()
        own = {"anchor": self.anchor, "readout": self.readout, "component": self.component}
        values |= {"share": self.share, "kernel": asdict(self.kernel), "strengths": None}
        if self.strengths is not None:
            own |= {"strengths.anchor": self.strengths.anchor, "strengths.readout": self.strengths.readout}
            values["strengths"] = asdict(self.strengths.kernel)
        return tensors | own, values

    @classmethod
    def from_state(cls, tensors: dict[str, Tensor], header: Header) -> HybridModel:
        """The model that `state` described."""
        own = {name: tensors[name] for name in ("anchor", "readout", "component")}
        geometry = GeometryModel.from_state(tensors, header)
        strengths = None
        if header["strengths"] is not None:
            anchor, readout = (tensors.get(f"strengths.{name}", torch.empty(0, 0)) for name in ("anchor", "readout"))
            shape = (len(anchor), *readout.shape[1:2], len(geometry.image_sources()[0]), 2)
            expect(tensors, {"strengths.anchor": (len(anchor), 3), "strengths.readout": shape})
            strengths = Strengths(Kernel(**header["strengths"]), anchor, readout)
        return cls(geometry, strengths, header["share"], Kernel(**header["kernel"]), **own)


def room_of(model: Saved) -> GeometryModel | None:
    """The room that a model found; None where it knows of none."""
    room = model.geometry if isinstance(model, HybridModel) else model
    return room if isinstance(room, GeometryModel) else None


@single_thread()
def fit_hybrid(
    train: Spectra,
    geometry: GeometryModel,
    *,
    validation: Validation = "random",
    seed: int = 0,
    like: HybridModel | None = None,
) -> HybridModel:
    """Fits strengths to what the spectra say of the paths, and the process to what the room leaves of them.

    Args:
        train: the only spectra it sees.
        geometry: found from the same spectra.
        validation: how they are held out to choose kernel and share.
        seed: of what is held out.
        like: a model of the same room from other spectra, whose kernel of the strengths is taken.

    Raises:
        InputError: fewer than 10 spectra or more than 10,000, or something not finite.
    """
    check_training(train)
    if len(train) > MOST:
        raise InputError(
            f"hybrid is fitted to all inner products of its spectra, at most {MOST} of them, not {len(train)}; take "
            "geometry, coarray or swiftwrf, or fewer spectra"
        )
    fold = folds(train.position, validation, seed)
    strengths, known = _strengths(train, geometry, fold, seed, like)
    seen, known = train.spectrum.flatten(1), known.flatten(1)
    stride = max(1, seen.shape[1] // PIXELS) | 1
    some, some_known = seen[:, ::stride], known[:, ::stride]
    kernel = choose_kernel(train.position, (some - FIRST * some_known)[:, None], fold)
    share, gains = _share(train.position, some, some_known, fold, kernel)
    left = seen - share * known
    if not gains:
        nothing = torch.zeros(1, seen.shape[1])
        return HybridModel(geometry, strengths, 1.0, kernel, train.position, torch.zeros(len(train), 0), nothing)
    mean = left.mean(0)
    value, vector = torch.linalg.eigh(((left - mean) @ (left - mean).T).double())
    vector = vector[:, value > 1e-6 * value.sum()][:, -COMPONENTS:]
    readout = torch.linalg.solve(kernel.noisy_gram(train.position), vector).float()
    component = torch.cat([mean[None], vector.T.float() @ (left - mean)])
    return HybridModel(geometry, strengths, share, kernel, train.position, readout, component)


def _room(
    geometry: GeometryModel, strengths: Strengths | None, position: Tensor, generator: torch.Generator | None = None
) -> Tensor:
    """Spectra (n, H, W) that follow from the paths."""
    if strengths is None:
        return geometry.synthesize(position, generator)
    channels = (strengths.channel(geometry, part, generator) for part in position.split(BATCH))
    return torch.cat([geometry.array.spectrum(channel, geometry.grid) for channel in channels])


def _strengths(
    train: Spectra, geometry: GeometryModel, fold: Tensor, seed: int, like: HybridModel | None
) -> tuple[Strengths | None, Tensor]:
    """Strengths from all training spectra, and the spectra (n, H, W) that follow at each one's position from the others."""
    if not geometry.planes or (like and not like.strengths):
        return None, geometry.synthesize(train.position)
    scene, rows = observe(train, seed)
    kernel = like.strengths.kernel if like and like.strengths else prior(scene.moving)
    known = torch.empty(len(train), *geometry.grid.shape)
    for number in fold.unique():
        out = (fold == number).nonzero()[:, 0]  # those of which nothing was observed, too
        kept = scene.subset((fold[rows] != number).nonzero()[:, 0])
        known[out] = _room(geometry, fit_strengths(geometry, kept, kernel), train.position[out])
    if not like:
        constant, seen = geometry.synthesize(train.position), train.spectrum
        if advantage(psnr(constant, seen), psnr(known, seen)) > NEEDED:
            return None, constant
    return fit_strengths(geometry, scene, kernel), known


def _share(position: Tensor, seen: Tensor, known: Tensor, fold: Tensor, kernel: Kernel) -> tuple[float, bool]:
    """The share of `known` (n, pixels) that leaves least of `seen` where it is held out from the process, in [0, 1], and
    whether that, with the process, leaves less than `known` alone, by the mean logarithm of the squared error."""
    missed, sharp = torch.empty_like(seen), torch.empty_like(known)
    for out, kept, weight in held_out_weights(kernel, position, fold):
        for x, left in ((seen, missed), (known, sharp)):
            mean = x[kept].mean(0)
            left[out] = x[out] - mean - weight.float() @ (x[kept] - mean)
    power = float(sharp.square().sum())
    share = min(1.0, max(0.0, float((missed * sharp).sum()) / power)) if power > 0 else 0.0
    both, alone = ((x.square().mean(1) + 1e-9).log().mean() for x in (missed - share * sharp, seen - known))
    return share, bool(both < alone)
