"""bench per-frame: its frames are a sequence for every verb, its figures are evaluate's, its gate is import's."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from pages import check_self_contained
from raising import refused
from verbs import by_options

from densify.bench import per_frame
from densify.bench.per_frame import judged, read_colon, tables, write_colon
from densify.bench.spoilt import Gate, SpoiltFrame, spoilt_frames, spoilt_tables
from densify.commands import bench
from densify.commands.evaluate import evaluate
from lightdepth.checkpoint import load_model
from lightdepth.commands.predict import predict
from lightdepth.judge_colons import JudgeColon, judge_frames
from lightdepth.judge_colons.colons import JudgeFrame
from lightdepth.judge_colons.corruption import CORRUPTIONS

COLONS = (
    JudgeColon("weak", 901, 0.2, "even", "plain", 2.2, (40, 32), frames=3),
    JudgeColon("strong", 902, 0.8, "bright", "fisheye", 1.0, (40, 32), frames=3),
)


@cache
def rendered() -> list[JudgeFrame]:
    return judge_frames(COLONS[0], quality=2)


def made(colon: JudgeColon, progress: object = None) -> list[JudgeFrame]:
    """One colon's frames for both: rendering takes seconds."""
    return rendered()


@pytest.fixture(scope="module", autouse=True)
def small():
    """Two colons of three small frames in place of the twelve, rendered once."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bench, "JUDGE_COLONS", COLONS)
        patch.setattr(per_frame, "judge_frames", made)
        yield


@pytest.fixture(scope="module")
def run(small, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("per-frame") / "run"
    bench.compare_per_frame(folder, bench.ModelSources(("constant",)), spoilt=True)
    return folder


def test_a_run_says_its_tables_and_the_next_takes_its_colons(run, tmp_path):
    found = json.loads((run / "per-frame.json").read_text(encoding="utf-8"))
    assert [(row["colon"], row["model"]) for row in found["rows"]] == [
        (colon.name, model) for colon in COLONS for model in ("decline", "constant")
    ]
    assert len(found["spoilt"]) == 2 * 1 * 6 * 5 * 2  # colons, frames of three, corruptions, severities, models
    text = (run / "per-frame.md").read_text(encoding="utf-8")
    assert "strong bounce" in text and "weak bounce" in text and "water drops" in text
    assert (run / "colons.png").stat().st_size > 1000
    page = check_self_contained(run / "report.html")
    assert page.tags.count("img") == 1
    bench.compare_per_frame(tmp_path / "again", bench.ModelSources(("constant",)), colons=run / "colons")
    again = json.loads((tmp_path / "again" / "per-frame.json").read_text(encoding="utf-8"))
    assert again["rows"] == found["rows"] and not (tmp_path / "again" / "colons").exists()


def test_evaluate_judges_a_colon_as_the_bench_does(run, tmp_path):
    by_options(predict)(run / "colons" / "weak", tmp_path / "found", checkpoint="decline", previews=False)
    by_options(evaluate)(tmp_path / "found", run / "colons" / "weak")
    metrics = json.loads((tmp_path / "found" / "evaluation" / "metrics.json").read_text(encoding="utf-8"))
    rows = json.loads((run / "per-frame.json").read_text(encoding="utf-8"))["rows"]
    assert metrics["mean"]["abs_rel_median"] == pytest.approx(rows[0]["errors"]["abs_rel"], rel=1e-6)


def test_colons_of_another_make_are_refused(tmp_path):
    write_colon(COLONS[0], tmp_path / "weak", lambda: None)
    file = tmp_path / "weak" / "colon.json"
    file.write_text(file.read_text(encoding="utf-8").replace("0.2", "0.3"), encoding="utf-8")
    with refused(found="weak"):
        read_colon(COLONS[0], tmp_path / "weak")


def test_a_colon_that_is_read_is_what_was_made(tmp_path):
    write_colon(COLONS[1], tmp_path / "strong", lambda: None)
    frames = read_colon(COLONS[1], tmp_path / "strong")
    for one, read in zip(made(COLONS[1]), frames, strict=True):
        assert np.array_equal(one.frame.valid, read.valid) and one.frame.light == read.light
        np.testing.assert_allclose(read.image, one.frame.image, atol=0.6 / 255)
        np.testing.assert_allclose(read.true_distance, one.frame.true_distance)


def test_tables_count_the_colons_below_the_closed_form_and_below_the_bars():
    rows = [
        per_frame.ColonFigures(f"{i}", model, True, dict.fromkeys(per_frame.ERRORS, error), 1.0, None)
        for i in range(4)
        for model, error in (("decline", 1.0), ("mine", 0.5 + 0.2 * i))
    ]
    mine = tables(rows)[0].rows[1]
    assert mine[3] == "3, 2 of 4" and mine[6] == "3, 3 of 4" and mine[2] == pytest.approx(0.8)


def test_the_gate_refuses_what_is_blurred_beside_its_neighbours_and_keeps_the_frames_as_they_were():
    frames = [one.frame for one in made(COLONS[0])]
    gate = Gate(frames)
    kept = [gate.keeps(row, frame) for row, frame in enumerate(frames)]
    smooth = [replace(frame, image=cv2.GaussianBlur(frame.image, (0, 0), 4)) for frame in frames]
    blurred = [gate.keeps(row, frame) for row, frame in enumerate(smooth)]
    assert any(kept) and not any(blurred)


def test_spoilt_frames_are_the_same_twice_and_their_table_has_each_corruption(run):
    colon = COLONS[0]
    model, frames = [load_model("decline", details=False)], read_colon(colon, run / "colons" / colon.name)
    found = json.loads((run / "per-frame.json").read_text(encoding="utf-8"))["spoilt"]
    first = [SpoiltFrame(**row) for row in found if (row["colon"], row["model"]) == (colon.name, "decline")]
    assert spoilt_frames(colon, frames, model) == first
    matching, depth = spoilt_tables(first)
    assert [row[0] for row in matching.rows] == [row[0] for row in depth.rows] == list(CORRUPTIONS)
    assert "matching" in matching.title and "depth" in depth.title


def test_the_tables_of_spoilt_frames_count_what_each_gate_keeps_and_how_often_it_was_right():
    rows = [
        SpoiltFrame("c", "mine", "smoke", 1, kept=False, doubted=i == 0, clean=0.1, error=0.3 if i == 0 else 0.14)
        for i in range(4)
    ] + [SpoiltFrame("c", "mine", c, s, True, False, 0.1, 0.1) for c in CORRUPTIONS for s in (1, 2, 3, 4, 5)]
    matching, depth = (table.rows[CORRUPTIONS.index("smoke")][1] for table in spoilt_tables(rows))
    assert matching == "1.00, 20%, 25%" and depth == "1.30, 80%, 100%"


def test_every_model_gets_a_row_for_a_colon():
    frames = [one.frame for one in made(COLONS[0])]
    found = judged(COLONS[0], frames, [load_model("decline", details=False), load_model("constant")])
    assert [row.model for row in found] == ["decline", "constant"] and not found[0].strong
    assert all(0 < row.share_of_truth <= 1 and row.coverage is None for row in found)
