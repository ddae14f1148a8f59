"""Figures, tables and texts of objects in notebooks: what they contain."""

import math

import matplotlib
import pytest
import torch
from matplotlib import pyplot

from swiftwrf import AngularGrid, Prediction, Rssi, make_model, rssi_room, simulated_room
from swiftwrf.locate import Posterior
from swiftwrf.plotting import polar_spectrum
from swiftwrf.rssi import fit_rssi

ROOM = simulated_room(n=20, grid=AngularGrid.hemisphere(8, 32))
FLOOR = rssi_room(n=60)
TWO = torch.tensor([[[0.0, 0.0, 1.0], [3.0, 4.0, 1.0]]], dtype=torch.float64)


@pytest.fixture(autouse=True)
def _closed_figures():
    matplotlib.use("agg")
    yield
    pyplot.close("all")


def bar_of(ax):
    """Colour bar beside axes."""
    return next(other for other in ax.figure.axes if other is not ax)


def test_a_spectrum_is_drawn_at_its_directions():
    """The brightest cell of the figure contains the direction of the peak."""
    grid = AngularGrid.hemisphere(9, 36)
    spectrum = torch.zeros(9, 36)
    spectrum[2, 5] = 1.0
    mesh = polar_spectrum(spectrum, grid).collections[0]
    brightest = int(mesh.get_array().argmax())
    corner = mesh.get_coordinates()  # azimuth [rad] and angle to the normal [deg] of the cells' corners
    row, column = divmod(brightest, 36)
    low, high = corner[row + 1, column], corner[row, column + 1]
    azimuth, elevation = float(grid.azimuth[5]), float(grid.elevation[2].rad2deg())
    assert low[0] < azimuth < high[0]
    assert low[1] < 90 - elevation < high[1]
    assert mesh.get_clim() == (0, 1)


def test_spectra_name_quantity_position_and_line_of_sight():
    ax = ROOM.plot(3)
    assert bar_of(ax).get_ylabel() == "magnitude"
    x, y, z = ROOM.position[3].tolist()
    assert ax.get_title() == f"simulated-room 3 at ({x:.2f}, {y:.2f}, {z:.2f}) m"
    (mark,) = ax.lines
    azimuth, elevation = ROOM.label[3]
    assert mark.get_label() == "line of sight"
    found = float(mark.get_xdata()[0]), float(mark.get_ydata()[0])
    assert found == pytest.approx((float(azimuth), 90 - float(elevation.rad2deg())))
    into = pyplot.figure().add_subplot(projection="polar")
    assert ROOM.plot(0, ax=into) is into
    assert ROOM.plot(-1).get_title().startswith("simulated-room 19 ")


def test_rssi_is_drawn_where_it_was_detected():
    data = Rssi(
        [[-50.0, float("nan")], [-60.0, -40.0], [float("nan")] * 2], torch.rand(3, 3), receiver_names=["a", "b"]
    )
    drawn = ((None, [-50, -40], "strongest receiver"), ("b", [-40], "b"), ("1", [-50, -60], "a"))
    for receiver, values, title in drawn:
        ax = data.plot(receiver)
        assert ax.collections[0].get_array().tolist() == values
        assert ax.get_title() == f"rssi, {title}"
        assert bar_of(ax).get_ylabel() == "RSSI [dBm]"


def test_models_and_predictions_draw_what_they_predict():
    model = make_model("idw").fit(ROOM)
    prediction = model.predict(ROOM.position[:2])
    for ax in (model.plot(ROOM.position[1]), prediction.plot(1)):
        torch.testing.assert_close(torch.from_numpy(ax.collections[0].get_array().data), prediction.mean[1])
    maps = fit_rssi(FLOOR)
    ax = maps.plot("receiver03")
    (image,) = ax.images
    left, right, bottom, top = image.get_extent()
    measured = FLOOR.transmitter_position
    assert (left, bottom) == pytest.approx(measured[:, :2].amin(dim=0).tolist(), abs=1.0)
    assert (right, top) == pytest.approx(measured[:, :2].amax(dim=0).tolist(), abs=1.0)
    half = (right - left) / image.get_array().shape[1] / 2, (top - bottom) / image.get_array().shape[0] / 2
    corner = torch.tensor([[right - half[0], bottom + half[1], float(FLOOR.transmitter_position[:, 2].median())]])
    assert float(image.get_array()[0, -1]) == pytest.approx(float(maps.predict(corner).mean[0, 2]), abs=0.01)
    assert bar_of(ax).get_ylabel() == "predicted RSSI [dBm]"
    assert maps.predict(measured).plot(1).collections[0].get_array()[4] == maps.predict(measured[4:5]).mean[0, 1]


def test_a_posterior_draws_its_mass_and_credible_circle():
    posterior = Posterior(TWO, torch.tensor([[0.25, 0.75]], dtype=torch.float64).log(), resolution_m=0.4)
    ax = posterior.plot()
    assert ax.collections[0].get_array().tolist() == pytest.approx([0.25, 0.75])
    median, circle = ax.lines
    assert (median.get_label(), circle.get_label()) == ("median", "80 % circle")
    radius = (max(circle.get_xdata()) - min(circle.get_xdata())) / 2
    assert radius == pytest.approx(float(posterior.credible_radius()), rel=1e-2)


@pytest.mark.parametrize("is_shared", [True, False])
def test_a_posterior_is_summed_over_height(is_shared):
    at = torch.tensor([[[0.0, 0, 0], [0, 0, 1], [1, 0, 0], [1, 2, 0]]], dtype=torch.float64)
    weight = torch.tensor([[1.0, 0, 0, 0], [0.2, 0.2, 0.4, 0.2]], dtype=torch.float64)
    if not is_shared:
        at = torch.cat([at + 5, at])
    found = Posterior(at, weight.log(), resolution_m=0.3).in_plan(1)
    assert found.at(0, 0) == found.at(1, 0) == pytest.approx(1)
    assert found.at(1, 2) == pytest.approx(0.5)
    assert math.isnan(found.at(0.5, 1))  # far from all candidates
    assert found.at(0, 0.27) == pytest.approx(1)
    assert math.isnan(found.at(0, 9))
    assert (found.corners[0], found.corners[3]) == pytest.approx((-0.0125, 2.0125))


def test_texts_are_short_and_tables_escape_names():
    posterior = Posterior(TWO, torch.tensor([[0.25, 0.75]], dtype=torch.float64).log())
    objects = [ROOM, FLOOR, make_model("idw").fit(ROOM), fit_rssi(FLOOR), Prediction(torch.rand(9, 4)), posterior]
    for shown in objects:
        assert len(repr(shown).splitlines()) <= 2
        assert max(map(len, repr(shown).splitlines())) < 120
        assert f"<caption>{type(shown).__name__}</caption>" in shown._repr_html_()
    assert "<td>8 x 32</td>" in objects[2]._repr_html_()
    assert repr(Prediction(torch.tensor([1.0, 2.0]))) == (
        "<Prediction of shape (2,): mean 1 to 2,\n standard deviation none>"
    )
    html = Rssi([[-50.0]], [[0.0, 0, 0]], name="<script>")._repr_html_()
    assert "<script>" not in html
    assert "&lt;script&gt;" in html
    assert "<th>fitted</th><td>no</td>" in make_model("idw")._repr_html_()
