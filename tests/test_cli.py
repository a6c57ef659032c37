"""The command as a user meets it: its words, its exit codes, and what it leaves on disk."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from pages import check_self_contained
from scenes import cylinder
from test_scene import scene_in

from lightdepth.camera import Pinhole
from lightdepth.cli import main
from lightdepth.datasets import FORMATS, write_folder
from lightdepth.maps import read_map
from lightdepth.photometry import PhotometricCalibration

HEAVY = ("torch", "numpy", "cv2", "open3d", "pycolmap", "scipy", "jsonargparse", "matplotlib")
SMALL = ["--scene.shape.step", "1.2", "--scene.shape.length", "90", "--scene.texture.resolution", "0.4"]
SMALL += ["--slam.kind", "independent"]


def lightdepth(*argv: object) -> int:
    """The exit code of a verb, run in this process."""
    try:
        return main([str(a) for a in argv])
    except SystemExit as stopped:  # wrong options, found by argparse
        return int(stopped.code or 0)


def left_in(folder: Path) -> list[str]:
    return sorted(p.name for p in folder.iterdir())


@pytest.mark.parametrize("argv", [["--help"], ["-h"], ["--version"], ["-V"], [], ["densfy"]], ids=" ".join)
def test_the_answers_that_need_no_work_import_nothing_heavy(argv):
    program = (
        "import sys\nfrom lightdepth.cli import main\n"
        f"main({argv!r})\nprint('heavy:', [m for m in {HEAVY!r} if m in sys.modules])"
    )
    root = Path(__file__).resolve().parents[1]
    done = subprocess.run([sys.executable, "-c", program], cwd=root, capture_output=True, text=True, check=True)
    assert done.stdout.endswith("heavy: []\n")


def test_help_lists_the_verbs_in_the_order_of_the_work_each_with_its_line(capsys):
    assert lightdepth("--help") == 0
    lines = capsys.readouterr().out.splitlines()
    verbs = [line.split()[0] for line in lines if line.startswith("  ")]
    assert verbs == [
        "demo",
        "doctor",
        "synth",
        "import",
        "calibrate-light",
        "convert-camera",
        "select",
        "train",
        "adapt",
        "ablate",
        "predict",
        "sparse",
        "densify",
        "batch",
        "live",
        "evaluate",
        "bench",
        "scale",
        "measure",
        "view",
        "export",
        "completion",
    ]
    assert all(len(line.split()) > 4 for line in lines if line.startswith("  "))
    assert lightdepth() == 2


def test_version_is_the_distribution_s(capsys):
    from importlib.metadata import version

    assert lightdepth("--version") == 0 and capsys.readouterr().out == f"lightdepth {version('lightdepth')}\n"


def test_a_mistyped_verb_is_told_which_was_meant(capsys):
    assert lightdepth("densfy") == 2 and "no verb 'densfy'; did you mean densify?" in capsys.readouterr().err
    assert lightdepth("cook") == 2 and "expected one of demo, doctor" in capsys.readouterr().err


@pytest.mark.parametrize("verb", ["demo", "synth", "predict", "sparse", "densify", "live", "evaluate", "bench"])
def test_every_verb_explains_its_options(verb, capsys):
    assert lightdepth(verb, "--help") == 0
    shown = capsys.readouterr().out
    assert "Args:" not in shown and "--output" in shown
    assert "default" in shown and "folder" in shown.lower()
    assert "--format" not in shown or all(name in shown for name in FORMATS)


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    """A synthetic sequence with its SLAM export, made by the command."""
    folder = tmp_path_factory.mktemp("data") / "seq"
    argv = ["--frames", 8, "--size", "[96, 80]", "--travel-mm", 10, "--lens", "pinhole", "--slam.keyframe-every", 1]
    assert lightdepth("synth", "-o", folder, *argv, *SMALL) == 0
    return folder


@pytest.fixture(scope="module")
def run(data, tmp_path_factory) -> Path:
    """The sequence made dense with its map, by the command."""
    folder = tmp_path_factory.mktemp("runs") / "dense"
    assert lightdepth("densify", data, "--map", data / "slam", "--checkpoint", "decline", "-o", folder) == 0
    return folder


@pytest.fixture(scope="module")
def frames(data, tmp_path_factory) -> Path:
    """Only images and camera, without a map."""
    folder = tmp_path_factory.mktemp("frames") / "seq"
    folder.mkdir()
    shutil.copytree(data / "frames", folder / "frames")
    shutil.copy(data / "camera.json", folder)
    return folder


def test_synth_draws_realistic_colons_too_and_they_have_ranges_of_their_own(tmp_path, capsys):
    argv = ["--lens", "pinhole", "--frames", 4, "--size", "[64, 48]", "--slam.keyframe_every", 1]
    argv += ["--slam.kind", "independent"]
    for family in ("plain", "realistic"):
        assert lightdepth("synth", *argv, "--family", family, "-o", tmp_path / family) == 0
    first, second = (cv2.imread(str(tmp_path / f / "frames" / "000000.png")) for f in ("plain", "realistic"))
    assert np.abs(first.astype(float) - second).mean() > 5
    capsys.readouterr()
    argv += ["--family", "realistic", "--scene.shape.length", 100, "-o", tmp_path / "both"]
    assert lightdepth("synth", *argv) == 3
    assert "leave out --scene" in capsys.readouterr().err and not (tmp_path / "both").exists()


def test_synth_writes_frames_truth_map_and_what_only_it_knows(data):
    assert {"frames", "truth", "slam", "camera.json", "light.json", "mask.png", "run.json"} <= set(left_in(data))
    assert len(left_in(data / "frames")) == len(left_in(data / "truth" / "distance")) == 8
    known = json.loads((data / "truth" / "slam.json").read_text())
    assert set(known) == {"0", "1"} and known["0"]["spurious_point_ids"]
    record = json.loads((data / "run.json").read_text())
    assert record["verb"] == "synth" and record["arguments"]["travel_mm"] == 10
    assert record["arguments"]["scene"]["shape"]["step"] == 1.2


def test_a_run_has_a_surface_for_every_map_a_report_and_its_figures(run):
    assert {"map_000", "map_001", "report.html", "run.json", "config.yaml", "log.txt"} <= set(left_in(run))
    assert {"mesh.ply", "cloud.ply", "sparse.ply", "keyframes.csv"} <= set(left_in(run / "map_001"))
    record = json.loads((run / "run.json").read_text())
    assert record["checkpoint"] == "decline" and record["unit"] == "map units" and record["failures"] == []
    for row in record["maps"]:
        assert row["aligned"] == row["keyframes"] > 3 and row["vertices"] > 1000 and 0 < row["seen_share"] <= 1
        assert row["judge"]["blocks"]["count"] > 50 and row["judge"]["blocks"]["constant_bent"] > 0
        assert row["verdict"]["colour"] in ("green", "amber", "red") and row["verdict"]["sentence"]
    assert record["verdict"] in [row["verdict"] for row in record["maps"]]
    (first,) = [line for line in (run / "log.txt").read_text().splitlines() if "verdict: " in line]
    assert record["verdict"]["sentence"] in first
    assert set(record["inputs"]) == {"data", "map"}
    assert not list(run.parent.glob(".dense-*"))


def test_maps_that_share_frames_are_joined_besides_and_the_transform_is_in_run_json(run, data):
    assert {"mesh.ply", "cloud.ply", "sparse.ply", "keyframes.csv"} <= set(left_in(run / "joined_000"))
    record = json.loads((run / "run.json").read_text())["merge"]
    (joined,) = record["joined"]
    assert sorted(joined["maps"]) == [0, 1] and record["alone"] == {} and record["joins"][0]["by"] == "points"
    (transform,) = joined["transforms"]
    known = json.loads((data / "truth" / "slam.json").read_text())
    first, second = (known[str(transform[k])]["map_from_world"]["scale"] for k in ("first", "second"))
    assert transform["scale"] == pytest.approx(second / first, rel=0.05)
    assert "Maps 0, 1 as one" in (run / "report.html").read_text()


def test_evaluate_writes_the_tables_into_the_run_and_again_without_asking(run, data, capsys):
    assert lightdepth("evaluate", run, "--truth", data) == 0
    shown = capsys.readouterr().out
    for name in ("metrics.json", "metrics.md", "metrics.csv", "metrics.tex", "map_000_error.ply", "run.json"):
        assert (run / "evaluation" / name).is_file()
    lines = [line for line in shown.splitlines() if line.startswith("| ")]
    assert [line.split("|")[1].strip() for line in lines[2:5]] == ["map 0", "map 1", "all"] and len(lines) < 15
    assert shown.splitlines()[-1] == f"written: {run}/evaluation; open {run}/evaluation/report.html"
    page = (run / "evaluation" / "report.html").read_text(encoding="utf-8")
    assert (
        check_self_contained(run / "evaluation" / "report.html").tags.count("img") == 2
    )  # curves, and a surface where no scene can be drawn
    assert all(f">{cell.strip()}<" in page for cell in lines[4].split("|")[1:-1])
    assert (
        'href="map_000_error.ply"' in page
        and "coloured by its distance to the true surface" in page
        and scene_in(page)["surfaces"][1]["title"] == "map_001"
    )
    rows = json.loads((run / "evaluation" / "metrics.json").read_text())["maps"]
    assert all(row["sparse"]["rms_mm"] > 5 * row["dense"]["rms_mm"] for row in rows)
    assert lightdepth("evaluate", run, "--truth", data) == 0


def test_evaluate_judges_the_gap_between_two_maps_by_the_known_similarities(run, data, tmp_path):
    known = json.loads((data / "truth" / "slam.json").read_text())
    (s0, r0, t0), (s1, r1, t1) = (
        (k["scale"], np.array(k["rotation"]), np.array(k["translation"]))
        for k in (known[i]["map_from_world"] for i in "01")
    )
    rotation = r1 @ r0.T
    join = {"first": 0, "second": 1, "scale": s1 / s0, "rotation": rotation.tolist()}
    join["translation"] = (t1 - s1 / s0 * rotation @ t0).tolist()
    (tmp_path / "join.json").write_text(json.dumps(join))
    assert lightdepth("evaluate", run, "--join", tmp_path / "join.json", "-o", tmp_path / "gap") == 0
    gap = json.loads((tmp_path / "gap" / "metrics.json").read_text())["gap"]
    assert gap["rays"] > 20 and gap["median"] < 0.1
    (tmp_path / "join.json").write_text(json.dumps({**join, "second": 5}))
    assert lightdepth("evaluate", run, "--join", tmp_path / "join.json", "-o", tmp_path / "gap2") == 3
    assert not (tmp_path / "gap2").exists()


def test_evaluate_without_truth_shows_the_agreement_with_the_map_beside_a_constant_distance(run, tmp_path, capsys):
    assert lightdepth("evaluate", run, "-o", tmp_path / "e") == 0
    record = json.loads((tmp_path / "e" / "metrics.json").read_text())
    maps = json.loads((run / "run.json").read_text())["maps"]
    assert [w["withheld"]["median"] for w in record["withheld"]] == [m["judge"]["hidden"]["median"] for m in maps]
    log = (run / "log.txt").read_text()  # says the same figures
    for each in record["withheld"]:
        found, constant = (each[name]["median"] for name in ("withheld", "withheld_constant"))
        assert f"differs by {found:.1%} (a constant distance by {constant:.1%}) from hidden blocks of the map" in log
    text = (tmp_path / "e" / "metrics.md").read_text()
    assert "It needs no truth" in text and text.count("constant distance") == len(maps)
    assert text.rstrip() in capsys.readouterr().out


def test_evaluate_without_anything_to_compare_with_is_refused(data, run, tmp_path, capsys):
    shutil.copytree(run / "map_000", tmp_path / "alone" / "map_000")
    assert lightdepth("evaluate", tmp_path / "alone") == 3
    assert "give --truth DATA, or --join FILE" in capsys.readouterr().err
    assert lightdepth("evaluate", data / "slam", "--truth", data) == 3
    assert "not a folder of this program; add -o FOLDER" in capsys.readouterr().err


def test_a_map_s_known_scale_gives_millimetres_and_other_formats_on_request(run, data, tmp_path):
    argv = ["--map", data / "slam", "--checkpoint", "decline", "--mm-per-unit", 4, "--formats", "[ply, glb, obj]"]
    assert lightdepth("densify", data, *argv, "--judge.on", "false", "--output", tmp_path / "mm") == 0
    assert {"mesh.ply", "mesh.glb", "mesh.obj"} <= set(left_in(tmp_path / "mm" / "map_000"))
    record = json.loads((tmp_path / "mm" / "run.json").read_text())
    assert record["unit"] == "mm" and record["maps"][0]["judge"] is None


def test_where_the_light_tells_no_millimetres_surfaces_stay_in_map_units_and_why_is_said(data, tmp_path, capsys):
    """Its position is another endoscope's: a file that says so is not believed because somebody gave it."""
    light = json.loads((data / "light.json").read_text()) | {"source": "assumed", "position_mm": [3.0, 1.0, 0.0]}
    (tmp_path / "light.json").write_text(json.dumps(light))
    argv = ["--map", data / "slam", "--checkpoint", "decline", "--mm-per-unit", "light", "--no-merge"]
    argv += ["--light", tmp_path / "light.json", "--judge.on", "false", "-o", tmp_path / "dense"]
    assert lightdepth("densify", data, *argv) == 0
    said = capsys.readouterr().out
    assert "warning: map 0: no millimetres, nobody gave the light" in said and "mm per map unit" not in said
    last = said.splitlines()[-3]  # what to type next, and what was written, come after it
    why = "the light does not tell every map's millimetres; of map 0 (and of 1 other): nobody gave the light: "
    assert last.startswith(f"the surfaces are in map units: {why}")
    assert last.endswith("give it: --light light.json, with position_mm and a source other than assumed")
    record = json.loads((tmp_path / "dense" / "run.json").read_text())
    assert record["unit"] == "map units" and any("nobody gave the light" in w for w in record["warnings"])
    told = json.loads((tmp_path / "dense" / "scale.json").read_text())
    assert {one["mm_per_unit"] for one in told["maps"]} == {None} and told["unit"] == "map units"
    assert "nobody gave the light" in (tmp_path / "dense" / "report.html").read_text()


