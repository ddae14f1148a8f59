"""Matched-field processing in the angle-of-arrival task: positions, keys, resumption, and the choice of the estimator."""

import json
from contextlib import contextmanager
from copy import copy
from dataclasses import replace
from unittest import mock

import locating_aoa
import numpy as np
import pandas as pd
import pytest
import torch
from quick import cheap, command, sketched
from rooms import mirror_room
from small import known_planes

from augment.cross_validation import LOCATOR
from augment.turbo.condition import LOCATED
from augment.turbo.stages import containing_level
from swiftwrf import MatchedField, load
from swiftwrf.locate import Posterior
from swiftwrf.models import FIELD_MODELS
from swiftwrf.models.geometry.model import fingerprint
from swiftwrf.models.geometry.planes import Plane
from tasks.aoa import experiment

PLANES = {(0.0, 0.0, -1.0): 0.0, (1.0, 0.0, 0.0): 5.0, (0.0, 1.0, 0.0): 4.0}  # outward normal to offset [m]
FIT = MatchedField.fit
ON_SNAPSHOTS = {"music", "esprit", "maximum_likelihood", "joint_music"}  # left out, as the data contain spectra alone


@pytest.fixture(scope="module")
def closed_form():
    """Spectra of three planes in closed form, without noise."""
    data = mirror_room(PLANES, moving="transmitter", n=40)
    return replace(data, label=data.direction_at(data.position))


LOCATORS = {}


def fit_once(self, train, *, room=None, progress=False):
    """Fit equal locators to equal spectra once for all tests: a fit takes seconds."""
    key = (fingerprint(train), room and len(room.room.planes))
    if key not in LOCATORS:
        LOCATORS[key] = FIT(copy(self), train, room=room)
    vars(self).update(vars(LOCATORS[key]))
    return self


@contextmanager
def quickly(data, planes=PLANES):
    """Cheap parts, these planes in place of a search for the room, and few candidates."""

    def few(data):
        return [name for name in ("idw", "geometry") if not FIELD_MODELS[name].lacking(data)]

    with (
        cheap(),
        sketched(),
        known_planes(*(Plane(normal, offset, -0.6) for normal, offset in planes.items())),
        mock.patch.object(experiment, "simulated_room", return_value=data),
        mock.patch.object(MatchedField, "fit", fit_once),
        mock.patch("augment.turbo.experiment.candidates", few),
        mock.patch("augment.choose.candidates", few),
    ):
        yield


def mix_of(folder):
    (found,) = json.loads((folder / "metrics.json").read_text())["mixes"].values()
    return found


@pytest.fixture(scope="module")
def finished(closed_form, tmp_path_factory):
    """The directory of a run that locates, with a field model that has no room."""
    folder = tmp_path_factory.mktemp("located") / "run"
    with quickly(closed_form):
        assert command("aoa", "--mix", 0.6, "--extra", 0, "--synthesizer", "nearest", "--out", folder) == 0
    return folder


def test_methods_and_positions_have_their_keys(closed_form, finished):
    mix = mix_of(finished)
    assert LOCATED in mix["methods"]
    assert set(mix["left_out"]) == ON_SNAPSHOTS
    errors = pd.read_csv(finished / "errors.csv")
    positions = pd.read_csv(finished / "positions.csv")
    test = closed_form.split()[1]
    own, at = errors[errors.method == LOCATED], positions[positions.method == LOCATED]
    assert own["index"].tolist() == at["index"].tolist() == test.index.tolist()
    truth, found = (at[[f"{what}_{axis}_m" for axis in "xyz"]].to_numpy() for what in ("truth", "estimate"))
    np.testing.assert_allclose(truth, test.position, rtol=1e-9)
    np.testing.assert_allclose(at["error_m"], np.linalg.norm(found - truth, axis=1), rtol=1e-9)
    assert (at["covered"] == (at["containing_level"] < 0.8)).all()
    located = mix["locating"][LOCATED]
    assert len(located["weights"]) >= 1
    assert set(located["seconds"]) == {"room", "fit", "locate"}


def test_a_known_room_without_noise_is_located(finished):
    """Far below the error of every estimator that does not use the room."""
    mix = mix_of(finished)
    error = {name: method["great_circle_deg"]["median"] for name, method in mix["methods"].items()}
    assert error[LOCATED] < 0.3 * error["kernel_regression, measured"]
    assert mix["locating"][LOCATED]["position_error_m"]["median"] < 0.1
    assert mix["estimator_choice"]["name"] == LOCATED  # whatever field models were asked for
    assert mix["estimator_choice"]["better"] == {}
    usable = {name for name, method in mix["methods"].items() if method["training"] != "all measured"}
    assert set(mix["estimator_choice"]["held_out_deg"]) == usable
    assert "network, measured + synthetic (nearest)" in usable


