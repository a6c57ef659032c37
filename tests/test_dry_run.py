"""`--dry-run`: all that is read is checked, what would be done is said, and nothing is written."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import pytest
from training import TINY_RUN, write_sequence

from lightdepth.cli import main
from lightdepth.command_line.dry import VERBS
from lightdepth.command_line.verbs import all_verbs, parsers_of

SMALL = ["--scene.shape.step", "1.2", "--scene.shape.length", "90", "--scene.texture.resolution", "0.4"]
TUBE = ["--frames", "8", "--size", "[96, 80]", "--travel-mm", "10", "--lens", "pinhole", "--slam.keyframe-every", "1"]
DECLINE = ["--checkpoint", "decline"]


def lightdepth(*argv: object) -> int:
    """The exit code of a verb, run in this process."""
    try:
        return main([str(a) for a in argv])
    except SystemExit as stopped:
        return int(stopped.code or 0)


def all_below(folder: Path) -> dict[str, tuple[int, int]]:
    """Every file and folder with its size and when it was changed."""
    found = (Path(place) / name for place, folders, files in os.walk(folder) for name in (*folders, *files))
    return {str(path.relative_to(folder)): (path.stat().st_size, path.stat().st_mtime_ns) for path in found}


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    """A synthetic sequence with its SLAM export."""
    folder = tmp_path_factory.mktemp("data") / "seq"
    assert lightdepth("synth", "-o", folder, *TUBE, *SMALL, "--slam.kind", "independent") == 0
    return folder


@pytest.fixture(scope="module")
def frames(data, tmp_path_factory) -> Path:
    """Images and camera alone."""
    folder = tmp_path_factory.mktemp("frames") / "seq"
    folder.mkdir()
    shutil.copytree(data / "frames", folder / "frames")
    shutil.copy(data / "camera.json", folder)
    return folder


def words_of(verb: str, data: Path, frames: Path) -> list[object]:
    return {
        "predict": ["predict", data, *DECLINE],
        "densify": ["densify", data, "--map", data / "slam", *DECLINE],
        "densify without a map": ["densify", frames, *DECLINE],
        "densify a map made anew": ["densify", data, "--map", data / "slam", "--repair-map", "true", *DECLINE],
        "batch": ["batch", data.parent, "--map", "slam", "--jobs", "2", *DECLINE],
        "densify a polished map": ["densify", data, "--map", data / "slam", "--polish-map", "true", *DECLINE],
        "live": ["live", data, "--map", data / "slam", *DECLINE],
        "sparse": ["sparse", frames],
        "sparse without a camera": ["sparse", frames, "--camera", "auto"],
        "import": ["import", frames],
        "adapt": ["adapt", data, "--map", data / "slam", "--steps", "5", "--batch-size", "2"],
        "train": ["train", *TINY_RUN, "--trainer.max_steps", "7", "--data.sequences", f"[{data}]"],
        "bench": ["bench", "--checkpoints", "[decline]"],
        "bench per-frame": ["bench", "per-frame", "--checkpoints", "[decline]"],
        "bench completion": ["bench", "completion", *DECLINE],
        "bench speed": ["bench", "speed", *DECLINE],
    }[verb]


TOLD = {
    "predict": ["8 frames", "predicting 8 frames: about"],
    "densify": ["2 submaps with 10 keyframes", "8 frames", "predicting 10 keyframes by decline: about"],
    "densify without a map": ["8 frames would be mapped by pycolmap", "28 pairs", "what follows"],
    "densify a map made anew": ["the map of 10 keyframes would be made anew first"],
    "batch": ["1 sequence, none of them already made", "predicting about 10 keyframes", "those of 1 sequence"],
    "densify a polished map": ["polishing the poses of 10 keyframes", "predicting 10 keyframes by decline: about"],
    "live": ["2 submaps with 10 keyframes", "10 keyframes: about"],
    "sparse": ["8 frames would be mapped", "features of 8 frames: about"],
    "sparse without a camera": [
        "8 frames, 96x80, whose camera is found first",
        "by the motion of 8 frames",
        "cannot be told",
    ],
    "import": ["8 frames would be measured", "measuring 8 frames: about"],
    "adapt": ["to learn from", "a map of 2 submaps", "5 steps of 2 frames: about"],
    "train": [
        "15 frames to train on, 5 to validate on, 40x32",
        "2 synthetic colons to train on",
        "7 steps of 4 frames",
    ],
    "bench": ["surfaces", "made dense"],
    "bench per-frame": ["12 colons", "judging"],
    "bench completion": ["6 colons, 2 maps of each", "in every way"],
    "bench speed": ["stages of densify at 320x256, 640x512, and 4 whole runs", "timing 36 parts"],
}


@pytest.mark.parametrize("verb", TOLD)
def test_it_says_what_would_be_done_and_how_long_it_takes_and_writes_nothing(verb, data, frames, tmp_path, capsys):
    before = all_below(data), all_below(frames)
    assert lightdepth(*words_of(verb, data, frames), "-o", tmp_path / "deep" / "out", "--dry-run") == 0
    shown = capsys.readouterr().out
    for told in [*TOLD[verb], "dry run: ", f"would make {tmp_path / 'deep' / 'out'}", "written: nothing"]:
        assert told in shown, shown
    assert "estimate" in shown or "cannot be told beforehand" in shown
    assert all_below(tmp_path) == {} and (all_below(data), all_below(frames)) == before


@pytest.mark.parametrize(
    "broken",
    [
        ["predict", "HERE/nowhere", *DECLINE, "-o", "HERE/out"],
        ["predict", "DATA", "--checkpoint", "HERE/nowhere", "-o", "HERE/out"],
        ["predict", "DATA", *DECLINE, "-o", "HERE/strange"],
        ["predict", "DATA", *DECLINE, "-o", "HERE/strange", "--overwrite"],
        ["predict", "DATA", *DECLINE, "-o", "HERE/file"],
        ["predict", "DATA", *DECLINE, "-o", "HERE/file/out"],
        ["predict", "DATA", *DECLINE, "-o", "HERE/unfinished"],
        ["predict", "DATA", *DECLINE, "-o", "HERE/taken"],
        ["densify", "DATA", "--map", "HERE/file", *DECLINE, "-o", "HERE/out"],
        ["densify", "DATA", "--map", "DATA/slam", *DECLINE, "-o", "DATA", "--overwrite"],
        ["batch", "HERE/nowhere", "--map", "slam", *DECLINE, "-o", "HERE/out"],
        ["batch", "DATA/..", "--map", "slam", *DECLINE, "-o", "HERE/strange"],
        ["live", "DATA", "--map", "DATA/slam", *DECLINE, "--camera", "auto", "-o", "HERE/out"],
        ["import", "HERE/file", "-o", "HERE/out"],
        ["adapt", "DATA", "--map", "DATA/slam", "--checkpoint", "decline", "-o", "HERE/out"],
        ["adapt", "DATA", "--map", "DATA/slam", "--more", "[HERE/nowhere]", "-o", "HERE/out"],
        ["train", "--data.sequences", "[HERE/nowhere]", *TINY_RUN, "-o", "HERE/out"],
        ["train", "--data.tube.scenes", "0", "-o", "HERE/out"],
        ["train", *TINY_RUN, "-o", "HERE/strange", "--overwrite"],
        ["train", *TINY_RUN, "--trainer.devices", "[3, 3]", "-o", "HERE/out"],
        ["bench", "--checkpoints", "[HERE/nowhere]", "-o", "HERE/out"],
    ],
    ids=" ".join,
)
def test_it_is_refused_as_the_real_run_is(broken, data, tmp_path, capsys):
    (tmp_path / "strange").mkdir()
    (tmp_path / "strange" / "notes.txt").write_text("mine")
    (tmp_path / "file").write_text("no map")
    (tmp_path / ".taken.unfinished").mkdir()
    (tmp_path / ".taken.unfinished" / "theirs.txt").write_text("of another program")
    write_unfinished(tmp_path / ".unfinished.unfinished", "predict")
    given = [word.replace("HERE", str(tmp_path)).replace("DATA", str(data)) for word in broken]
    before = all_below(tmp_path), all_below(data)
    dry = lightdepth(*given, "--dry-run"), capsys.readouterr().err
    assert (all_below(tmp_path), all_below(data)) == before
    real = lightdepth(*given), capsys.readouterr().err
    refusals = [[line for line in said.splitlines() if line.startswith("lightdepth ")] for said in (dry[1], real[1])]
    assert dry[0] == real[0] == 3 and refusals[0] == refusals[1] != []


def test_that_the_light_will_tell_no_millimetres_is_known_before_the_work(data, tmp_path, capsys):
    given = ["densify", data, "--map", data / "slam", *DECLINE, "--mm-per-unit", "light", "-o", tmp_path / "out"]
    assert lightdepth(*given, "--light", "gamma=2.2,mu=0", "--dry-run") == 0
    said = capsys.readouterr().out
    assert "warning: surfaces will be in map units: the light is said to sit in the camera" in said
    assert lightdepth(*given, "--dry-run") == 0 and "will be in map units" not in capsys.readouterr().out


def write_unfinished(folder: Path, verb: str) -> None:
    """What a run that was killed left, with a finished part."""
    from lightdepth.reporting.unfinished import Part, add_part, begin

    folder.mkdir()
    (folder / "000000.npz").write_bytes(b"some")
    begin(folder, {"verb": verb, "version": "0", "arguments": {}, "inputs": {}})
    add_part(folder, Part("frames from 0", {"000000.npz": 4}), [folder / "000000.npz"])


def test_it_is_refused_where_another_run_writes_and_takes_no_lock(data, tmp_path, capsys):
    from lightdepth.files.lock import locked

    with locked(tmp_path / "out"):
        assert lightdepth("predict", data, *DECLINE, "-o", tmp_path / "out", "--dry-run") == 3
    assert "another run is writing to it (host " in capsys.readouterr().err and all_below(tmp_path) == {}


def test_it_says_what_would_be_replaced_and_what_is_finished_before(data, tmp_path, capsys):
    given = ["predict", data, *DECLINE, "--no-previews", "-o", tmp_path / "out"]
    assert lightdepth(*given) == 0
    before = all_below(tmp_path)
    assert lightdepth(*given, "--dry-run") == 3 and "already there" in capsys.readouterr().err
    assert lightdepth(*given, "--dry-run", "--overwrite") == 0
    assert "in place of the run that is there" in capsys.readouterr().out
    assert lightdepth(*given, "--dry-run", "--resume") == 0 and "already finished" in capsys.readouterr().out
    assert all_below(tmp_path) == before


def test_one_that_would_go_on_says_so_and_leaves_the_finished_parts(data, tmp_path, monkeypatch, capsys):
    import lightdepth.commands.predict as verb

    given = ["predict", data, *DECLINE, "--no-previews", "-o", tmp_path / "out"]
    monkeypatch.setattr("lightdepth.reporting.batches.SECONDS", 0.0)
    kept, seen = verb._written, []

    def dies(*arguments):
        if len(seen) == 3:
            raise KeyboardInterrupt
        seen.append(arguments)
        return kept(*arguments)

    monkeypatch.setattr(verb, "_written", dies)
    assert lightdepth(*given) == 130
    before = all_below(tmp_path)
    assert lightdepth(*given, "--dry-run", "--resume") == 0
    assert "going on from 3 finished parts" in capsys.readouterr().out and all_below(tmp_path) == before
    assert lightdepth(*given, "--dry-run") == 3 and "--overwrite starts anew" in capsys.readouterr().err


def test_a_program_reads_the_plan_as_json(data, tmp_path, capsys):
    given = ["predict", data, *DECLINE, "-o", tmp_path / "out", "--dry-run", "--json"]
    assert lightdepth(*given) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["exit_code"] == 0 and said["result"]["dry_run"] and said["files"] == [] and said["output"] is None
    assert said["result"]["estimated_seconds"] == pytest.approx(said["result"]["steps"][0]["seconds"])


def test_a_training_that_is_stopped_would_go_on_with_the_steps_that_are_left(tmp_path, capsys):
    run, data = tmp_path / "run", write_sequence(tmp_path / "seq")
    given = ["train", *TINY_RUN, "--data.sequences", f"[{data}]", "--data.tube.scenes", "0", "-o", run]
    assert lightdepth(*given, "--trainer.max_steps", "4") == 0
    before = all_below(run)
    capsys.readouterr()
    assert lightdepth("train", "-o", run, "--resume", "--trainer.max_steps", "10", "--dry-run") == 0
    shown = capsys.readouterr().out
    assert "going on: " in shown and "step 4" in shown and "6 steps of 4 frames: about" in shown
    assert all_below(run) == before


def test_the_verbs_that_take_long_take_it_and_no_others():
    parsers = {
        f"{verb} {way}".strip(): parser
        for verb, entry in all_verbs().items()
        for way, parser in parsers_of(verb, entry.load()).items()
    }
    assert {verb for verb, parser in parsers.items() if "--dry_run" in parser._option_string_actions} == VERBS
