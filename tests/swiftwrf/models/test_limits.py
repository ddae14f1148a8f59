"""Coordinates far from the origin, grids and sizes that cannot be, installations without a home."""

import os
import subprocess
import sys
from dataclasses import replace

import pytest
import small
import torch

from swiftwrf import RssiLocator, rssi_room
from swiftwrf.choices import RSSI_PREDICTORS
from swiftwrf.models import FIELD_MODELS


def moved(spectra, shift):
    """Return the measurements in coordinates from another origin."""
    fixed = None if spectra.fixed_position is None else spectra.fixed_position + shift
    return replace(spectra, position=spectra.position + shift, fixed_position=fixed)


@pytest.mark.parametrize("name", FIELD_MODELS)
def test_field_models_do_not_depend_on_the_origin(room, small_published, short_fits, name):
    """The origin of map coordinates may be thousands of kilometres away."""
    train, test = room.subset(torch.arange(24)).split("random")
    predicted = []
    for shift in (0.0, 1e7):
        floor = replace(small.FLOOR, offset_m=-shift)
        with small.known_planes(floor) if name == "hybrid" else small.glances():
            predicted.append(FIELD_MODELS[name]().fit(moved(train, shift)).predict(test.position + shift).mean)
    # positions at 1e7 m are rounded to 2e-9 m. Two networks that train against each other amplify it,
    # and so do path gains, on processors without AVX-512 to 6e-3.
    torch.testing.assert_close(*predicted, atol={"dcgan": 2e-2, "hybrid": 1e-2}.get(name, 2e-3), rtol=0)


def floors(data):
    """Return RSSI in coordinates from two origins, and how far these are apart [m]."""
    for shift in (0.0, 1e7):
        at, receiver = data.transmitter_position + shift, data.receiver_position + shift
        yield shift, replace(data, transmitter_position=at, receiver_position=receiver)


@pytest.mark.parametrize("name", RSSI_PREDICTORS)
def test_predictors_do_not_depend_on_the_origin(small_published, short_fits, name):
    models = [(RSSI_PREDICTORS[name]().fit(some), some) for _, some in floors(rssi_room(n=40).receivers(["1", "2"]))]
    predicted = [model.predict(some.transmitter_position[:10]).mean for model, some in models]
    torch.testing.assert_close(*predicted, atol=0.05, rtol=0)  # dB


def test_locators_do_not_depend_on_the_origin():
    train, test = rssi_room(n=150, seed=1).columns(range(0, 12, 2)).split()
    located = [RssiLocator(n_cells=600).fit(some).locate(test.rssi_dbm).median - at for at, some in floors(train)]
    torch.testing.assert_close(*located, atol=0.05, rtol=0)  # m


def test_an_installation_without_a_place_for_caches():
    """Numba keeps what it compiled beside the source or in the home; where it can do neither, it must do without."""
    code = (
        "import numba.core.caching as c\n"
        "c._Cache._impl_class = None\n"
        "for l in c.CacheImpl._locator_classes: l.from_function = classmethod(lambda *a: None)\n"
        "import swiftwrf.contrib.rasterize.cpu\nprint('imported')"
    )
    environment = os.environ | {"PYTHONPATH": os.getcwd()}
    child = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment, check=False)
    assert "imported" in child.stdout, child.stderr[-500:]
