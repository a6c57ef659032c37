"""The report is one file that needs nothing from anywhere, and says what went wrong."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from colons import colon, sequence, slam, truth
from pages import References, check_self_contained

from densify.config import DensifyConfig
from densify.evaluation.records import AlignedFigures, DistanceFigures, MapFigures, SurfaceFigures
from densify.judging.withheld import Withheld
from densify.page import Gallery, densify_page
from densify.pipeline import densify
from lightdepth.reporting.figures import BAD, GOOD, chart, chart_png, png
from lightdepth.reporting.report import Report, Tile, number

PIXEL = png(np.zeros((1, 1, 3), np.uint8))


def test_a_page_has_its_parts_in_order_and_loads_nothing(tmp_path):
    page = Report("Title & more")
    page.heading("First")
    page.text("a < b")
    page.table(["what", "mm"], [["sparse", 1.23456], ["dense", None]])
    page.figures([(PIXEL, 'a "caption"'), (PIXEL, "another")])
    page.write(tmp_path / "report.html")
    text = (tmp_path / "report.html").read_text()
    assert len(check_self_contained(tmp_path / "report.html").pictures) == 2
    parts = ["Title &amp; more</h1>", "First</h2>", "a &lt; b", "<table>", ">1.23<", ">–<", "a &quot;caption&quot;"]
    assert [text.index(p) for p in parts] == sorted(text.index(p) for p in parts)
    assert text.startswith("<!doctype html>") and [p.name for p in tmp_path.iterdir()] == ["report.html"]


def test_a_chart_is_light_on_dark_where_the_page_is_dark_and_an_image_stays_as_it_is(tmp_path):
    figure, axes = chart((2, 1))
    axes.plot([0, 1], [0, 1])
    page = Report("Charts")
    page.wide_figures([(chart_png(figure), "a chart"), (PIXEL, "an image")])
    page.write(tmp_path / "report.html")
    text = (tmp_path / "report.html").read_text()
    assert '<img class="chart" style="--drawn: 220px" alt="a chart"' in text and '<img alt="an image"' in text
    dark = text[text.index("prefers-color-scheme: dark") :]
    assert "img.chart { filter: invert(" in dark


def test_a_chart_of_many_panels_keeps_its_words_legible_on_a_phone_and_is_scrolled_there(tmp_path):
    page = Report("Charts")
    page.wide_figures([(chart_png(chart((10, 2))[0]), "broad"), (chart_png(chart((6.4, 2))[0]), "narrow")])
    page.write(tmp_path / "report.html")
    text = (tmp_path / "report.html").read_text()
    assert text.count('<div class="broad" role="group" tabindex="0"') == 1 and "--drawn: 1100px" in text
    assert "width: calc(.7 * var(--drawn))" in text[text.index("max-width: 600px") :]


def test_many_small_pictures_have_their_words_below_them_and_their_colour_around_them(tmp_path):
    page = Report("Frames")
    page.heading("Kept <and> left out")
    page.tiles([Tile(PIXEL, "000001", GOOD), Tile(PIXEL, "000002 <b>blur", BAD), Tile(PIXEL, "plain")], "Of & all", 110)
    page.write(tmp_path / "report.html")
    text = (tmp_path / "report.html").read_text()
    assert len(check_self_contained(tmp_path / "report.html").pictures) == 3
    assert f"--edge: rgb({', '.join(map(str, BAD))})" in text and text.count("--edge: rgb(") == 2
    for part in (
        "<figcaption>000002 &lt;b&gt;blur</figcaption>",
        "<figcaption>Of &amp; all</figcaption>",
        "--wide: 110px",
    ):
        assert part in text
    assert 'alt="plain, Kept &lt;and&gt; left out"' in text


def test_a_table_without_headers_has_no_empty_row_of_them(tmp_path):
    page = Report("Facts")
    page.table(["", ""], [["size", "320x256"]])
    page.write(tmp_path / "report.html")
    assert "<thead>" not in (tmp_path / "report.html").read_text()


def test_a_page_leads_to_the_files_beside_it_whatever_their_names(tmp_path):
    page = Report("Links")
    page.links([("a list & more.txt", "the <list>")])
    page.write(tmp_path / "report.html")
    assert (
        '<a href="a%20list%20%26%20more.txt">a list &amp; more.txt</a>: the &lt;list&gt;'
        in (tmp_path / "report.html").read_text()
    )


def test_what_comes_from_files_cannot_become_markup(tmp_path):
    page = Report("<script>alert(1)</script>")
    for add in (page.heading, page.text):
        add("<img src=http://x>")
    page.table(["<b>"], [["<i>"]])
    page.figures([(PIXEL, '"><script>')])
    page.write(tmp_path / "report.html")
    assert set(References((tmp_path / "report.html").read_text()).tags) <= {
        *(
            "html",
            "head",
            "meta",
            "title",
            "style",
            "body",
            "main",
            "h1",
            "h2",
            "p",
            "div",
            "figure",
            "figcaption",
            "img",
        ),
        *("table", "thead", "tbody", "tr", "th", "td"),
    }


@pytest.mark.parametrize(
    ("value", "text"),
    [(3, "3"), (1.23456, "1.23"), (0.000123456, "0.000123"), (12345.6, "12346"), (None, "–"), (float("nan"), "–")],
)
def test_numbers_are_shown_for_people(value, text):
    assert number(value) == text
    assert number(np.float64(value) if isinstance(value, float) else value) == text


@pytest.fixture(scope="module")
def made():
    frames = colon(0).frames[:4]
    found = slam(frames, maps=1).map
    gallery = Gallery(found)
    results = densify(sequence(frames), found, truth, DensifyConfig(), gallery)
    return results, gallery


def test_the_report_of_a_run_shows_surfaces_scales_points_and_agreement(made, tmp_path):
    results, gallery = made
    densify_page("Maps", results, gallery, ["a note"]).write(tmp_path / "report.html")
    text = (tmp_path / "report.html").read_text()
    page = check_self_contained(tmp_path / "report.html")
    assert len(page.pictures) == 1 + 6 + 1 + 3 * len(gallery.pictures[0]) >= 5
    for part in ("a note", "4 of 4", "Agreement", "hidden blocks", "constant, bent", "Scale of each keyframe", "Time"):
        assert part in text
    assert "Errors against the truth" not in text


def test_the_report_names_keyframes_that_were_left_out_and_maps_that_could_not_be_judged(made, tmp_path):
    (result,), gallery = made
    failed = replace(result.dense.alignments[1], reason="sigma is 50% of the median distance")
    dense = replace(result.dense, alignments=(result.dense.alignments[0], failed, *result.dense.alignments[2:]))
    distances = DistanceFigures(1.5, 0.7, 3.0)
    cloud = SurfaceFigures(9, 1.5, 0.7, 3.0, None, distances, {}, {}, {}, 0.9)
    first = MapFigures(0, 4, aligned=AlignedFigures(4, 0.12, None, 1.0, 1.0), clouds={"dense": cloud, "sparse": None})
    judged = [first, MapFigures(1, 2, "2 common poses")]
    page = densify_page("Maps", [replace(result, dense=dense, judgement=None)], gallery, [], judged)
    page.write(tmp_path / "report.html")
    text = (tmp_path / "report.html").read_text()
    assert "000001.png left out: sigma is 50% of the median distance" in text and "3 of 4" in text
    assert "Map 1 could not be evaluated: 2 common poses" in text and ">1.5<" in text
    assert "hidden blocks" not in text


def test_an_empty_surface_has_a_report_too(made, tmp_path):
    (result,), gallery = made
    empty = np.zeros((0, 3))
    alignments = tuple(replace(a, reason="no") for a in result.dense.alignments)
    dense = replace(result.dense, vertices=empty, triangles=empty.astype(int), colors=empty, alignments=alignments)
    densify_page("Maps", [replace(result, dense=dense)], gallery, []).write(tmp_path / "report.html")
    check_self_contained(tmp_path / "report.html")
    assert "0 of 4" in (tmp_path / "report.html").read_text()


def test_what_too_few_pixels_say_of_a_surface_is_told_as_that(made, tmp_path):
    (result,), gallery = made
    for pixels in (500, 20):
        judged = replace(result.judgement, surface=Withheld(pixels, 0.2, 0.3, 0.0, 0.2))
        densify_page("Maps", [replace(result, judgement=judged)], gallery, []).write(tmp_path / "report.html")
        text = (tmp_path / "report.html").read_text()
        assert ("(20 pixels, too few to judge by)" in text) == (pixels == 20)


def test_long_names_are_broken_where_the_page_ends(tmp_path):
    Report("x").write(tmp_path / "report.html")
    assert "overflow-wrap: anywhere" in (tmp_path / "report.html").read_text()
