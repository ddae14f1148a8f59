"""The amplitude of channels changes nothing: directions, spectra, positions, findings and calibrations, at every scale."""

from dataclasses import replace
from functools import cache

import pytest
import torch
from rooms import ARRAY, built_in_walls, mirror_room

from augment.estimators import ESTIMATORS, make_estimator
from augment.estimators.subspace import SnapshotEstimator
from swiftwrf import MatchedField, Snapshots, calibrate, inspect, predict
from swiftwrf.array.beamforming import BEAMFORMERS
from swiftwrf.array.planar import LIGHT_SPEED
from swiftwrf.locate import MatchedFieldConfig
from swiftwrf.locate.features import SpectrumFeatures
from swiftwrf.models.geometry import GeometryModel

N = 24
SCALES = [2.0**power for power in (-100, -66, -27, 27, 100)]  # 1e-30 to 1e30, without errors of rounding
FREQUENCY = LIGHT_SPEED / ARRAY.wavelength + torch.linspace(-20e6, 20e6, 16, dtype=torch.float64)
BY_CHANNELS = [name for name, kind in ESTIMATORS.items() if issubclass(kind, SnapshotEstimator)]


@cache
def room():
    return GeometryModel.of_planes(spectra(), built_in_walls(0.7))


@cache
def spectra():
    return mirror_room({}, moving="transmitter", n=N)


@cache
def snapshots(scale=1.0, last=None):
    """Channels of a room, whose amplitudes are multiplied by a scale; with a last one, alternate rows by this."""
    channel = room().channel(spectra().position, FREQUENCY).to(torch.complex64)
    each = torch.tensor([scale, last or scale]).repeat(N // 2)[:, None, None]
    place = {"fixed_position": spectra().fixed_position, "rotation": spectra().rotation}
    return Snapshots(channel * each, spectra().position, array=ARRAY, frequency_hz=FREQUENCY, **place)


def closest(found, usual, degrees=0.01):
    torch.testing.assert_close(found.double(), usual.double(), atol=degrees * torch.pi / 180, rtol=0)


@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize("name", BY_CHANNELS)
def test_directions(name, scale):
    usual, found, mixed = (
        make_estimator(name).estimate(data.spectra((6, 24)).subset(torch.arange(8)))
        for data in (snapshots(), snapshots(scale), snapshots(1 / scale, scale))
    )
    closest(found, usual)
    closest(mixed, usual)


def test_all_estimators_of_channels_are_tried():
    assert {"music", "esprit", "maximum_likelihood", "joint_music"} <= {*BY_CHANNELS}


@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize("beamformer", BEAMFORMERS)
def test_spectra(beamformer, scale):
    usual, found = (data.spectra((10, 40), beamformer).spectrum for data in (snapshots(), snapshots(scale)))
    torch.testing.assert_close(found, usual, atol=1e-5, rtol=0)


@pytest.mark.parametrize("scale", SCALES[::4])
def test_findings(scale):
    usual, found = (inspect(replace(data, **two(data)), grid=(6, 24)) for data in (snapshots(), snapshots(scale)))
    assert found.numbers == usual.numbers
    assert found.warnings == usual.warnings


def two(data):
    return {"channel": data.channel[:, :2], "frequency_hz": FREQUENCY[:2]}


@pytest.mark.parametrize("scale", SCALES)
def test_calibration(scale):
    """Direct paths, with a phase of each element."""
    wave = torch.polar(torch.ones(()), ARRAY.phase(snapshots().direction).float() + torch.linspace(0, 2, 16))
    usual, found = (
        calibrate(replace(snapshots(), channel=wave[:, None] * each, frequency_hz=None)) for each in (1.0, scale)
    )
    torch.testing.assert_close(found.phase, usual.phase)
    torch.testing.assert_close(found.turn, usual.turn)


@pytest.mark.parametrize("scale", SCALES)
def test_channels_of_a_room_and_a_locator(scale):
    usual, found = (snapshots(each).spectra((6, 24)) for each in (1.0, scale))
    torch.testing.assert_close(room().channels(found).value, room().channels(usual).value)
    features = [SpectrumFeatures.of_channels(data.channel, ARRAY) for data in (usual, found)]
    torch.testing.assert_close(features[1].channel, features[0].channel)
    torch.testing.assert_close(features[1].coarray, features[0].coarray)


@pytest.mark.long
def test_positions_of_faint_and_loud_channels():
    """A locator that was fitted at one scale, of channels at others."""
    config = MatchedFieldConfig(spacing=0.5, max_cells=1000, n_best=20, n_background=10, n_rounds=1, n_calibration=16)
    first, last = torch.arange(N - 4), torch.arange(N - 4, N)
    fitted = []
    for scale in (1.0, SCALES[0]):
        data = snapshots(scale).spectra((6, 24)).subset(first)
        fitted.append(MatchedField(config).fit(data, room=GeometryModel.of_planes(data, built_in_walls(0.7))))
    usual = predict(fitted[0], snapshots().spectra((6, 24)).subset(last))
    for locator, scale in [(fitted[0], scale) for scale in (SCALES[0], SCALES[-1])] + [
        (other, 1.0) for other in fitted[1:]
    ]:
        found = predict(locator, snapshots(scale).spectra((6, 24)).subset(last))
        for name in ("x_m", "y_m", "z_m", "credible_radius_80_m"):
            assert found[name].tolist() == pytest.approx(usual[name].tolist(), abs=2e-3)


@pytest.mark.parametrize("carrier_hz", [5.9e9, 2.4e8])
def test_frequencies_of_another_band_than_the_array_are_refused(carrier_hz):
    data = snapshots()
    frequency = FREQUENCY - FREQUENCY.mean() + carrier_hz
    with pytest.raises(ValueError, match=r"frequencies of one carrier's snapshots, 4.4\d+e\+08 to 1.8\d+e\+09 Hz, got"):
        replace(data, frequency_hz=frequency)