@pytest.mark.parametrize("output", ["-o", "--output", "--output="])
def test_output_is_o_and_dashes_are_underscores(output, tmp_path):
    place = [f"{output}{tmp_path / 'seq'}"] if output.endswith("=") else [output, tmp_path / "seq"]
    argv = ["--frames", 4, "--size", "[24, 20]", "--travel_mm=3", "--slam.points-per-keyframe=60"]
    extra = ["--slam.maps", 1, "--slam.keyframe_every", 1]
    assert lightdepth("synth", *place, *argv, *extra, *SMALL) == 0
    slam = json.loads((tmp_path / "seq" / "run.json").read_text())["arguments"]["slam"]
    assert slam["points_per_keyframe"] == 60


def test_errors_that_come_together_are_options_and_the_truth_names_the_points_that_moved(tmp_path):
    argv = ["--frames", 4, "--size", "[48, 40]", "--slam.maps", 1, "--slam.keyframe_every", 1, "--travel_mm", 3]
    extra = ["--errors.side_share", 0.25, "--errors.side_factor", 1.2]
    assert lightdepth("synth", "-o", tmp_path / "a", *argv, *SMALL, *extra) == 0
    known = json.loads((tmp_path / "a" / "truth" / "slam.json").read_text())["0"]
    (submap,) = read_map(tmp_path / "a" / "slam").submaps
    assert len(known["moved_point_ids"]) == round(0.25 * len(submap.points))
    assert lightdepth("synth", "-o", tmp_path / "b", *argv, *SMALL, "--errors.side_share", 2) in (2, 3)


