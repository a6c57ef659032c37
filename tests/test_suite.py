"""A published comparison from one file: the paper's tables, on byte-true synthetic C3VD trees."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from colons import colon, slam
from raising import refused
from verbs import by_options

from densify.commands.evaluate import evaluate as evaluate_verb
from densify.evaluation.suite import present, read_suite
from densify.fusion.volume import FusionConfig
from densify.judging.config import JudgeConfig
from lightdepth.datasets import write_c3vd
from lightdepth.datasets.c3vd import C3VD
from lightdepth.datasets.splits import read_split
from lightdepth.errors import PartialFailure
from lightdepth.maps import write_multimap

evaluate = by_options(evaluate_verb)

ROOT = Path(__file__).parents[1]
SUITE = ROOT / "configs" / "bench" / "c3vd.yaml"
CAMERA = C3VD.resized(100, 80)


def test_the_suite_is_the_split_s_test_part_and_the_four_screenings():
    suite = read_suite(SUITE)
    short, screenings = suite.groups
    assert short == ("t2a", "t3a", "t4a", "c1a", "c2a", "c3a", "d4a", "s3a") and suite.surface_groups == [short]
    tested = {c.name for c in read_split(ROOT / "data" / "c3vd" / "splits" / "lightdepth.yaml").parts["test"]}
    assert {suite.folders[column] for column in short} == tested
    assert [suite.folders[column] for column in screenings] == [f"screening_t{i}" for i in (1, 2, 3, 4)]


def test_the_published_rows_agree_with_their_own_means_as_far_as_the_paper_s_do():
    suite = read_suite(SUITE)
    for row in ("# Frames (paper)", "KF time ms (paper)", "RMS ATE mm (paper)"):
        values = suite.trajectory[row]
        assert values[8] == pytest.approx(np.mean(values[:8]), rel=0.01)
        assert values[13] == pytest.approx(np.mean(values[9:13]), rel=0.01)
    for of in suite.surface.values():
        for values in of.values():
            assert values[8] == pytest.approx(np.mean(values[:8]), rel=0.02)
    frames, keyframes, times = (suite.trajectory[f"{n} (paper)"] for n in ("# Frames", "# KF", "KF time ms"))
    for n, k, ms in zip(frames, keyframes, times, strict=True):
        assert 1000 * n / suite.fps / k == pytest.approx(
            ms, rel=0.15
        )  # 50 frames a second, within rounding and averaging


@pytest.fixture(scope="module")
def trees(tmp_path_factory) -> tuple[Path, Path]:
    """C3VD trees of two short sequences and a screening (poses alone), and the SLAM's maps of each."""
    root = tmp_path_factory.mktemp("c3vd")
    for seed, name in ((0, "trans_t2_a_under_review"), (1, "cecum_t1_a"), (2, "screening_t1")):
        frames = [replace(f, name=f"{f.number:04d}_color") for f in colon(seed, 6, 8.0, CAMERA).frames]
        shown = frames if seed < 2 else [replace(f, true_distance=None) for f in frames]
        write_c3vd(shown, root / "C3VD" / name)
        export = slam(frames, seed, maps=1 + (seed == 2), spurious=0.2)
        write_multimap(export.map, root / "maps" / name.removesuffix("_under_review"))
    return root / "C3VD", root / "maps"


def rows_of(text: str, title: str) -> dict[tuple[str, ...], list[str]]:
    part = text[text.index(title) :].split("\n\n")[1]
    cells = [[c.strip() for c in line.split("|")[1:-1]] for line in part.splitlines()]
    words = 1 if title == "Table 1" else 2
    return {tuple(row[:words]): row[words:] for row in cells}


@pytest.mark.slow
def test_one_command_makes_the_maps_dense_and_lays_the_paper_s_rows_beside_ours(trees, tmp_path):
    data, maps = trees
    with pytest.raises(PartialFailure, match=r"9 parts failed, the first: t3a: trans_t3_a is not in"):
        evaluate(maps, data, tmp_path / "out", suite=SUITE, checkpoint="decline")
    out = tmp_path / "out"
    found = json.loads((out / "metrics.json").read_text())["sequences"]
    assert set(found) == {"t2a", "c1a", "Seq1"} and found["Seq1"]["kind"] == "trajectory"
    text = (out / "metrics.md").read_text()
    first, second = rows_of(text, "Table 1"), rows_of(text, "Table 2")
    assert first["Metrics",] == [*read_suite(SUITE).groups[0], "avg", "Seq1", "Seq2", "Seq3", "Seq4", "avg"]
    assert first["# Frames",][:4] == ["6", "–", "–", "6"] and first["# Submaps",][9] == "2"
    assert first["KF time ms",][0] == "20"  # 50 frames a second, every frame a keyframe
    assert first["RMS ATE mm (paper)",][8] == "0.45" and first["RMS ATE mm, Sim(3)",][8].endswith("(2 of 8)")
    assert second["Ours (paper)", "RMS Acc."][:3] == ["2.46", "4.39", "3.13"]
    dense, sparse = (second[name, "RMS Acc."] for name in ("Dense", "Sparse map"))
    assert float(dense[0]) < float(sparse[0]) and dense[1] == "–"
    assert (out / "t2a" / "map_000" / "mesh.ply").is_file() and (out / "t2a_map_000_error.ply").is_file()
    assert "| t2a, map 0 | constant distance |" in text
    assert all(line.count(" & ") == 14 for line in (out / "metrics.tex").read_text().splitlines() if "Frames" in line)


