"""The pages of training and of evaluations: the verdict first, then what can be looked at."""

from __future__ import annotations

import numpy as np
import pytest
from pages import check_self_contained
from test_scene import grid, scene_in

from densify.evaluation.page import evaluation_page
from densify.evaluation.records import ErrorMesh, Evaluation
from lightdepth.reporting.report import Report
from train.commands.train import train
from train.report import verdict

TINY = ["--preset", "tube_smoke", "--trainer.max_steps", "4", "--trainer.val_check_interval", "2"]
TINY += ["--data.tube.scenes", "1", "--data.tube.val_scenes", "1", "--data.tube.frames", "3", "--data.num_workers", "0"]
TINY += ["--data.size", "[40, 32]", "--data.batch_size", "2"]


def test_the_verdict_on_a_network_is_by_the_closed_form_where_there_is_truth():
    errors = {"loss": 0.3, "abs_rel_median": 0.1, "closed_form/abs_rel_median": 0.2}
    assert "is better than the closed form" in verdict(errors) and "0.1 against 0.2" in verdict(errors)
    assert "no better than" in verdict({**errors, "abs_rel_median": 0.2})
    assert "no truth: their loss, 0.3," in verdict({"loss": 0.3})


def test_a_verdict_on_frames_that_chose_the_checkpoint_says_so():
    errors = {"loss": 0.3, "abs_rel_median": 0.1, "closed_form/abs_rel_median": 0.2}
    said = "These frames also chose the checkpoint, the one with their least photometric"
    assert said in verdict(errors, "photometric") and said in verdict({"loss": 0.3}, "photometric")
    assert "chose" not in verdict(errors)


def test_a_training_leaves_a_page_with_the_verdict_figures_and_frames(tmp_path):
    assert train(["-o", str(tmp_path / "run"), *TINY]) == 0
    page = check_self_contained(tmp_path / "run" / "report.html")
    text = (tmp_path / "run" / "report.html").read_text()
    assert text.index("closed form, which needs no training") < text.index("On the validation frames")
    chosen = "These frames also chose the checkpoint, the one with their least loss"
    assert chosen in text and chosen in (tmp_path / "run" / "model.md").read_text()
    assert len(page.pictures) == 2 * 6 + 1  # a batch of frames, and the decline of light on them
    for label in ("image", "rendered", "distance", "closed form", "truth", "off the truth"):
        assert text.count(f"<figcaption>{label}</figcaption>") == 2
    assert {"model.safetensors", "model.md", "checkpoints/last.ckpt", "run.json"} <= set(page.links)


@pytest.mark.parametrize("count", [1, 2])
def test_an_evaluation_has_a_scene_of_its_surfaces_coloured_by_their_errors(tmp_path, monkeypatch, count):
    monkeypatch.setattr("densify.evaluation.page.short_tables", lambda *_: [])
    monkeypatch.setattr("densify.evaluation.page.tables_of", lambda *_: [])
    monkeypatch.setattr("densify.evaluation.page.notes_of", lambda *_: [])
    monkeypatch.setattr("densify.evaluation.page.not_judged", lambda *_: [])
    vertices, triangles = grid(9)
    off = np.linspace(0, 5, len(vertices))
    meshes = [ErrorMesh(f"map_{i:03d}", vertices, triangles, off) for i in range(count)]
    found = Evaluation(judged=None, curves={}, meshes=meshes)
    page: Report = evaluation_page({"seq": found}, tmp_path)
    page.write(tmp_path / "report.html")
    text = (tmp_path / "report.html").read_text()
    told = scene_in(text)["surfaces"]
    assert [s["title"] for s in told] == [m.name for m in meshes]
    assert [layer["title"] for layer in told[0]["layers"]] == ["Error", "Shape alone"]
    assert told[0]["layers"][0]["legend"][-1] == [1.0, "5 mm and more"]
    assert "What the figures mean" not in text  # nothing is said of none