def test_the_share_of_wrong_points_can_be_given_either_way(tmp_path):
    argv = ["--frames", 4, "--size", "[48, 40]", "--slam.maps", 1, "--slam.keyframe_every", 1, "--travel_mm", 3]
    for name, option in (("a", "--spurious"), ("b", "--slam.spurious")):
        assert lightdepth("synth", "-o", tmp_path / name, *argv, *SMALL, option, 0) == 0
        known = json.loads((tmp_path / name / "truth" / "slam.json").read_text())
        assert known["0"]["spurious_point_ids"] == []


def test_options_come_from_a_file_too_and_the_command_line_wins_and_the_surface_is_to_be_looked_at(
    data, tmp_path, capsys
):
    settings = {"checkpoint": "decline", "judge": {"on": False}, "alignment": {"t": 3.5}, "fusion": {"far": 1.5}}
    (tmp_path / "c.yaml").write_text(json.dumps(settings))
    argv = ["--config", tmp_path / "c.yaml", "--fusion.far", 1.25]
    assert lightdepth("densify", data, *argv, "--map", data / "slam", "-o", tmp_path / "out") == 0
    arguments = json.loads((tmp_path / "out" / "run.json").read_text())["arguments"]
    assert arguments["alignment"]["t"] == 3.5 and arguments["fusion"]["far"] == 1.25
    assert arguments["checkpoint"] == "decline"
    assert f"next: lightdepth view {tmp_path / 'out'}\n" in capsys.readouterr().out