def test_runs_made_before_are_taken_as_they_are(trees, tmp_path):
    data, maps = trees
    shutil.copytree(maps / "cecum_t1_a", tmp_path / "runs" / "cecum_t1_a")
    with pytest.raises(PartialFailure, match=r"11 parts failed"):
        evaluate(tmp_path / "runs", data, tmp_path / "out", suite=SUITE)
    found = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert list(found["all"]) == ["sparse"]  # one sequence: its figures are the file's
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "<p>Not judged: t2a, " in page and ", Seq4; run.json has the reasons.</p>" in page


def one_sequence(trees: tuple[Path, Path], folder: Path) -> Path:
    """The maps of one sequence of the suite alone."""
    shutil.copytree(trees[1] / "cecum_t1_a", folder / "cecum_t1_a")
    return folder


def test_a_suite_takes_recipe_settings_and_light_as_densify_does(trees, tmp_path):
    maps = one_sequence(trees, tmp_path / "maps")
    given = {"suite": SUITE, "checkpoint": "decline", "judge": JudgeConfig(on=False)}
    figures = {}
    for name, more in {
        "near": {"recipe": "paper", "light": "gamma=1.2,mu=0", "fusion": FusionConfig(far=1.0)},
        "fitted": {"recipe": "full"},
    }.items():
        with pytest.raises(PartialFailure, match=r"11 parts failed"):
            evaluate(maps, trees[0], tmp_path / name, **given, **more)
        record = json.loads((tmp_path / name / "run.json").read_text())
        assert ("light_fits" in record) is (name == "fitted") and ("recipe" in record) is (name != "fitted")
        metrics = json.loads((tmp_path / name / "metrics.json").read_text())
        assert f"by decline, recipe {more['recipe']}" in metrics["made_dense"]
        assert metrics["made_dense"] in (tmp_path / name / "metrics.md").read_text()
        figures[name] = metrics["all"]["dense"]
    assert record["light_fits"]["c1a"]["summary"].startswith("fitted on the map")
    assert figures["near"]["points"] < figures["fitted"]["points"]


def test_settings_of_what_makes_maps_dense_are_refused_where_nothing_does(trees, tmp_path):
    maps = one_sequence(trees, tmp_path / "maps")
    for more in ({"recipe": "paper"}, {"light": "gamma=2.2,mu=0"}, {"fit_light": False}):
        with refused(cure="--checkpoint"):
            evaluate(maps, trees[0], tmp_path / "out", suite=SUITE, **more)


def changed(path: Path, **changes) -> Path:
    data = yaml.safe_load(SUITE.read_text())
    path.write_text(yaml.safe_dump({**data, **changes}, sort_keys=False, allow_unicode=True))
    return path


def test_a_suite_that_contradicts_itself_is_refused(trees, tmp_path):
    data, maps = trees
    path = tmp_path / "suite.yaml"
    groups = [{"title": "one", "sequences": {"a": "x", "b": "y"}}]
    cases = {
        "published row 'ATE' has 2 values … expected 3": {
            "groups": groups,
            "published": {"trajectory": {"ATE": [1, 2]}},
        },
        r"'Ours: RMS' has 1 values": {"groups": groups, "published": {"surface": {"Ours": {"RMS": [1]}}}},
        "published depth of X: rms": {"published": {"depth": {"X": {"rms": 5.0}}}},
        "b (x) is there twice": {"groups": [{"title": "one", "sequences": {"a": "x", "b": "x"}}], "published": {}},
        "leads outside the data's root": {"groups": [{"title": "one", "sequences": {"a": "../x"}}], "published": {}},
        "fps": {"fps": 0},
        "at most 100 characters": {"groups": [{"title": "one", "sequences": {"a" * 101: "x"}}], "published": {}},
    }
    for message, changes in cases.items():
        with refused(message):
            read_suite(changed(path, **changes))
    with refused(where="the suite", found="x is not in"):
        present(read_suite(changed(path, groups=groups, published={})), maps, data)
    with refused(where="--suite", cure="--truth"):
        evaluate(maps, None, tmp_path / "out", suite=SUITE, join=path)
