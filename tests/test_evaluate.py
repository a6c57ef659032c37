"""`evaluate` as a user meets it: what it takes, what it writes, that it is the same twice, and what it refuses."""

from __future__ import annotations

import csv
import json
import random
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from colons import colon, sequence, slam, truth
from raising import refused
from verbs import by_options

from densify.commands.evaluate import evaluate as evaluate_verb
from densify.config import DensifyConfig
from densify.evaluation.files import check_no_truth_lost, long_rows, write_evaluations
from densify.evaluation.in_short import in_short
from densify.evaluation.judge import judge_maps
from densify.evaluation.judge_depth import judge_depth
from densify.evaluation.judged_map import JudgedMap, dense_models, read_run
from densify.evaluation.suite import alone
from densify.evaluation.tables import (
    Table,
    cell_text,
    depth_table,
    surface_table,
    trajectory_table,
)
from densify.evaluation.truth import read_truth
from densify.judged import JudgingConfig, TruthSource, read_asked
from densify.pipeline import densify
from lightdepth.datasets import write_folder
from lightdepth.errors import InputError
from lightdepth.files.tum import write_tum
from lightdepth.maps import write_multimap
from lightdepth.metrics import ALIGNMENTS, NAMES

evaluate = by_options(evaluate_verb)

FRAMES = colon(0).frames


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("data") / "seq"
    write_folder(FRAMES, folder)
    return folder


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    """Two dense maps made with true depth, and what a densify run says of its withheld points."""
    folder = tmp_path_factory.mktemp("run") / "dense"
    for result in densify(sequence(FRAMES), slam(FRAMES, maps=2, spurious=0.1).map, truth, DensifyConfig()):
        result.dense.write(folder / f"map_{result.dense.submap.id:03d}")
    found = {"points": 40, "median": 0.03, "p90": None, "miss": 0.1}
    record = {
        "unit": "map units",
        "maps": [{"map": 0, "withheld": found, "withheld_constant": {**found, "median": 0.3}}],
    }
    (folder / "run.json").write_text(json.dumps(record))
    return folder