WRONG_USAGE = {
    "no output": ["densify", "DATA"],
    "no data": ["densify", "-o", "OUT"],
    "unknown option": ["densify", "DATA", "-o", "OUT", "--mpa", "x"],
    "no number": ["densify", "DATA", "-o", "OUT", "--alignment.t", "wide"],
    "no choice": ["synth", "-o", "OUT", "--layout", "zip"],
    "no lens": ["synth", "-o", "OUT", "--lens", "rear"],
    "no format": ["predict", "DATA", "-o", "OUT", "--format", "colmap"],
    "no value": ["predict", "DATA", "-o"],
}


@pytest.mark.parametrize("case", WRONG_USAGE)
def test_wrong_usage_is_2_and_touches_nothing(case, frames, tmp_path, capsys):
    argv = [{"DATA": str(frames), "OUT": str(tmp_path / "out")}.get(a, a) for a in WRONG_USAGE[case]]
    assert lightdepth(*argv) == 2
    assert "error: " in capsys.readouterr().err and left_in(tmp_path) == []


BAD_INPUT = {
    "no such data": (["predict", "NOWHERE", "--checkpoint", "decline"], "nowhere: does not exist"),
    "no such checkpoint": (["predict", "DATA", "--checkpoint", "best"], "best: no such checkpoint"),
    "no such map": (["densify", "DATA", "--map", "NOWHERE", "--checkpoint", "decline"], "nowhere: no such file"),
    "no map in it": (["densify", "DATA", "--map", "DATA", "--checkpoint", "decline"], "no map in it"),
    "folds": (["densify", "DATA", "--map", "SLAM", "--judge.folds", "1", "--checkpoint", "decline"], "judge.folds: 1"),
    "format": (["densify", "DATA", "--map", "SLAM", "--formats", "[obj]", "--checkpoint", "decline"], "expected ply"),
    "scale": (
        ["densify", "DATA", "--map", "SLAM", "--mm_per_unit", "-1", "--checkpoint", "decline"],
        "--mm-per-unit: -1.0; expected a number above 0",
    ),
    "light": (
        ["predict", "DATA", "--light", "gama=2", "--checkpoint", "decline"],
        "gama is not known (is gamma meant?)",
    ),
    "mask": (["predict", "DATA", "--mask", "NOWHERE", "--checkpoint", "decline"], "nowhere: no such mask"),
    "frames": (["synth", "--frames", "0"], "--frames: 0; expected a number from 1"),
    "no pixels": (["synth", "--size", "[0, 0]"], "--size: [0, 0]; expected each number"),
    "too few frames": (["synth", "--frames", "2", "--size", "[24, 20]"], "at least 7 (--frames 7)"),
    "spurious": (["synth", "--spurious", "1.5"], "--spurious: 1.5"),
    "no run": (["evaluate", "NOWHERE", "--truth", "DATA"], "nowhere: no such folder"),
    "no maps": (["evaluate", "DATA", "--truth", "DATA"], r"neither map_* folders"),
}


