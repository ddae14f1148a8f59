"""Field models and RSSI predictors in their smallest size, so that a fit takes a second or less: one table of sizes."""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import fields, replace
from typing import Any, get_type_hints
from unittest import mock

from swiftwrf import MatchedField, RssiModel, Spectra
from swiftwrf.contrib.comparison.steps import Memo
from swiftwrf.contrib.published import NeRF2Rssi
from swiftwrf.contrib.published.base import Config
from swiftwrf.contrib.published.generative import DcganConfig, VaeConfig
from swiftwrf.contrib.published.nerf2 import NeRF2Config, NeRF2RssiConfig
from swiftwrf.contrib.published.wrfgs import WrfGsConfig
from swiftwrf.gp import candidates
from swiftwrf.locate import MatchedFieldConfig, spectrum_likelihood
from swiftwrf.models import FIELD_MODELS
from swiftwrf.models.geometry import GeometryConfig, GeometryModel, furniture, search, uncertainty
from swiftwrf.models.geometry.fit import search_room
from swiftwrf.models.geometry.path_gains import PRIORS
from swiftwrf.models.geometry.planes import Plane, RoomEstimate
from swiftwrf.models.geometry.search import Search
from swiftwrf.models.swiftwrf import SwiftWRFConfig
from swiftwrf.models.swiftwrf_paper import SwiftWRFPaperConfig
from swiftwrf.rssi import RssiConfig, maps
from swiftwrf.runtime.registry import Registry
from swiftwrf.runtime.validation import configuration

FIT = SwiftWRFConfig(n_primitives=16)  # the search for their number has its own tests
SHORT = {"steps": 12, "check_every": 6, "batch": 8, "warm_up": 1}
LONGER = {"steps": 60, "check_every": 30, "batch": 16, "rate": 1e-2}  # the loss of a batch is noisy in so short a fit
PUBLISHED: dict[str, Config] = {
    "nerf2": NeRF2Config(width=8, depth=6, bands=2, samples=6, rays=64, **LONGER),
    "wrfgs": WrfGsConfig(n_gaussians=20, width=8, depth=6, bands=2, **SHORT),
    "vae": VaeConfig(latent=2, width=2, hidden=8, bands=2, **LONGER),
    "dcgan": DcganConfig(noise=2, width=2, hidden=8, bands=2, **LONGER),
}
PAPER = SwiftWRFPaperConfig(n_primitives=4, steps=30, check_every=5)
PUBLISHED_RSSI = NeRF2RssiConfig(width=8, bands=2, samples=4, azimuths=4, elevations=2, **LONGER)
FEW_CELLS = MatchedFieldConfig(max_cells=2000, n_best=40, n_background=20, n_rounds=1, n_calibration=16)
COARSE = {"spacing": 1.0, "max_cells": 500, "n_best": 20, "n_background": 10, "n_split": 4, "n_rounds": 2}
COARSEST = {"spacing": 4.0, "max_cells": 100, "n_best": 10, "n_background": 5, "n_split": 2, "n_calibration": 10}
GLANCE = GeometryConfig(
    search_distance_m=0.5, n_search_positions=10, beam_width=1, max_order=1, max_extra_planes=0
)  # a short search that finds little
FLOOR = Plane((0.0, 0.0, -1.0), offset_m=0.0, gain=-0.6)


def with_defaults(config: Any) -> type[Any]:
    """Return a subclass of the configuration's class whose defaults are the values of the configuration."""
    parent = type(config)
    values = {field.name: getattr(config, field.name) for field in fields(config)}
    annotations = get_type_hints(parent, include_extras=True)
    # any configuration of the parent's class counts as one of this class, e.g. that of a study sent to a worker
    kind = type("SameInstances", (type(parent),), {"__instancecheck__": lambda _, given: isinstance(given, parent)})
    made = configuration(kind(parent.__name__, (parent,), values | {"__annotations__": annotations}))
    # found by its name, as the worker of a cluster has such a class, too
    made.__module__, made.__qualname__ = __name__, f"Small{parent.__name__}"
    globals()[made.__qualname__] = made
    return made


