"""The page of a report: what it holds, where its figures and their numbers lie, light and dark."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib.text import Text
from pandas import DataFrame

from swiftwrf import AngularGrid
from tasks import labels
from tasks.aoa.page.records import CHOSEN, LOWER_REFERENCE, UPPER_REFERENCE
from tasks.page import figures
from tasks.page.page import Number, Page, Plot, Section, Summary, Table, write_page
from tasks.page.palette import Palette
from tasks.page.polar import spectra
from tasks.records import read_table


def plot(name: str = "line", width: float = 6.0) -> Plot:
    figure, axes = figures.new_figure(1, 1, width, 2)
    axes[0].plot([0, 1], [1, 2], color=figures.RULE)
    axes[0].set(xlabel="x <m>")
    return Plot(name, [figure], "A line.", DataFrame({"x": [0, 1], "method": ["=a", "b"]}))


def page(*sections: Section, first: Plot | None = None) -> Page:
    numbers = [Number("1 dB", "of <something>")]
    return Page("A & B", Summary(numbers, [first or plot("first")], ["What."], ["Next."]), list(sections))


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
    write_page(
        tmp_path, page(Section("<One>", ["a < b"], terms={"<name>": "<meaning>"}), Section("Two", plots=[plot()]))
    )
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


def test_what_is_wide_takes_the_whole_page():
    assert plot(width=12).wide
    assert not plot(width=6).wide
    assert not Table(["a", "b"], [["x", "y"]]).wide
    assert Table(["a", "b"], [["x" * 60, "y" * 60]]).wide
    assert Table(["a", "b"], [["x", "y"]], long=True).wide


def test_curves_of_a_panel_differ_by_dashes_and_have_their_names_at_their_ends():
    figure, axes = figures.panel(4, 3)
    values = np.linspace(0, 1, 50)
    figures.cdf(axes, Palette(), {name: factor * values for factor, name in enumerate("abcd", 1)}, "error", limit=4)
    lines = axes.get_lines()[:4]
    assert len({str(line._dash_pattern) + str(line.get_linestyle()) for line in lines}) == 4
    figure.draw_without_rendering()
    boxes = {text.get_text(): Text.get_window_extent(text) for text in axes.texts}  # without their arrows
    assert set(boxes) == set("abcd")
    assert not any(boxes[a].overlaps(boxes[b]) for a in boxes for b in boxes if a < b)
    with pytest.raises(ValueError, match="at most 4 curves"):
        figures.cdf(axes, Palette(), dict.fromkeys("abcde", values), "error")


def luminance(colour):
    """Relative luminance of a colour `#rrggbb` (WCAG 2)."""
    channels = np.array([int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)])
    linear = np.where(channels <= 0.04045, channels / 12.92, ((channels + 0.055) / 1.055) ** 2.4)
    return float(linear @ (0.2126, 0.7152, 0.0722))


def test_every_colour_of_a_curve_stands_out_in_light_and_dark():
    template = (Path(figures.__file__).parent / "template.html").read_text()
    papers = ["#ffffff" if paper == "#fff" else paper for paper in re.findall(r"--paper: (#\w+)", template)]
    assert len(set(papers)) == 2
    tables = (labels.FIELD_MODELS, labels.ESTIMATORS, labels.PREDICTORS, labels.LOCALIZERS)
    colours = {label.colour for table in tables for label in table.values() if label.colour}
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