@pytest.fixture(scope="module")
def predictions(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("predictions")
    rng = np.random.default_rng(0)
    for frame in FRAMES[:4]:
        found = truth(frame)
        noisy = (0.1 * found.distance * rng.lognormal(0, 0.1, found.distance.shape)).astype(np.float32)
        replace(found, distance=noisy).save(folder / f"{frame.name}.npz")
    return folder


@pytest.fixture(scope="module")
def judged(run, data, tmp_path_factory) -> Path:
    output = tmp_path_factory.mktemp("judged") / "metrics"
    evaluate(run, data, output)
    return output


def metrics(folder: Path) -> dict:
    return json.loads((folder / "metrics.json").read_text())


def test_a_run_s_metrics_say_units_alignment_truth_counts_and_versions(judged):
    found = metrics(judged)
    assert found["unit"].startswith("mm") and "Sim(3)" in found["alignment"] and "no cap" in found["mask"]
    assert "every second pixel of 10 frames" in found["truth"]["cloud"] and "cube of 0.2 mm" in found["truth"]["cloud"]
    assert found["truth"]["cloud_points"] > 10_000 and found["thresholds_mm"] == [1, 2, 5]
    assert {"python", "lightdepth", "scipy"} <= set(found["versions"]) and "revision" in found
    assert found["trajectory"]["frames"] == 10 and found["trajectory"]["submaps_aligned"] == 2
    assert list(found["all"]) == ["sparse", "sparse_inliers", "dense"]
    for name in found["all"]:
        assert found["all"][name]["points"] == sum(m[name]["points"] for m in found["maps"])


def test_a_joined_surface_is_judged_by_its_own_folder(judged, run, data, tmp_path):
    shutil.copytree(run / "map_001", tmp_path / "dense" / "joined_000")
    (tmp_path / "dense" / "run.json").write_text('{"unit": "map units"}')
    evaluate(tmp_path / "dense" / "joined_000", data, tmp_path / "out")
    (alone_found,) = metrics(tmp_path / "out")["maps"]
    assert alone_found["dense"] == metrics(judged)["maps"][1]["dense"]


def test_withheld_points_are_in_every_report_with_a_constant_distance_beside(judged, run, data, tmp_path):
    (told,) = json.loads((run / "run.json").read_text())["maps"]
    assert metrics(judged)["withheld"] == [told] and told["withheld_constant"]["median"] == 0.3
    text = (judged / "metrics.md").read_text()
    assert "| map 0 | this depth | 40 | 0.03 | ∞ | 0.1 |" in text
    assert "| map 0 | constant distance | 40 | 0.3 | ∞ | 0.1 |" in text
    evaluate(run, None, tmp_path / "without")
    assert "| map 0 | this depth | 40 |" in (tmp_path / "without" / "metrics.md").read_text()
    assert "<h1>Agreement with the sparse map</h1>" in (tmp_path / "without" / "report.html").read_text()
    assert "<h1>Errors against truth</h1>" in (judged / "report.html").read_text()


def test_metrics_against_truth_are_not_replaced_by_metrics_without_unless_asked(judged, run, data, tmp_path):
    mine = shutil.copytree(run, tmp_path / "run")
    shutil.copytree(judged, mine / "evaluation")
    before = (mine / "evaluation" / "metrics.json").read_text()
    with refused(where="evaluation", found="metrics against truth", cure="--truth DATA") as told:
        evaluate(mine)
    assert "--overwrite" in told.value.cure and (mine / "evaluation" / "metrics.json").read_text() == before
    assert sorted(path.name for path in mine.iterdir()) == ["evaluation", "map_000", "map_001", "run.json"]
    evaluate(mine, overwrite=True)
    assert metrics(mine / "evaluation")["truth_folder"] is None
    evaluate(mine)  # neither has truth
    (mine / "evaluation" / "metrics.json").write_text("spoilt")
    check_no_truth_lost(mine / "evaluation")


def test_tables_are_laid_out_as_the_paper_s(judged):
    text = (judged / "metrics.md").read_text()
    first, second = text.index("Table 1"), text.index("Table 2")
    rows = [line.split("|")[1].strip() for line in text[first:second].splitlines() if line.startswith("| ")]
    assert rows[2:6] == ["# Frames", "# KF", "KF time ms", "RMS ATE mm, Sim(3)"]
    rows = [line.split("|")[1:3] for line in text[second:].splitlines() if line.startswith("| ")]
    found = [tuple(c.strip() for c in row) for row in rows[2:11]]
    metric = ("#MP (×10³)", "RMS Acc.", "MedA Acc.")
    assert found == [(name, m) for name in ("Sparse map", "Sparse inliers", "Dense") for m in metric]


def test_the_tex_has_whole_tabulars_with_as_many_cells_as_columns(judged):
    tex = (judged / "metrics.tex").read_text()
    assert tex.count(r"\begin{table}") == tex.count(r"\end{table}") == 4
    for table in tex.split(r"\begin{tabular}")[1:]:
        columns = table[: table.index("\n")].count("c")
        body = [line for line in table.split(r"\end{tabular}")[0].splitlines() if line.endswith(r"\\")]
        assert body and all(line.count(" & ") == columns - 1 for line in body)
    assert all(ord(c) < 128 for line in tex.splitlines() if not line.startswith("%") for c in line)
    assert r"\# Frames" in tex and r"Frames localised \%" in tex


def test_words_of_a_table_cannot_break_it():
    table = Table("a_b", ["m & n", "x|y"], [["50 %", None], ["#1", 0.5]])
    assert (
        r"m \& n & x|y \\" in table.latex() and r"50 \% & -- \\" in table.latex() and r"\caption{a\_b}" in table.latex()
    )
    assert "| m & n | x/y |" in table.markdown()


def test_a_name_stays_in_its_cell_whatever_is_in_it():
    table = Table("t", ["a", "b"], [["one\ntwo $x^2$ {~}\\", 3]])
    assert r"| one\ntwo $x^2$ {~}\ | 3 |" in table.markdown().splitlines()
    said = r"one\textbackslash{}ntwo \$x\textasciicircum{}2\$ \{\textasciitilde{}\}\textbackslash{} & 3 \\"
    assert said in table.latex()


def test_the_csv_has_every_figure_with_its_unit_and_the_json_the_same(judged):
    with (judged / "metrics.csv").open(newline="") as file:
        headers, *rows = csv.reader(file)
    assert headers == ["sequence", "part", "model", "metric", "value"]
    values = {tuple(r[:4]): float(r[4]) for r in rows}
    assert len(values) == len(rows)
    found = metrics(judged)
    assert values["seq", "all", "dense", "rms_mm"] == found["all"]["dense"]["rms_mm"]
    assert values["seq", "map 1", "sparse", "f_score_2mm"] == found["maps"][1]["sparse"]["f_score"]["2mm"]
    assert values["seq", "all", "", "rms_ate_mm"] == found["trajectory"]["rms_ate_mm"]


def test_the_coloured_mesh_lies_on_the_wall_and_knows_its_errors(judged):
    mesh = trimesh.load(judged / "map_001_error.ply", process=False)
    assert np.median(colon(0).tube.distance_to_wall(np.asarray(mesh.vertices))) < 1.0
    raw = mesh.metadata["_ply_raw"]["vertex"]["data"]["error_mm"].ravel()
    found = metrics(judged)["maps"][1]["dense"]
    assert np.sqrt((raw.astype(float) ** 2).mean()) == pytest.approx(found["rms_mm"], rel=1e-5)
    far, near = raw > 4.5, raw < 0.3
    colors = np.asarray(mesh.visual.vertex_colors, float)
    assert (colors[near, 2] > colors[near, 0]).all() and (colors[far, 0] > colors[far, 2]).all()
    for name in ("map_000_error.png", "cumulative_error.png"):
        assert cv2.imread(str(judged / name)).std() > 5


def test_the_cumulative_curve_rises_to_all_and_passes_through_the_median(judged):
    with (judged / "cumulative_error.csv").open(newline="") as file:
        headers, *rows = csv.reader(file)
    assert headers == ["error_mm", "sparse", "sparse_inliers", "dense"]
    edges, *curves = np.array(rows, float).T
    assert (np.diff(curves) >= 0).all() and curves[2][-1] == 1
    median = metrics(judged)["all"]["dense"]["median_mm"]
    assert np.interp(median, edges, curves[2]) == pytest.approx(0.5, abs=0.02)


def same_files(a: Path, b: Path) -> None:
    """All but what tells the time, and the arguments."""
    told = {"run.json", "log.txt", "config.yaml"}
    names = sorted(p.name for p in a.iterdir())
    assert names == sorted(p.name for p in b.iterdir()) and len(names) > 6
    assert [n for n in names if n not in told and (a / n).read_bytes() != (b / n).read_bytes()] == []


def test_a_run_judged_twice_gives_the_same_files_but_for_the_time(judged, run, data, tmp_path):
    evaluate(run, data, tmp_path / "again")
    same_files(judged, tmp_path / "again")


def test_predictions_judged_twice_give_the_same_files_and_only_with_overwrite_in_place(predictions, data, tmp_path):
    evaluate(predictions, data, tmp_path / "once")
    evaluate(predictions, data, tmp_path / "twice")
    same_files(tmp_path / "once", tmp_path / "twice")
    with refused(found="already there and not empty"):
        evaluate(predictions, data, tmp_path / "once")
    evaluate(predictions, data, tmp_path / "once", overwrite=True)
    same_files(tmp_path / "once", tmp_path / "twice")


def test_the_order_of_the_frames_does_not_matter(run, predictions):
    mixed = random.Random(0).sample(list(FRAMES), len(FRAMES))
    assert [f.name for f in mixed] != [f.name for f in FRAMES]
    depth = [judge_depth(predictions, sequence(list(f))) for f in (FRAMES, mixed)]
    assert json.dumps(depth[0].as_dict()) == json.dumps(depth[1].as_dict())
    models = [replace(m, clouds={"dense": m.clouds["dense"]}) for m in dense_models(read_run(run))]
    maps = [judge_maps(models, read_truth(sequence(list(f)))) for f in (FRAMES, mixed)]
    assert json.dumps(maps[0].as_dict()) == json.dumps(maps[1].as_dict())
    for one, other in (depth, maps):
        assert {k: v.tolist() for k, v in one.curves.items()} == {k: v.tolist() for k, v in other.curves.items()}


def test_predictions_have_nine_errors_under_four_alignments(predictions, data, tmp_path):
    evaluate(predictions, data, tmp_path / "e")
    found = metrics(tmp_path / "e")
    assert set(found["mean"]) == {f"{n}_{a}" for n in NAMES for a in ALIGNMENTS} | {
        "pixels",
        "share_of_image",
        "share_of_truth",
    }
    for key in found["mean"]:
        assert found["mean"][key] == pytest.approx(np.mean([row[key] for row in found["frames"].values()]), rel=1e-12)
    assert found["mean"]["delta1_none"] == 0 and found["mean"]["delta1_lmeds"] > 0.95
    assert "neither 0 nor 65535" in found["mask"] and "< 100 mm" in found["mask"] and found["max_depth_mm"] == 100
    assert (found["frames_of_truth"], found["frames_predicted"], found["frames_judged"]) == (10, 4, 4)
    text = (tmp_path / "e" / "metrics.md").read_text()
    assert "| none (up to scale) | seq |" in text and "4 of 4 predicted frames judged (the sequence has 10)" in text


def test_several_sequences_are_averaged_over_frames_and_over_sequences(predictions, run):
    one = judge_depth(predictions, sequence(list(FRAMES))).judged
    thrice = replace(one.mean, errors={k: 3 * v for k, v in one.mean.errors.items()})
    other = replace(one, mean=thrice, frames={f"{n} {i}": f for n, f in one.frames.items() for i in range(3)})
    rows = {tuple(r[:2]): r[2] for r in depth_table({"a": one, "b": other}).rows}
    value = one.mean.errors["abs_rel_median"]
    assert rows["median", "mean over sequences"] == pytest.approx(2 * value)
    assert rows["median", "mean over frames"] == pytest.approx(value * (4 + 3 * 12) / 16)
    found = judge_maps(dense_models(read_run(run)), read_truth(sequence(FRAMES))).judged
    farther = replace(found.trajectory, rms_ate_mm=3 + found.trajectory.rms_ate_mm)
    without = replace(found, pooled={}, trajectory=farther)
    rows = {r[0]: r[1:] for r in trajectory_table({"a": found, "b": without}).rows}
    a, b, mean = rows["RMS ATE mm, Sim(3)"]
    assert mean == pytest.approx((a + b) / 2) and rows["# Frames"] == [10, 10, 10]
    assert rows["Frames localised %"] == [None, None, None]
    table = surface_table(
        {"a": found, "b": without}, replace(alone("ab"), surface={"Ours (paper)": {"RMS Acc.": [1.5, 2.5, 2.0]}})
    )
    assert table.headers == ["Method", "Metrics", "a", "b", "avg"] and table.rows[-1][2:] == [1.5, 2.5, 2.0]
    assert table.rows[0][3] is None and table.rows[0][4].endswith("(1 of 2)")


def test_several_sequences_are_written_side_by_side(predictions, tmp_path):
    one = judge_depth(predictions, sequence(list(FRAMES)))
    write_evaluations({"a": one, "b": one}, tmp_path)
    assert set(metrics(tmp_path)["sequences"]) == {"a", "b"}
    assert {"a_cumulative_error.png", "b_cumulative_error.png"} <= {p.name for p in tmp_path.iterdir()}
    assert {row[0] for row in long_rows({"a": one.judged, "b": one.judged})[1:]} == {"a", "b"}


def test_a_map_and_a_trajectory_are_judged_too(data, tmp_path):
    export = slam(FRAMES, maps=2, spurious=0.2)
    write_multimap(export.map, tmp_path / "map")
    evaluate(tmp_path / "map", data, tmp_path / "sparse")
    found = metrics(tmp_path / "sparse")
    assert list(found["all"]) == ["sparse"] and found["all"]["sparse"]["points"] > 200
    file = tmp_path / "KeyFrameTrajectory.txt"
    submap = export.map.submaps[0]
    write_tum(file, [k.number for k in submap.keyframes], [np.linalg.inv(k.cam_from_map) for k in submap.keyframes])
    scale = 1 / export.map_from_world[0][0]
    evaluate(file, data, tmp_path / "trajectory", mm_per_unit=scale)
    alone = metrics(tmp_path / "trajectory")
    assert alone["kind"] == "trajectory" and alone["all"] == {}
    assert alone["maps"][0]["rms_ate_mm"] == pytest.approx(found["maps"][0]["rms_ate_mm"], rel=1e-6)
    assert alone["maps"][0]["rms_ate_mm"] < alone["maps"][0]["rms_ate_se3_mm"] < 0.3
    assert found["maps"][0]["rms_ate_se3_mm"] is None
    write_tum(file, [0, 1], [np.eye(4)] * 2)
    with refused(found="none could be evaluated", cure="map 0: poses: 2 in common"):
        evaluate(file, data, tmp_path / "two")
    write_tum(
        file,
        range(5),
        [np.linalg.inv(np.eye(4)[[0, 1, 2, 3]] + np.outer([0, 0, i, 0], [0, 0, 0, 1])) for i in range(5)],
    )
    with refused(cure="map 0: map camera centres: they lie on a line"):
        evaluate(file, data, tmp_path / "line")
    assert not (tmp_path / "two").exists() and not (tmp_path / "line").exists()


def test_a_run_takes_the_poses_of_all_frames_and_its_unit_where_they_are_given(run, data, tmp_path):
    export = slam(FRAMES, maps=2, spurious=0.1)
    by_map = {}
    for submap in export.map.submaps:
        s, r, t = export.map_from_world[submap.id]
        by_map[submap.id] = {}
        for f in FRAMES:
            map_from_cam = np.eye(4)
            map_from_cam[:3, :3] = r @ f.true_world_from_cam[:3, :3]
            map_from_cam[:3, 3] = s * r @ f.true_world_from_cam[:3, 3] + t
            by_map[submap.id][f.name] = np.linalg.inv(map_from_cam)
    write_multimap(export.map, tmp_path / "slam", by_map)
    shutil.copytree(run / "map_000", tmp_path / "run" / "map_000")
    shutil.copytree(run / "map_001", tmp_path / "run" / "map_001")
    (tmp_path / "run" / "run.json").write_text(json.dumps({"unit": "mm"}))
    evaluate(tmp_path / "run", data, trajectory=tmp_path / "slam")
    found = metrics(tmp_path / "run" / "evaluation")
    assert found["trajectory"]["rms_ate_se3_mm"] > 10 * found["trajectory"]["rms_ate_mm"]  # not in mm, and that shows
    assert found["trajectory"]["localised_share"] == 1 and found["maps"][0]["poses"] == 10
    assert found["all"]["dense"]["points"] > 1000
    shutil.rmtree(tmp_path / "slam" / "3D_maps")
    (tmp_path / "slam" / "camera_trajectory" / "cam_traj_map_001.txt").unlink()
    with refused(where="map 1", found="has no trajectory", cure="there are those of [0]"):
        evaluate(run, data, tmp_path / "none", trajectory=tmp_path / "slam")


def test_two_predictions_of_a_frame_are_refused(predictions, data, tmp_path):
    shutil.copytree(predictions, tmp_path / "p")
    shutil.copy(tmp_path / "p" / "000001.npz", tmp_path / "p" / "1.npz")
    with refused(found="000001.npz and 1.npz have the same number"):
        evaluate(tmp_path / "p", data)


def test_truth_that_does_not_fit_is_refused_and_nothing_is_written(run, predictions, tmp_path):
    write_folder(FRAMES[:7], tmp_path / "few")
    small = [
        replace(
            f,
            image=f.image[::2, ::2],
            camera=f.camera.resized(48, 40),
            mask=None,
            true_distance=f.true_distance[::2, ::2],
        )
        for f in FRAMES[:4]
    ]
    write_folder(small, tmp_path / "small")
    later = [replace(f, name=f"{f.number + 50:06d}") for f in FRAMES]
    write_folder(later, tmp_path / "later")
    cases = [
        (
            run,
            "few",
            "map 1: … it has frames 0 to 6, the poses are for frames 3 to 9: 4 match (frames 3 to 6), 3 do",
        ),
        (run, "later", "none of its frames is among the poses: it has frames 50 to 59"),
        (predictions, "later", "none of its frames is among the predictions: it has frames 50 to 59, they are for"),
        (predictions, "small", "the prediction is 96x80, the truth 48x40"),
    ]
    for source, where, message in cases:
        with refused(message):
            evaluate(source, tmp_path / where, tmp_path / "out")
    models = [JudgedMap(m.trajectory) for m in dense_models(read_run(run))]
    found = judge_maps(models, read_truth(sequence(list(FRAMES[:7])), with_surface=False), common=True)
    assert [m.aligned.poses for m in found.judged.maps] == [5, 4]
    assert not (tmp_path / "out").exists()


def test_a_sequence_that_one_stands_in_is_called_by_its_folder(run, data, monkeypatch):
    monkeypatch.chdir(data)
    asked = read_asked(run, TruthSource(truth=Path(".")), JudgingConfig())
    assert list(asked.pairs) == [data.name]


def test_options_that_mean_nothing_are_refused(run, data, tmp_path):
    for options, message in (
        ({"mm_per_unit": 0.0}, "above 0"),
        ({"thresholds_mm": ()}, "expected distances in mm"),
        ({"thresholds_mm": (1.0, -2.0)}, "each number above 0"),
    ):
        with refused(message):
            evaluate(run, data, tmp_path / "out", **options)
    with refused(found="no such folder or file"):
        evaluate(run / "nowhere", data)
    (tmp_path / "dense").mkdir()
    (tmp_path / "dense" / "run.json").write_text('{"maps": [{"map": 0, "withheld": {"points": 40, "median": 0.1}}]}')
    with pytest.raises(InputError) as caught:
        evaluate(tmp_path / "dense", None, tmp_path / "out")
    assert "run.json: maps: withheld.p90 missing" in str(caught.value)


def shown(*args) -> list[list[str]]:
    lines = [line.strip("| ").split(" | ") for line in in_short(*args).splitlines() if line.startswith("| ")]
    return [line for line in lines if not line[0].startswith(("---", "# KF"))]


def test_what_is_shown_is_a_line_for_each_map_and_all_or_for_each_sequence(run, predictions):
    found = judge_maps(dense_models(read_run(run)), read_truth(sequence(FRAMES)))
    rows, judged = shown({"a": found}), found.judged
    assert [row[0] for row in rows] == ["map 0", "map 1", "all"] and {row[3] for row in rows} == {"Dense"}
    assert rows[2][4] == cell_text(judged.pooled["dense"].rms_mm)
    assert rows[1][2] == cell_text(judged.maps[1].aligned.rms_ate_mm)
    rows = shown({"a": found, "b": found})
    assert [row[0] for row in rows] == ["a", "b"] and rows[0][1:] == rows[1][1:]
    one = judge_depth(predictions, sequence(list(FRAMES)))
    assert {row[1] for row in shown({"a": one, "b": one})[1:]} == {"mean over sequences", "mean over frames"}