@pytest.mark.parametrize("case", BAD_INPUT)
def test_bad_input_is_3_in_one_line_and_leaves_nothing(case, frames, data, tmp_path, capsys):
    argv, message = BAD_INPUT[case]
    places = {"DATA": frames, "NOWHERE": tmp_path / "nowhere", "SLAM": data / "slam"}
    extra = SMALL if argv[0] == "synth" else []
    assert lightdepth(*(places.get(a, a) for a in argv), *extra, "-o", tmp_path / "out") == 3
    said = [line for line in capsys.readouterr().err.splitlines() if line.startswith("lightdepth ")]
    assert len(said) == 1 and message in said[0]
    assert left_in(tmp_path) == []


def test_an_existing_output_is_refused_unless_told_and_never_when_it_is_not_ours(run, data, tmp_path, capsys):
    shutil.copytree(run, tmp_path / "out")
    before = (tmp_path / "out" / "run.json").read_bytes()
    argv = ["densify", data, "--map", data / "slam", "--checkpoint", "decline", "--judge.on", "false"]
    assert lightdepth(*argv, "-o", tmp_path / "out") == 3
    assert "already there and not empty; choose another -o, or give --resume or --overwrite" in capsys.readouterr().err
    assert (tmp_path / "out" / "run.json").read_bytes() == before
    assert lightdepth(*argv, "-o", tmp_path / "out", "--overwrite") == 0
    assert json.loads((tmp_path / "out" / "run.json").read_text())["arguments"]["judge"]["on"] is False

    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("years of work")
    assert lightdepth(*argv, "-o", tmp_path / "mine", "--overwrite") == 3
    assert (tmp_path / "mine" / "thesis.txt").read_text() == "years of work"
    assert left_in(tmp_path) == ["mine", "out"]


def test_frames_that_cannot_be_mapped_are_3_with_advice(tmp_path, capfd):
    camera = Pinhole(60, 50, 40.0, 40.0, 30.0, 25.0)
    light = PhotometricCalibration(gain=100.0)
    write_folder([cylinder(camera).frame(f"{i:04d}", light) for i in range(4)], tmp_path / "seq")
    for verb in (["densify", "--checkpoint", "decline"], ["sparse"]):
        assert lightdepth(verb[0], tmp_path / "seq", *verb[1:], "-o", tmp_path / "out") == 3
        assert "more frames; at least 5 mm of travel" in capfd.readouterr().err
    assert left_in(tmp_path) == ["seq"]


