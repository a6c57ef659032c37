"""What the demo shows: a good surface, one that is wrong on purpose, and what is said of both."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest

from densify.demonstration import SIDE, Planted, closing_lines
from densify.evaluation.records import DistanceFigures, MapFigures, SurfaceFigures
from densify.judging.verdict import GREEN, RED, Verdict
from lightdepth.cli import main
from lightdepth.tube import lens, render_sequence
from lightdepth.tube.slam import SlamConfig, simulate_slam


@pytest.fixture(scope="module")
def slam():
    frames = render_sequence(3, 8, lens("pinhole", 96, 80), 6.0).frames
    return simulate_slam(frames, SlamConfig("independent", keyframe_every=1), 3).map


def figures(map_id: int, error_mm: float) -> MapFigures:
    distances = DistanceFigures(error_mm, error_mm, error_mm)
    shares = {"2mm": 1.0}
    of = SurfaceFigures(9, error_mm, error_mm / 2, error_mm, None, distances, shares, shares, shares, error_mm)
    return MapFigures(map_id, 4, clouds={"dense": of})


def test_one_side_of_the_first_submap_alone_is_moved_away_from_its_cameras(slam):
    planted = Planted.of(slam, 1.4, seed=3)
    first, second = planted.map.submaps
    moved = (first.points != slam.submaps[0].points).any(1)
    assert moved.mean() == pytest.approx(SIDE, abs=0.01) and second is slam.submaps[1]
    assert set(first.point_ids[moved]) == set(planted.moved[0]) and len(planted.moved[1]) == 0
    center = np.mean([k.center for k in first.keyframes], axis=0)
    before, after = (np.linalg.norm(s.points[moved] - center, axis=1) for s in (slam.submaps[0], first))
    assert np.median(after / before) == pytest.approx(1.4, rel=0.05)
    assert "50% of its points" in planted.sentence and planted.record()["points_moved"] == moved.sum()


def test_a_factor_of_one_leaves_the_map_right_and_says_nothing(slam):
    planted = Planted.of(slam, 1.0, seed=3)
    assert planted.sentence == "" and np.array_equal(planted.map.submaps[0].points, slam.submaps[0].points)


@pytest.mark.parametrize(
    ("colours", "errors", "ending"),
    [
        (("amber", "green"), (2.0, 0.5), ": the worse colour went to the worse surface"),
        (("red", "green"), (0.5, 2.0), ": the worse colour went to the better surface"),
        (("green", "green"), (2.0, 0.5), ": the colours do not tell which is worse"),
    ],
)
def test_two_lines_give_the_verdicts_and_why_and_the_third_holds_them_against_the_truth(slam, colours, errors, ending):
    planted = Planted.of(slam, 1.4, seed=3)
    verdicts = {i: Verdict(colour, f"reason {i}") for i, colour in enumerate(colours)}
    first, second, third = closing_lines(planted, verdicts, [figures(i, e) for i, e in enumerate(errors)])
    assert first == f"map 0 ({planted.sentence}): {colours[0]}: reason 0"
    assert second == f"map 1: {colours[1]}: reason 1"
    assert f"map 0 is {errors[0] / 2:.2f} mm from the wall" in third and third.endswith(ending)


def test_a_surface_without_figures_is_compared_with_none(slam):
    planted = Planted.of(slam, 1.4, seed=3)
    assert closing_lines(planted, {0: None}, [MapFigures(0, 4)])[-1].endswith("(it has no surface)")
    (first, last) = closing_lines(planted, {1: None}, [figures(1, 2.0), MapFigures(0, 4, error="no poses")])
    assert first == "map 1: not judged" and last.endswith("RMS 2.00 mm; map 0 cannot be compared (no poses)")


def test_the_demo_ends_with_three_lines_of_verdict_and_the_report_that_begins_with_them(tmp_path, capsys):
    argv = ["--frames", "8", "--size", "[96, 80]", "--lens", "pinhole", "--checkpoint", "decline", "--seed", "3"]
    assert main(["demo", "-o", str(tmp_path / "demo"), *argv]) == 0
    *_, first, second, third, following, written = capsys.readouterr().out.splitlines()
    assert first.startswith("map 0 (made wrong on purpose: ") and second.startswith("map 1: ")
    assert third.startswith("truth, which no verdict saw: map 0 ") and "; map 1 is " in third
    assert following == f"next: lightdepth view {tmp_path / 'demo'}"
    assert written.endswith(f"open {tmp_path / 'demo' / 'report.html'}")
    record = json.loads((tmp_path / "demo" / "run.json").read_text())
    assert record["in_short"] == [first, second, third] and record["planted"]["map"] == 0
    page = (tmp_path / "demo" / "report.html").read_text()
    assert page.index("<p>map 0 (made wrong") < page.index("<p>map 1: ") < page.index("<h2>")
    truth = json.loads((tmp_path / "demo" / "data" / "truth" / "slam.json").read_text())
    assert len(truth["0"]["moved_point_ids"]) == record["planted"]["points_moved"] > 0
    assert truth["1"]["moved_point_ids"] == []


@pytest.mark.slow
def test_the_program_itself_finds_the_demo_s_first_submap_doubtful_and_the_second_good(tmp_path):
    assert main(["demo", "-o", str(tmp_path / "demo")]) == 0
    bad, good = json.loads((tmp_path / "demo" / "run.json").read_text())["maps"]
    assert (bad["verdict"]["colour"], good["verdict"]["colour"]) == ("amber", "green")
    (off,) = re.findall(r"the images put the wall (\d+\.\d)% of its distance", bad["verdict"]["sentence"])
    assert 100 * GREEN + 1 < float(off) < 100 * RED - 2  # amber by more than other machines round
    assert bad["aligned"] == bad["keyframes"]  # what is wrong is seen by the images alone, and not by any keyframe