# What is replaced in tests whose subject it is not: defaults of options, entries of dictionaries (keyword defaults of
# functions among them), and sizes of modules.
SIZES: dict[str, list[tuple[Any, Any]]] = {
    "published": [
        *((FIELD_MODELS[name], config) for name, config in {**PUBLISHED, "swiftwrf_paper": PAPER}.items()),
        (NeRF2Rssi, PUBLISHED_RSSI),
    ],
    "primitives": [(FIELD_MODELS["swiftwrf"], FIT), (RssiModel, RssiConfig(n_primitives=0))],
    "cells": [(MatchedField, FEW_CELLS)],
    "kernels": [(candidates.__kwdefaults__, {"n_lengths": 2, "n_smooth": 1})],
    "distributions": [(spectrum_likelihood, {"DEGREES": (5.0,)})],
    "path gains": [(PRIORS, {"tight": replace(PRIORS["tight"], steps=15)})],
    "furniture": [(furniture, {"SETTINGS": furniture.SETTINGS[:1], "N_STEPS": 10, "MIN_HELD_OUT": 20})],
    "maps": [(maps, {"CELLS": 8})],
    "searches": [
        (search, {"SIGNS": search.SIGNS[:1], "MAX_ALTERNATIVES": {2: 5, 3: 2}, "MAX_MOVES": 1, "N_REFINED": 2}),
        (search, {"N_HORIZONTAL_NORMALS": 20, "N_SPHERE_NORMALS": 20}),
        (uncertainty, {"MAX_PERIODS": 1, "N_COARSE": 2, "N_FINE": 1, "N_WHOLE": 1}),
    ],
}


@contextmanager
def small(*groups: str) -> Iterator[None]:
    """Replace the sizes of some groups of the table."""
    with ExitStack() as patches:
        for owner, values in (size for group in groups for size in SIZES[group]):
            if isinstance(owner, dict):
                patch = mock.patch.dict(owner, values, clear=owner is PRIORS)
            elif isinstance(values, dict):
                patch = mock.patch.multiple(owner, **values)
            else:
                patch = mock.patch.object(owner, "config_type", with_defaults(values))
            patches.enter_context(patch)
        yield


@contextmanager
def only(registry: Registry[Any], *names: str, **others: Any) -> Iterator[None]:
    """Let a registry have these of its names alone, and other implementations."""
    with mock.patch.object(registry, "_registered", {name: registry[name] for name in names} | others):
        yield


@contextmanager
def known_planes(*planes: Plane) -> Iterator[None]:
    """Let every search for a room give these planes at once."""

    def found(train: Spectra, config: GeometryConfig, progress: bool = False) -> RoomEstimate:
        return GeometryModel.of_planes(train, list(planes)).estimate

    with mock.patch("swiftwrf.models.geometry.model.search_room", found):
        yield


@contextmanager
def glances() -> Iterator[None]:
    """Shorten the search for rooms, which has its own tests, to one of few planes."""

    def glance(train: Spectra, config: GeometryConfig, progress: bool = False) -> RoomEstimate:
        return search_room(train, replace(GLANCE, seed=config.seed, validation=config.validation), progress)

    with (
        small("searches"),
        mock.patch("swiftwrf.models.geometry.model.search_room", glance),
        mock.patch.object(Search, "improve", lambda search, room: room),
    ):
        yield


class Counted(Memo):
    """The steps that are to be done in all, at each beginning of one."""

    def __init__(self, folder=None):
        super().__init__(folder)
        self.begun, self.expected, self.totals = [], 0, []

    def expect(self, steps):
        self.expected += steps

    def begin(self, name, title):
        self.begun.append(title)
        self.totals.append(self.expected)