def test_a_checkpoint_that_is_none_is_found_out_before_a_sparse_map_is_made(frames, tmp_path, capsys):
    assert lightdepth("densify", frames, "--checkpoint", "best", "-o", tmp_path / "out") == 3
    shown = capsys.readouterr()
    assert "no such checkpoint" in shown.err and "sparse map" not in shown.out


def test_frames_without_a_map_are_mapped_and_made_dense(tmp_path, capfd):
    """The way for those who have no SLAM: pycolmap makes the map. A torn frame, the first even, has no place in it."""
    argv = ["--frames", 9, "--size", "[240, 192]", "--travel-mm", 7, "--lens", "pinhole"]
    shape = ["--scene.shape.step", "1.2", "--scene.shape.length", "90", "--slam.kind", "independent"]
    assert lightdepth("synth", "-o", tmp_path / "seq", *argv, *shape) == 0
    shutil.rmtree(tmp_path / "seq" / "slam")
    torn = min((tmp_path / "seq" / "frames").iterdir())
    torn.write_bytes(torn.read_bytes()[:300])
    assert lightdepth("densify", tmp_path / "seq", "--checkpoint", "decline", "-o", tmp_path / "out") == 0
    assert {"sparse", "map_000", "report.html"} <= set(left_in(tmp_path / "out"))
    record = json.loads((tmp_path / "out" / "run.json").read_text())
    assert record["maps"][0]["aligned"] >= 6 and list(record["unregistered"]) == [torn.stem]
    assert record["unregistered"][torn.stem].startswith("cannot be read: not a readable image")
    assert record["maps"][0]["judge"]["hidden"]["median"] < 0.2
    with pytest.warns(UserWarning, match="1 of 9 frames cannot be read and are no part of the truth"):
        assert lightdepth("evaluate", tmp_path / "out", "--truth", tmp_path / "seq") == 0


