"""The page of a report: what it holds, where its figures and their numbers lie, light and dark."""

import ast
import base64
import io
import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from matplotlib import colormaps
from matplotlib.colors import to_rgb
from pandas import DataFrame
from PIL import Image

from swiftwrf import AngularGrid, Rssi, Spectra, plotting
from swiftwrf.contrib.diagnostics.inspection import Findings
from swiftwrf.positions import inside
from tasks import labels
from tasks.aoa.records import CHOSEN, LOWER_REFERENCE, UPPER_REFERENCE
from tasks.aoa.synthesis import SCALES, spectra
from tasks.configs import InspectConfig
from tasks.inspect import page as inspection
from tasks.locate.page import posteriors
from tasks.page import figures
from tasks.page.maps import colour_image
from tasks.page.page import Number, Page, Plot, Section, Summary, rendered, write_page
from tasks.page.shared import again
from tasks.records import read_table
from tasks.terminal import NextStep


def plot(name: str = "line", width: float = 6.0) -> Plot:
    figure, axes = figures.panel(width, 2)
    axes.plot([0, 1], [1, 2], color=figures.RULE)
    axes.set(xlabel="x <m>")
    return Plot(name, [figure], "A line.", DataFrame({"x": [0, 1], "method": ["=a", "b"]}))


def page(*sections: Section, first: Plot | None = None) -> Page:
    numbers = [Number("1 dB", "of <something>")]
    return Page(
        "A & B",
        Summary(numbers, [first or plot("first")], ["What."], [NextStep("Next", "swiftwrf view 'a b'")]),
        list(sections),
    )


def test_every_figure_lies_in_the_page_and_as_a_file_with_its_numbers(tmp_path):
    write_page(tmp_path, page(Section("One", plots=[plot()])))
    html = (tmp_path / "report.html").read_text()
    links = re.findall(r'href="(figures/[^"]+)"', html)
    assert set(links) == {f"figures/{name}.{kind}" for name in ("first", "line") for kind in ("csv", "svg")}
    assert all((tmp_path / link).is_file() for link in links)
    assert html.count("<svg") == 2
    assert read_table(tmp_path / "figures" / "line.csv")["method"].tolist() == ["=a", "b"]
    assert "'=a" in (tmp_path / "figures" / "line.csv").read_text()  # no formula


def test_text_is_escaped_and_identifiers_are_unique(tmp_path):
    one = Section("<One>", ["a < b"], terms={"<name>": "<meaning>"})
    write_page(tmp_path, page(one, Section("Two", plots=[plot()])))
    html = (tmp_path / "report.html").read_text()
    assert "A &amp; B" in html
    assert "of &lt;something&gt;" in html
    assert "<name>" not in html
    identifiers = re.findall(r' id="([^"]+)"', html)
    assert len(identifiers) == len(set(identifiers))


def test_figures_take_the_colours_of_the_page(tmp_path):
    """Black text would not be seen on a dark page; in the files, which stand alone, colours stay as drawn."""
    write_page(tmp_path, page())
    html, file = (tmp_path / "report.html").read_text(), (tmp_path / "figures" / "first.svg").read_text()
    drawn = html[html.index("<svg") :]
    assert "prefers-color-scheme: dark" in html
    assert "currentColor" in drawn
    for colour in figures.THEMED:
        assert colour not in drawn
        assert colour in file
    assert figures.RULE in drawn


def test_curves_of_a_panel_differ_by_dashes_and_have_their_names_below():
    figure, axes = figures.panel(4, 3)
    values, names = np.linspace(0, 1, 50), ["network, measured", "peak", "mean", "gp"]
    figures.cdf(axes, {}, {name: factor * values for factor, name in enumerate(names, 1)}, "error", limit=4)
    assert len({str(line._dash_pattern) + str(line.get_linestyle()) for line in axes.get_lines()[:4]}) == 4
    assert [text.get_text() for text in figure.legends[0].get_texts()] == names
    with pytest.raises(ValueError, match="at most 4 curves"):
        figures.cdf(axes, {}, dict.fromkeys("abcde", values), "error")


@pytest.mark.parametrize("command", ["swiftwrf rssi --out 'a b' --rx 1", "swiftwrf rssi --rx 1 --split=random --json"])
def test_a_run_is_repeated_on_another_split_into_a_new_directory(command):
    run = SimpleNamespace(config={"command": command})
    assert again(run, "Again", "block").code == "swiftwrf rssi --rx 1 --split block"


def luminance(colour):
    """Relative luminance of a colour `#rrggbb` (WCAG 2)."""
    channels = np.array([int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)])
    linear = np.where(channels <= 0.04045, channels / 12.92, ((channels + 0.055) / 1.055) ** 2.4)
    return float(linear @ (0.2126, 0.7152, 0.0722))