def test_the_report_shows_where_it_was(finished):
    html = (finished / "report.html").read_text()
    assert "Where was it?" in html
    assert f"<pre><code>swiftwrf predict {finished} SOURCE</code></pre>" in html
    for kind in ("located", "posteriors"):
        assert list((finished / "figures").glob(f"{kind}-mix0.6-*.csv"))


def test_the_trained_locator_is_kept_and_estimates_directions(closed_form, finished, tmp_path):
    file = finished / f"{LOCATOR}-mix0.6.safetensors"
    locator = load(file)
    assert isinstance(locator, MatchedField)
    test = closed_form.split()[1]
    np.save(tmp_path / "new.npy", test.spectrum.numpy())
    out = tmp_path / "directions.csv"
    arguments = (file, tmp_path / "new.npy", "--out", out)
    assert command("predict", *arguments) == 0
    errors = pd.read_csv(finished / "errors.csv")
    own = errors[errors.method == LOCATED]
    found = pd.read_csv(out)
    np.testing.assert_allclose(found["elevation_deg"], own["estimate_elevation_deg"], atol=1e-3)


@pytest.mark.parametrize("missing", ["array", "planes"])
def test_without_array_or_planes_it_is_left_out_with_one_sentence(closed_form, tmp_path, capsys, missing):
    data, planes = (replace(closed_form, array=None), PLANES) if missing == "array" else (closed_form, {})
    with quickly(data, planes):
        assert command("aoa", "--mix", 0.6, "--extra", 0, "--out", tmp_path / "run") == 0
    console = " ".join(capsys.readouterr().err.split())
    mix = mix_of(tmp_path / "run")
    assert LOCATED not in mix["methods"]
    assert mix["locating"] == {}
    assert set(mix["left_out"]) == {LOCATED} | ON_SNAPSHOTS
    reason = mix["left_out"][LOCATED]
    if missing == "array":
        assert console.count(f"{LOCATOR} is left out") == 1
        assert f"{LOCATOR} is left out: {reason}" in console
        assert reason.startswith("it needs the array")
    else:
        assert f"{LOCATOR} is left out with 60% measured: {reason}" in console
        assert reason == "no plane explains the spectra"
    assert LOCATED not in mix["estimator_choice"]["held_out_deg"]
    assert not (tmp_path / "run" / "positions.csv").exists()
    html = (tmp_path / "run" / "report.html").read_text()
    assert ("Where was it?" in html) == (missing == "planes")  # which states that none was found
    assert reason in html


def test_the_benchmark_writes_every_draw_and_their_medians(closed_form, tmp_path, monkeypatch):
    monkeypatch.setattr(locating_aoa, "scenes", lambda config: [("closed form", [closed_form] * 2)])
    with quickly(closed_form):
        locating_aoa.main(locating_aoa.Config(fractions=(0.5,), kernel=True, out=tmp_path))
    written = json.loads((tmp_path / "locating_spectra.json").read_text())
    assert {"command", "environment"} <= set(written)
    found = written["scenes"]["closed form"]["0.5"]
    assert [row["draw"] for row in found["draws"]] == [0, 1]
    for name in ("angle_deg", "position_m", "kernel_regression_angle_deg"):
        assert found["median"][name]["p90"] == pytest.approx(np.mean([row[name]["p90"] for row in found["draws"]]))
        assert found["median"][name]["median"] > 0
    assert 0 <= found["median"]["coverage_80"] <= 1
    assert set(found["median"]["seconds"]) == {"room", "fit", "locate"}
    with quickly(closed_form, {}):
        row = locating_aoa.measure(closed_form, closed_form, draw=0, kernel=False)
    assert row["left_out"] == "no plane explains the spectra"


def test_the_containing_level_is_that_of_the_credible_radius():
    generator = torch.Generator().manual_seed(0)
    at = torch.randn(6, 40, 3, generator=generator, dtype=torch.float64)
    log_weight = torch.randn(6, 40, generator=generator, dtype=torch.float64).log_softmax(dim=1)
    posterior, truth = Posterior(at, log_weight, 0.1, 1.3), torch.randn(6, 3, generator=generator, dtype=torch.float64)
    error = (truth - posterior.median).norm(dim=1)
    for level in (0.2, 0.5, 0.8):
        inside = error <= posterior.credible_radius(level)
        assert torch.equal(containing_level(posterior, truth) < level, inside)