@pytest.fixture(scope="module")
def c3vd(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("c3vd") / "made"
    argv = ["--frames", 5, "--size", "[100, 80]", "--travel-mm", 6, "--layout", "c3vd", "--slam.maps", 1]
    assert lightdepth("synth", "-o", folder, *argv, *SMALL) == 0
    return folder / "sequence"


def test_a_c3vd_tree_is_predicted_and_judged(c3vd, tmp_path):
    assert lightdepth("predict", c3vd, "--checkpoint", "decline", "-o", tmp_path / "p") == 0
    names = [f"{i:04d}_color" for i in range(5)]
    assert {f"{n}.npz" for n in names} | {"previews", "run.json"} <= set(left_in(tmp_path / "p"))
    assert left_in(tmp_path / "p" / "previews") == [f"{n}.png" for n in names]
    assert lightdepth("evaluate", tmp_path / "p", "--truth", c3vd) == 0
    result = json.loads((tmp_path / "p" / "evaluation" / "metrics.json").read_text())
    assert result["kind"] == "depth" and list(result["frames"]) == names
    assert 0.01 < result["mean"]["abs_rel_median"] < 0.5 and result["mean"]["share_of_truth"] > 0.9
    assert lightdepth("predict", c3vd, "--checkpoint", "constant", "-o", tmp_path / "q", "--previews", "false") == 0
    assert "previews" not in left_in(tmp_path / "q")


def test_a_broken_frame_among_good_ones_is_4_and_the_rest_is_written(frames, data, tmp_path, capsys):
    shutil.copytree(frames, tmp_path / "seq")
    image = tmp_path / "seq" / "frames" / "000003.png"
    image.write_bytes(image.read_bytes()[:300])
    assert lightdepth("predict", tmp_path / "seq", "--checkpoint", "decline", "-o", tmp_path / "p") == 4
    assert "1 part failed, the first: 000003: " in capsys.readouterr().err
    assert len(list((tmp_path / "p").glob("*.npz"))) == 7 and not (tmp_path / "p" / "000003.npz").exists()
    (failure,) = json.loads((tmp_path / "p" / "run.json").read_text())["failures"]
    assert failure["what"] == "000003" and "not a readable image" in failure["reason"]
    argv = ["--map", data / "slam", "--checkpoint", "decline", "--judge.on", "false", "--merge", "false"]
    assert lightdepth("densify", tmp_path / "seq", *argv, "-o", tmp_path / "d") == 4
    assert "map_000, keyframe 000003.png: " in capsys.readouterr().err
    text = "".join((tmp_path / "d" / m / "keyframes.csv").read_text() for m in ("map_000", "map_001"))
    assert "000003.png: not a readable image" in text


def test_frames_that_are_all_broken_are_3_and_leave_nothing(frames, tmp_path, capsys):
    shutil.copytree(frames, tmp_path / "seq")
    for image in (tmp_path / "seq" / "frames").iterdir():
        image.write_bytes(b"")
    assert lightdepth("predict", tmp_path / "seq", "--checkpoint", "decline", "-o", tmp_path / "p") == 3
    assert "no frame could be read" in capsys.readouterr().err
    assert left_in(tmp_path) == ["seq"]


@pytest.mark.filterwarnings("ignore:.*median reprojection error")
def test_a_map_that_no_keyframe_fits_is_4_and_the_other_is_written(frames, data, tmp_path, capsys):
    """Map 1 has only six points left, which lie anywhere."""
    shutil.copytree(data / "slam", tmp_path / "slam")
    points = tmp_path / "slam" / "3D_maps" / "1" / "points3D.txt"
    rng, lines = np.random.default_rng(0), points.read_text().splitlines()
    kept = [line for line in lines if line.startswith("#")]
    for line in lines[len(kept) :][:6]:
        words = line.split()
        kept.append(" ".join([words[0], *map(str, rng.normal(size=3)), *words[4:]]))
    points.write_text("\n".join(kept) + "\n")
    argv = ["--map", tmp_path / "slam", "--checkpoint", "decline", "--judge.on", "false"]
    assert lightdepth("densify", frames, *argv, "-o", tmp_path / "out") == 4
    assert "2 parts failed, the first: map_001: " in capsys.readouterr().err
    assert "map_000" in left_in(tmp_path / "out") and "map_001" not in left_in(tmp_path / "out")
    assert "report.html" in left_in(tmp_path / "out")


def test_an_empty_map_is_3_by_name(frames, data, tmp_path, capsys):
    shutil.copytree(data / "slam", tmp_path / "slam")
    for name in ("0", "1"):
        points = tmp_path / "slam" / "3D_maps" / name / "points3D.txt"
        points.write_text("# 3D point list\n")
    assert (
        lightdepth("densify", frames, "--map", tmp_path / "slam", "--checkpoint", "decline", "-o", tmp_path / "o") == 3
    )
    assert "no points in points3D; an empty map cannot be densified" in capsys.readouterr().err
    assert left_in(tmp_path) == ["slam"]


def test_two_maps_of_one_id_are_3_by_name(frames, data, tmp_path, capsys):
    shutil.copytree(data / "slam", tmp_path / "slam")
    shutil.copytree(tmp_path / "slam" / "3D_maps" / "1", tmp_path / "slam" / "3D_maps" / "01")
    assert (
        lightdepth("densify", frames, "--map", tmp_path / "slam", "--checkpoint", "decline", "-o", tmp_path / "o") == 3
    )
    assert "are both map 1; rename one of them" in capsys.readouterr().err
    assert left_in(tmp_path) == ["slam"]


def test_a_map_of_other_frames_is_3_and_says_which_are_missing(frames, data, tmp_path, capsys):
    shutil.copytree(frames, tmp_path / "seq")
    for image in sorted((tmp_path / "seq" / "frames").iterdir()):
        image.rename(image.with_name(f"{int(image.stem) + 900:06d}.png"))
    argv = ["--map", data / "slam", "--checkpoint", "decline"]
    assert lightdepth("densify", tmp_path / "seq", *argv, "-o", tmp_path / "out") == 3
    said = capsys.readouterr().err
    assert "frames 900 to" in said and "none in common" in said and "frame_offset" in said
    assert left_in(tmp_path) == ["seq"]


def test_the_map_s_camera_serves_a_folder_without_one_at_any_size(frames, data, tmp_path):
    shutil.copytree(frames, tmp_path / "seq")
    (tmp_path / "seq" / "camera.json").unlink()
    for image in (tmp_path / "seq" / "frames").iterdir():
        pixels = cv2.imread(str(image))
        cv2.imwrite(str(image), cv2.resize(pixels, (192, 160)))
    argv = ["--map", data / "slam", "--checkpoint", "decline", "--judge.on", "false", "--merge", "false"]
    assert lightdepth("densify", tmp_path / "seq", *argv, "-o", tmp_path / "out") == 0
    assert "rescaled to the frames' 192x160" in (tmp_path / "out" / "log.txt").read_text()
    assert json.loads((tmp_path / "out" / "map_000" / "camera.json").read_text())["width"] == 192


@pytest.mark.parametrize(("layout", "lens"), [("c3vd", "c3vd"), ("endomapper", "fisheye")])
def test_a_data_set_s_own_tree_is_made_dense_and_trained_on_as_it_is(layout, lens, tmp_path):
    argv = ["--layout", layout, "--lens", lens, "--frames", 8, "--size", "[100, 80]", "--slam.keyframe_every", 1]
    assert lightdepth("synth", *argv, *SMALL, "--travel_mm", 10, "-o", tmp_path / "made") == 0
    sequence, slam = tmp_path / "made" / "sequence", tmp_path / "made" / "slam"
    argv = ["--map", slam, "--checkpoint", "decline", "--judge.on", "false"]
    assert lightdepth("densify", sequence, *argv, "-o", tmp_path / "dense") == 0
    record = json.loads((tmp_path / "dense" / "run.json").read_text())
    assert record["failures"] == [] and (tmp_path / "dense" / "map_001" / "mesh.ply").exists()
    argv = ["--data.sequences", f"[{sequence}]", "--data.size", "[40, 32]", "--model.network.width", 8]
    assert lightdepth("train", *argv, "--trainer.max_steps", 2, "-o", tmp_path / "trained") == 0
    assert json.loads((tmp_path / "trained" / "run.json").read_text())["frames"] == {"train": 7, "val": 1}


def test_doctor_finds_nothing_wrong_here(capsys):
    assert lightdepth("doctor") == 0
    shown = capsys.readouterr().out
    assert "FAIL" not in shown
    for what in ("python", "open3d", "pycolmap calls", "device", "fused plane"):
        assert f"ok    {what}" in shown


def test_doctor_brings_back_what_a_killed_run_had_moved_aside_and_lists_what_it_left(tmp_path, monkeypatch, capsys):
    import densify.doctor

    monkeypatch.setattr(densify.doctor, "_fused_plane", lambda: densify.doctor.Check("fused plane", True, ""))
    (tmp_path / "runs" / ".dense.old").mkdir(parents=True)
    record = {"verb": "densify", "versions": {}, "files": {}}
    (tmp_path / "runs" / ".dense.old" / "run.json").write_text(json.dumps(record))
    (tmp_path / ".other.unfinished").mkdir()
    (tmp_path / ".other.unfinished" / "begun.json").write_text("")
    (tmp_path / ".config.old").mkdir()  # of another program
    monkeypatch.chdir(tmp_path)
    assert lightdepth("doctor") == 0
    shown = capsys.readouterr().out
    assert ".other.unfinished" in shown and ".config.old" not in shown and ".dense.old" not in shown
    assert left_in(tmp_path / "runs") == ["dense"]


def test_doctor_says_what_is_missing_and_how_to_get_it(capsys, monkeypatch):
    import densify.doctor

    monkeypatch.setattr(densify.doctor, "versions", lambda: {"python": "3.11"})
    assert lightdepth("doctor") == 4
    assert "FAIL  kornia                   missing: pip install kornia" in capsys.readouterr().out


def test_the_demo_ends_at_a_report_with_errors_against_the_truth(tmp_path):
    argv = ["--frames", 8, "--size", "[96, 80]", "--lens", "pinhole", "--checkpoint", "decline", "--seed", 3]
    assert lightdepth("demo", "-o", tmp_path / "demo", *argv) == 0
    assert {"data", "map_000", "map_001", "metrics.json", "report.html", "run.json"} <= set(left_in(tmp_path / "demo"))
    assert "Errors against the truth" in (tmp_path / "demo" / "report.html").read_text()


@pytest.mark.parametrize(("given", "had"), [(None, "1"), ("4", "4")])
def test_small_systems_are_solved_on_one_thread_unless_somebody_says_otherwise(given, had, monkeypatch, capsys):
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", given or "")
    if given is None:
        monkeypatch.delenv("OPENBLAS_NUM_THREADS")
    monkeypatch.setattr(sys, "argv", ["lightdepth", "--version"])
    assert main() == 0 and os.environ["OPENBLAS_NUM_THREADS"] == had


def test_exit_codes_reach_the_shell_without_a_traceback(tmp_path):
    command = [sys.executable, "-c", "import sys; from lightdepth.cli import main; sys.exit(main())"]
    argv = [*command, "predict", "nowhere", "-o", "out", "--checkpoint", "constant"]
    done = subprocess.run(argv, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 3 and done.stderr.startswith("lightdepth predict: nowhere: does not exist")
    assert "Traceback" not in done.stderr and left_in(tmp_path) == []