def test_every_colour_of_a_curve_stands_out_in_light_and_dark():
    template = (Path(figures.__file__).parent / "template.html").read_text()
    papers = ["#ffffff" if paper == "#fff" else paper for paper in re.findall(r"--paper: (#\w+)", template)]
    assert len(set(papers)) == 2
    tables = (labels.colours(labels.FIELD_MODELS), labels.ESTIMATORS, labels.PREDICTORS, labels.LOCALIZERS)
    colours = {colour for table in tables for colour in table.values()}
    colours |= {*labels.OTHER_COLOURS, figures.RULE, LOWER_REFERENCE, UPPER_REFERENCE, CHOSEN}
    for colour in colours:
        for paper in papers:
            high, low = sorted((luminance(colour), luminance(paper)), reverse=True)
            assert (high + 0.05) / (low + 0.05) >= 3, (colour, paper)


def test_two_figures_of_one_name_are_refused(tmp_path):
    with pytest.raises(ValueError, match="same"):
        write_page(tmp_path, page(Section("", plots=[plot("same"), plot("same")])))


def test_pixels_of_a_spectrum_lie_at_their_directions():
    """The ring of the peak is at the true direction of a spectrum that has its peak there."""
    grid = AngularGrid.hemisphere(15, 60)
    image = torch.zeros(grid.shape)
    image[9, 15] = 1
    azimuth, elevation = grid.peak_direction(image[None])[0].rad2deg().tolist()
    (axes, *_) = spectra({"measured": image.numpy()}, "", (azimuth, elevation)).axes
    ring, cross = (
        {tuple(np.round(line.get_xydata()[0], 6)) for line in axes.lines if line.get_marker() == m} for m in "ox"
    )
    assert ring == cross
    (mesh,) = axes.collections
    corner = mesh.get_coordinates()  # (rows + 1, columns + 1, 2)
    centre = corner[9:11, 15:17].mean(axis=(0, 1))
    np.testing.assert_allclose(centre, next(iter(ring)), atol=1e-5)


@pytest.mark.parametrize("values", [[], [0.0], [0.0] * 9, [0.2, 0.1 + 0.1, 0.3 - 0.1, 0.2], [-3.0] * 2], ids=len)
def test_figures_of_constant_empty_and_single_values(values):
    values, n = np.array(values), len(values)
    position = torch.tensor(np.outer(np.arange(n), [0.2, 0.0, 0.0])) + torch.tensor([0.0, 0.0, 1.0])  # a regular grid
    drawn = []
    for draw in (
        lambda axes: figures.cdf(axes, {}, {"a": values}, "error"),
        lambda axes: figures.curves(axes, {}, {"a": (values, values)}, "x", "y"),
        lambda axes: plotting.plan(position, torch.tensor(values), "value", axes),
        lambda axes: plotting.plan_map((0, 1, 0, 1), values[None] if n else np.zeros((1, 1)), "v", axes),
    ):
        figure, axes = figures.panel(4, 3)
        draw(axes)
        drawn.append(figure)
    rows = [str(i) for i in range(n)]
    drawn += [figures.dots(rows, {"a": [(x, x, x) for x in values]}, {}, "v", log=log) for log in (False, True)]
    drawn.append(figures.dots(["a", "b"], {"one": [(2.0, 1.0, 3.0), (None,) * 3]}, {}, "v", log=True))  # b has no rows
    drawn.append(spectra(dict.fromkeys(SCALES, np.full((9, 36), values.mean() if n else 0.0)), "constant"))
    drawn.append(plotting.polar_spectrum(torch.zeros(9, 36), AngularGrid.hemisphere(9, 36)).figure)
    if n in (1, 9):  # data sets have at least one row
        room = Spectra(torch.full((n, 9, 36), 0.5), position, grid=AngularGrid.hemisphere(9, 36))
        rssi = Rssi(torch.full((n, 1), -60.0), position, receiver_position=position[:1])
        for data in (room, rssi):
            found = inspection(Findings(data), "toys", InspectConfig("source"))
            drawn += [panel for plot in [*found.summary.plots, *found.sections[1].plots] for panel in plot.panels]
        colour_image(values[None], "viridis", values.min(), values.max())
    assert all(figures.as_svg(figure).endswith("</svg>\n") for figure in drawn)


def test_labels_of_a_plan_with_equal_scales_lie_inside_the_figure():
    figure, plan = figures.panel(5.4, 4.2)
    dots = plan.scatter([7348, 8348], [-7348, -6439], c=[0, 1])
    plan.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    figures.colour_bar(plan, dots, "position error [m]", extend="max")
    figures.as_svg(figure)
    assert plan.get_tightbbox().x0 >= 0
    assert figure.axes[1].get_tightbbox().x1 <= figure.bbox.width


def test_aligned_panels_are_drawn_as_each_alone():
    def drawn():
        for title, factor in (("first", 1), ("second", 2)):
            figure, axes = figures.panel(3.6, 3)
            image = axes.imshow(factor * np.arange(12.0).reshape(3, 4), vmin=0, vmax=24)
            axes.set(title=title, xlabel="x [m]", ylabel="y [m]")
            figures.colour_bar(axes, image, "value")
            yield figure

    aligned = list(drawn())
    figures.align(aligned)
    assert [figures.as_svg(figure) for figure in aligned] == [figures.as_svg(figure) for figure in drawn()]


