"""Millimetres of a run's maps: which keyframes are asked, what is written, and that a refusal never has a figure."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from raising import refused

from densify import scaling
from densify.alignment import Alignment
from densify.dense_map import DenseMap, Surface
from densify.scale_file import MapScale, Scales, factor, scale_of
from densify.scale_run import LengthGiven
from densify.scaling import SeenMap, reduced
from lightdepth.camera import Pinhole
from lightdepth.cli import main
from lightdepth.datasets import FrameSequence, write_folder
from lightdepth.frame import Frame
from lightdepth.light.millimetres import Millimetres, Together
from lightdepth.photometry import PhotometricCalibration
from lightdepth.sparse_map import Keyframe, Submap

CAMERA = Pinhole(64, 48, 40.0, 40.0, 32.0, 24.0)
LIGHT = PhotometricCalibration(2.2, 1.5, (4.0, 1.5, 0.0), source="given")
NONE = np.zeros((0, 2)), np.zeros(0, int)
FLAT = "shading hardly changes with the scale: the light's offset is 10.0% of the distance"


def keyframe(number: int, along: float = 0.0) -> Keyframe:
    """A keyframe that stands so far to the side of the origin."""
    pose = np.eye(4)
    pose[0, 3] = -along
    return Keyframe(f"{number:06d}.png", CAMERA, pose, *NONE)


def frame(number: int, light: PhotometricCalibration = LIGHT) -> Frame:
    image = np.full((48, 64, 3), 0.4, np.float32)
    return Frame(f"{number:06d}", image, CAMERA, light)


def frames(count: int, light: PhotometricCalibration = LIGHT) -> FrameSequence:
    return FrameSequence([f"{i:06d}" for i in range(count)], lambda i: frame(i, light), "frames")


def ball() -> trimesh.Trimesh:
    return trimesh.creation.icosphere(3, 10.0)


def dense_map(number: int, count: int = 4) -> DenseMap:
    """The inside of a sphere of radius 10, with keyframes at its middle; the last one is in no surface."""
    keyframes = tuple(keyframe(i, i) for i in range(count))
    submap = Submap(number, keyframes, np.arange(1), np.ones((1, 3)))
    alignments = tuple(Alignment(k.name, reason="left out" * (k is keyframes[-1])) for k in keyframes)
    mesh = ball()
    colors = np.full((len(mesh.vertices), 3), 0.5)
    return DenseMap(submap, np.asarray(mesh.vertices), np.asarray(mesh.faces), colors, alignments, 0.5)


def seen(keyframes: list[Keyframe]) -> SeenMap:
    mesh = ball()
    return SeenMap(0, Surface(np.asarray(mesh.vertices), np.asarray(mesh.faces)), tuple(keyframes))


@pytest.fixture
def made(tmp_path) -> Path:
    """A run with two maps, and its frames."""
    return run_of(tmp_path, (0, 1), LIGHT)


def run_of(folder: Path, maps: tuple[int, ...], light: PhotometricCalibration) -> Path:
    write_folder([frame(i, light) for i in range(4)], folder / "data")
    for number in maps:
        dense_map(number).write(folder / "run" / f"map_{number:03d}")
    record = {"unit": "map units", "verb": "densify", "arguments": {"data": str(folder / "data")}}
    (folder / "run" / "run.json").write_text(json.dumps(record))
    return folder / "run"


@pytest.fixture
def told(monkeypatch) -> Callable[..., None]:
    """Has the light tell what it is said to tell."""

    def tell(*found: Millimetres) -> None:
        def answer(looks: object, light: object, near: object, surface: float) -> Together:
            return Together(found, np.diag([one.deviation**2 for one in found]))

        monkeypatch.setattr(scaling, "together", answer)

    return tell


def figure(mm: float, refused: str = "") -> Millimetres:
    return Millimetres(mm, 0.1, 0.05, 999, refused)


def test_a_map_is_seen_at_the_distance_of_its_surface_by_those_keyframes_that_are_in_it():
    looks = SeenMap.of(dense_map(0)).looks(frames(4), 2.2)
    assert len(looks) == 3 and looks[0].image.shape == (48, 64, 3)
    np.testing.assert_allclose(looks[0].distance, 10.0, rtol=0.02)
    ahead = looks[2].distance[24, 32]  # two to the side of the middle
    assert ahead == pytest.approx(np.sqrt(100 - 4), rel=0.02)


def test_of_many_keyframes_twelve_around_the_middle_are_taken_each_a_little_apart():
    """Thirty that stand .3 apart, of a wall 10 away: every second is .6 from the last, more than .5."""
    numbers = [k.number for k in seen([keyframe(i, 0.3 * i - 4.5) for i in range(30)])._chosen()]
    assert len(numbers) == 12 and set(np.diff(numbers)) == {2} and numbers[0] == 2
    assert [k.number for k in seen([keyframe(i) for i in range(30)])._chosen()] == [0]  # none of them moves
    assert seen([])._chosen() == []


def test_images_are_reduced_in_linear_light_and_white_where_any_pixel_was_clipped():
    camera = Pinhole(640, 480, 400.0, 400.0, 320.0, 240.0)
    image = np.full((480, 640, 3), 0.5, np.float32)
    image[:, ::2] = 0.0  # every other column is dark
    image[100, 101] = 1.0
    mask = np.ones((480, 640), bool)
    mask[200:, 3] = False
    small, found, valid = reduced(Frame("0", image, camera, LIGHT, mask), 2.0)
    assert (small.width, small.height) == (160, 120) and small.fx == pytest.approx(100.0)
    assert found[0, 0, 0] == pytest.approx(np.sqrt(0.5 * 0.25), abs=1e-4)
    assert (found[25, 25] == 1).all() and (found < 1).sum() == found.size - 3
    assert valid[:50, 0].all() and not valid[50:, 0].any() and valid[:, 1:].all()


def test_keyframes_without_an_image_are_left_out_and_where_there_is_none_that_is_said():
    assert len(seen([keyframe(i, i) for i in range(3)] + [keyframe(90, 4)]).looks(frames(3), 2.2)) == 3
    with refused(found="no frame number 91"):
        seen([keyframe(90), keyframe(91, 3)]).looks(frames(3), 2.2)


def test_the_verb_tells_each_map_with_its_interval_and_measure_reads_it(made, told, capsys):
    told(figure(2.0), figure(3.0))
    assert main(["scale", str(made)]) == 0
    assert (
        "map 1: 3 mm per map unit, nine of ten such are within 2.545 to 3.536, by the light" in capsys.readouterr().out
    )
    record = json.loads((made / "scale" / "scale.json").read_text())
    assert [one["mm_per_unit"] for one in record["maps"]] == [2.0, 3.0] and record["light"]["mu"] == 1.5
    found = scale_of(made, 0)
    assert found is not None and found.reach == pytest.approx(np.exp(0.1645))
    argv = ["measure", str(made), "--map", "0", "--points", "[[0, 0, 10], [0, 10, 0]]"]
    assert main([*argv, "-o", str(made.parent / "length.json")]) == 0
    said = capsys.readouterr().out
    assert "straight 28.3 mm (24 to 33.3)" in said
    assert "millimetres by the light; nine of ten such figures are right within the range in brackets" in said
    length = json.loads((made.parent / "length.json").read_text())
    assert length["unit"] == "mm" and length["scale"]["by"] == "the light"
    low, high = length["intervals"]["straight"]
    assert low * high == pytest.approx(length["straight"] ** 2) and low < length["straight"]
    assert main([*argv, "--mm-per-unit", "5"]) == 0  # what somebody says wins
    assert "straight 70.7 mm\n" in (said := capsys.readouterr().out) and "by the light" not in said
    assert main(["scale", str(made)]) == 0  # its own folder in the run is replaced without asking


def test_an_area_goes_with_the_square_of_the_scale(made, told, capsys):
    told(figure(2.0), figure(2.0))
    assert main(["scale", str(made)]) == 0
    assert main(["measure", str(made / "map_000"), "--points", "[[0, 0, 10]]", "--radius", "6", "--json"]) == 0
    result = json.loads("{" + capsys.readouterr().out.split("\n{", 1)[-1])["result"]
    low, high = result["intervals"]["area"]
    assert high / result["area"] == pytest.approx(np.exp(0.329)) and low * high == pytest.approx(result["area"] ** 2)
    assert result["intervals"]["outline"] is None


def test_a_run_whose_light_is_gone_is_told_by_no_other_light(made, told, capsys):
    told(figure(2.0), figure(3.0))
    record = json.loads((made / "run.json").read_text())
    record["arguments"]["light"] = str(made.parent / "gone.json")
    (made / "run.json").write_text(json.dumps(record))
    assert main(["scale", str(made)]) == 3
    assert "the light that it was made with is not found" in capsys.readouterr().err
    assert not (made / "scale").exists()
    assert main(["scale", str(made), "--light", "gamma=2.2,mu=0"]) == 0


def test_where_every_map_is_refused_it_is_4_and_no_figure_stands_anywhere(made, told, capsys):
    told(figure(2.345, FLAT), figure(2.345, FLAT))
    assert main(["scale", str(made)]) == 4
    ended = capsys.readouterr()
    said = ended.out + ended.err
    assert "no millimetres, shading hardly changes" in said and "give a known length" in said
    written = (made / "scale" / "scale.json").read_text() + (made / "scale" / "run.json").read_text()
    assert "2.34" not in said + written
    assert [one["mm_per_unit"] for one in json.loads((made / "scale" / "scale.json").read_text())["maps"]] == [None] * 2
    assert main(["measure", str(made), "--map", "0", "--points", "[[0, 0, 10], [0, 10, 0]]"]) == 0
    said = capsys.readouterr().out
    assert "straight 14.1 map units" in said and "map 0: no millimetres, shading hardly changes" in said


def test_a_scale_that_finds_nothing_leaves_the_figures_of_before(made, told, capsys):
    told(figure(2.0), figure(3.0))
    assert main(["scale", str(made)]) == 0 and main(["scale", str(made), "-o", str(made.parent / "own")]) == 0
    before = (made / "scale" / "scale.json").read_text()
    told(figure(2.345, FLAT), figure(2.345, FLAT))
    capsys.readouterr()
    assert main(["scale", str(made)]) == 4
    ended = capsys.readouterr()
    assert "map 1: no millimetres, shading hardly changes" in ended.out
    assert "keeps the figures that it had" in ended.err.splitlines()[-1]
    assert main(["scale", str(made), "-o", str(made.parent / "own"), "--overwrite"]) == 4
    for folder in (made / "scale", made.parent / "own"):
        assert (folder / "scale.json").read_text() == before and json.loads((folder / "run.json").read_text())
    assert sorted(p.name for p in made.iterdir()) == ["map_000", "map_001", "run.json", "scale"]
    (made / "scale" / "scale.json").write_text("spoilt")
    shutil.rmtree(made.parent / "own")
    assert main(["scale", str(made), "-o", str(made.parent / "own")]) == 4
    assert json.loads((made.parent / "own" / "scale.json").read_text())["maps"][0]["mm_per_unit"] is None


def test_a_scale_that_replaces_other_figures_says_in_one_line_which(made, told, capsys):
    told(figure(2.0), figure(3.0))
    assert main(["scale", str(made)]) == 0 and "replaces the" not in capsys.readouterr().out
    assert main(["scale", str(made)]) == 0 and "replaces the" not in capsys.readouterr().out  # by the same ones
    told(figure(2.5), figure(3.0, FLAT))
    assert main(["scale", str(made)]) == 0
    line = "replaces the scale of before: map 0 had 2 mm per map unit, now 2.5; map 1 had 3 mm per map unit, now none"
    assert line in capsys.readouterr().out.splitlines()
    assert json.loads((made / "scale" / "run.json").read_text())["replaced"] == {"0": 2.0, "1": 3.0}


def test_both_refusals_of_a_scale_have_one_form_and_a_question_is_no_end_of_a_sentence(made, told, capsys):
    """The first folder has no figures, the second has some that it keeps."""
    elsewhere = "the light shines from elsewhere: the images put it 30 degrees around the axis from its place"
    refused_twice = figure(2.345, elsewhere), figure(2.345, FLAT)
    why = f"no map has a scale; map 0: no millimetres, {elsewhere}; check position_mm in light.json: is it this "
    why += "endoscope's, in camera axes?"
    for ending in ("has the reason of each map", "keeps the figures that it had"):
        told(*refused_twice)
        capsys.readouterr()
        assert main(["scale", str(made)]) == 4
        ended = capsys.readouterr()
        assert ended.err.splitlines()[-1] == f"lightdepth scale: {why} {made / 'scale'} {ending}"
        assert ended.out.splitlines()[0].startswith(f"map 1: no millimetres, {FLAT}")
        told(figure(2.0), figure(3.0))
        assert main(["scale", str(made)]) == 0


def test_the_reason_of_a_run_of_one_map_is_told_once(tmp_path, told, capsys):
    told(figure(2.345, FLAT))
    made = run_of(tmp_path, (0,), LIGHT)
    assert main(["scale", str(made)]) == 4
    ended = capsys.readouterr()
    assert (ended.out + ended.err).count("shading hardly changes") == 1
    assert "shading hardly changes" in (made / "scale" / "log.txt").read_text()


def test_one_map_with_a_figure_is_0_and_the_other_is_warned_of(made, told, capsys):
    told(figure(2.0), figure(3.0, FLAT))
    assert main(["scale", str(made), "-o", str(made.parent / "other")]) == 0
    assert "warning: map 1: no millimetres" in capsys.readouterr().out and not (made / "scale").exists()
    assert main(["scale", str(made), "-o", str(made.parent / "other")]) == 3  # only its own folder is replaced


@pytest.mark.parametrize(
    ("light", "why"),
    [
        (replace(LIGHT, position_mm=(0.0, 0.0, 0.0)), "the light is said to sit in the camera"),
        (replace(LIGHT, source="assumed"), "nobody gave the light"),
        (LIGHT, "0 views of places are even"),  # nothing has a colour here
    ],
)
def test_what_the_light_really_refuses_reaches_the_user(light, why, tmp_path, capsys):
    run = run_of(tmp_path, (0,), light)
    assert main(["scale", str(run)]) == 4
    ended = capsys.readouterr()
    assert why in ended.out + ended.err
    (one,) = json.loads((run / "scale" / "scale.json").read_text())["maps"]
    assert (one["mm_per_unit"], one["interval"]) == (None, None) and one["cure"]


def test_a_light_that_is_refused_beside_a_length_is_told_in_the_file_and_on_the_terminal(made, capsys):
    argv = ["--length.ends", "[[0, 0, 5], [0, 3, 9]]", "--length.mm", "10", "--length.map", "1"]
    assert main(["scale", str(made), "--light", "gamma=2.2,mu=0", *argv]) == 0
    (line,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith("map 1: 2 mm per map unit")]
    assert "by a known length; the light tells none, the light is said to sit in the camera" in line
    assert line.endswith("say in light.json where it sits: position_mm, in camera axes")
    file = made / "scale" / "scale.json"
    record = json.loads(file.read_text())
    one = record["maps"][1]
    assert one["refused"] == "" and "sit in the camera" in one["light_refused"] and "position_mm" in one["cure"]
    assert scale_of(made, 1) == MapScale(**one | {"interval": tuple(one["interval"])})
    for each in record["maps"]:
        del each["light_refused"]  # as earlier versions wrote it
    file.write_text(json.dumps(record))
    found = scale_of(made, 1)
    assert found is not None and found.mm_per_unit == 2 and found.light_refused == ""


def test_a_given_light_wins_and_a_length_tells_its_map_where_the_light_tells_none(made, capsys):
    argv = ["--length.ends", "[[0, 0, 5], [0, 3, 9]]", "--length.mm", "10", "--length.map", "1"]
    assert main(["scale", str(made), "--light", "gamma=2.2,mu=0", *argv]) == 0
    record = json.loads((made / "scale" / "scale.json").read_text())
    assert [one["mm_per_unit"] for one in record["maps"]] == [None, 2.0]
    assert record["maps"][1]["by"] == "a known length" and record["length"] == {
        "map": 1,
        "ends": [[0.0, 0.0, 5.0], [0.0, 3.0, 9.0]],
        "units": 5.0,
        "mm": 10.0,
        "error_mm": 1.0,
    }
    assert record["light"]["mu"] == 0 and "sit in the camera" in record["maps"][0]["refused"]


@pytest.mark.parametrize(
    ("given", "why"),
    [
        (LengthGiven(mm=5.0), "no two places"),
        (LengthGiven(ends=[(0, 0, 0), (1, 0, 0)], map=0), "no distance"),
        (LengthGiven(ends=[(0, 0, 0)], mm=5.0, map=0), "no two places"),
        (LengthGiven(error_mm=1.0), "without places"),
        (LengthGiven(ends=[(0, 0, 0), (1, 0, 0)], mm=5.0), "the run has maps [0, 2]"),
        (LengthGiven(ends=[(0, 0, 0), (1, 0, 0)], mm=5.0, map=1), "no map 1"),
        (LengthGiven(ends=[(1, 0, 0), (1, 0, 0)], mm=5.0, map=0), "0 map units"),
    ],
)
def test_a_length_that_says_too_little_is_refused(given, why):
    with refused(found=why):
        given.known([0, 2], Path("run"))


def test_a_length_far_from_the_surface_that_it_is_said_to_be_on_is_refused(made, capsys):
    argv = ["scale", str(made), "--length.mm", "10", "--length.map", "1", "--length.ends"]
    assert main([*argv, "[[0, 0, 9], [0, 0, 30]]"]) == 3 and not (made / "scale").exists()
    said = capsys.readouterr().err
    assert "--length.ends [0.0, 0.0, 30.0]: it is 20 from the surface of map 1" in said and "[0.0, 0.0, 10.0]" in said


def test_a_length_whose_error_is_no_smaller_than_itself_is_refused_and_of_any_other_the_interval_is_finite():
    given = LengthGiven(ends=[(0, 0, 0), (1, 0, 0)], mm=5.0, error_mm=5.0)
    with refused(found="a standard error of 5 mm", cure="below the length"):
        given.known([0], Path("run"))
    known = replace(given, error_mm=4.9).known([0], Path("run"))
    assert known is not None and np.isfinite(known.alone(figure(1.0)).interval).all()


def test_what_is_no_run_in_map_units_is_refused(made, capsys):
    assert main(["scale", str(made / "map_000")]) == 3 and "the folder of one map" in capsys.readouterr().err
    (made / "run.json").write_text(json.dumps({"unit": "mm"}))
    assert main(["scale", str(made)]) == 3 and "in mm already" in capsys.readouterr().err
    (made / "run.json").write_text(json.dumps({"unit": "map units"}))
    assert main(["scale", str(made)]) == 3 and "give them: --data FRAMES" in capsys.readouterr().err


@pytest.mark.parametrize("text", ["", "[]", '{"maps": 3}', '{"maps": [{"map": 0}]}', "\xff"])
def test_a_spoilt_scale_file_is_named(made, text):
    (made / "scale.json").write_text(text, encoding="latin-1")
    with refused(where="scale.json"):
        scale_of(made, 0)


def test_a_joined_surface_has_the_scale_of_the_map_whose_unit_it_is_in(made):
    dense_map(0).write(made / "joined_000")
    Scales((MapScale(0, 2.0, (1.0, 4.0)), MapScale(1, 3.0, (2.0, 4.5)))).write_file(made, "map units", LIGHT)
    assert scale_of(made / "joined_000", 0) is None  # the run does not say
    merged = {"joined": [{"folder": "joined_000", "unit_of": 1}]}
    (made / "run.json").write_text(json.dumps({"unit": "map units", "merge": merged}))
    found = scale_of(made / "joined_000", 0)
    assert found is not None and found.map == 1 and found.reach == 1.5


def test_a_factor_is_of_all_maps_or_of_each():
    assert [factor(None, 3), factor(2.5, 3), factor({3: 4.0}, 3), factor({3: 4.0}, 5)] == [1.0, 2.5, 4.0, 1.0]