@pytest.mark.parametrize("repeats", [1, 3])
def test_between_positions_on_a_line_is_inside_however_often_each_was_measured(repeats):
    known = np.repeat([[0.0, 0.0], [1.0, 1.0], [2.0, 2.0]], repeats, axis=0)
    assert inside([[0.5, 0.5], [1.4, 1.4], [9.0, 9.0]], known).tolist() == [True, True, False]


def test_a_cell_of_a_posterior_is_drawn_around_its_centre():
    x, y = np.array([0.5, 1.5, 2.5]), np.array([0.5, 1.5])
    places = {"truth": np.zeros((1, 3)), "estimate": np.zeros((1, 3)), "training_position": np.zeros((1, 3))}
    maps = {"x": x, "y": y, "density": np.ones((1, 2, 3)), "radius_80_m": np.ones(1), "index": np.array([17])} | places
    (figure,) = posteriors(maps)
    assert figure.axes[0].images[0].get_extent() == [0, 3, 0, 2]
    assert figure.axes[0].get_title().startswith("row 17:")  # the index of the tables, counted from 0


def test_tasks_read_files_by_the_guarded_readers():
    """Ruff bans readers of libraries; `open` and methods of paths are found here."""
    allowed = {"records.py", "parsing.py", "environment.py", "workers.py", "lines.py", "record.py"}
    allowed |= {"command.py", "command_line.py", "terminal.py"}  # os.open of nothing, a page in the browser
    for file in (Path(__file__).parents[2] / "tasks").rglob("*.py"):
        calls = {node.func for node in ast.walk(ast.parse(file.read_text())) if isinstance(node, ast.Call)}
        named = {ast.unparse(call) for call in calls}
        wrong = {name for name in named if re.search(r"(^|\.)(open|read_text|read_bytes)$", name)} - {"Image.open"}
        assert file.name in allowed or not wrong - {"read_text"}, f"{file}: {wrong}"


def test_names_in_scripts_that_the_font_lacks_give_no_warning(recwarn):
    figure, axes = figures.panel(3, 2)
    axes.set_title("\u90e8\u5c4b")
    assert figures.as_svg(figure).endswith("</svg>\n")
    assert not recwarn.list


def test_pictures_of_figures_have_256_colours_and_paths_tenths_of_a_point():
    """A report of three floors and 20 receivers is 4.5 MB, and not 8.3."""
    values = np.add.outer(np.linspace(0, 1, 90), np.linspace(0, 1, 120))
    figure, axes = figures.panel(4, 3)
    axes.imshow(values, interpolation="none", cmap="viridis")
    axes.plot([1 / 3, 100 / 3], [1 / 7, 50 / 7])
    svg = figures.as_svg(figure)
    (picture,) = re.findall(r'data:image/png;base64,([^"]+)"', svg)
    with Image.open(io.BytesIO(base64.b64decode(picture))) as image:
        assert image.mode == "P"
        pixels = np.asarray(image.convert("RGB")).astype(float)
    expected = 255 * colormaps["viridis"](values / values.max())[:, :, :3]
    assert min(np.abs(pixels - each).mean() for each in (expected, expected[::-1])) < 8
    numbers = [number for path in re.findall(r' d="([^"]+)"', svg) for number in re.findall(r"\.(\d+)", path)]
    assert numbers
    assert max(map(len, numbers)) == 1


def test_the_first_figure_stands_before_notes_which_are_folded(tmp_path):
    summary = Summary(
        [Number("1 dB", "error")], [plot()], ["The answer.", "How sure."], [], notes=["A note.", "Another."]
    )
    html, _ = rendered(Page("Title", summary, []))
    order = [
        html.index(text)
        for text in ("The answer.", "<figure", "<b>1 dB", "How sure.", "<details><summary>Notes", "A note.")
    ]
    assert order == sorted(order)
    assert "Notes on the data (2)" in html


# linear RGB as seen without one kind of cone (G. M. Machado et al., IEEE TVCG 15, 2009)
VISION = {
    "all cones": np.eye(3),
    "protanopia": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
    "deuteranopia": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]],
    "tritanopia": [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]],
}


def lab(linear):
    """CIE Lab of linear sRGB, under D65."""
    to_xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
    t = to_xyz @ linear / (0.9505, 1.0, 1.089)
    x, y, z = np.where(t > 0.008856, np.cbrt(t), 7.787 * t + 16 / 116)
    return np.array([116 * y - 16, 500 * (x - y), 200 * (y - z)])


@pytest.mark.parametrize("vision", VISION)
def test_classes_of_coverage_differ_for_every_kind_of_colour_vision(vision):
    """A difference of 2.3 is just noticeable; the page is light or dark."""
    colours = {name: np.array(to_rgb(colour)) for name, colour in labels.COVERAGE.items()}
    colours |= {"light page": np.ones(3), "dark page": np.array(to_rgb("#14181f"))}
    seen = []
    for rgb in colours.values():
        linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
        seen.append(lab(np.clip(np.array(VISION[vision]) @ linear, 0, 1)))
    differences = [np.linalg.norm(a - b) for number, a in enumerate(seen) for b in seen[:number]]
    assert min(differences) > 25
