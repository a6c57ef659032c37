"""The commands of the README and of the pages that teach: every one is understood, and all that take seconds on a small
colon are run, in order."""

from __future__ import annotations

import json
import re
import shlex
import shutil
from importlib import metadata
from pathlib import Path

import pytest
from colons import colon, slam

from lightdepth.camera import Pinhole
from lightdepth.cli import main
from lightdepth.command_line.parsing import parsed
from lightdepth.command_line.presets import with_preset
from lightdepth.command_line.verbs import GROUP, verb_parser
from lightdepth.datasets import write_folder
from lightdepth.tube.export import write_synthetic

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text()
TAUGHT = ("video-to-surface", "calibrating", "batch", "millimetres", "training", "evaluation", "measuring", "exporting")
PAGES = "\n".join([*((ROOT / "docs" / f"{name}.md").read_text() for name in TAUGHT), README])
BLOCKS = re.split(r"^```.*$", PAGES, flags=re.MULTILINE)[1::2]
LINES = [line for block in BLOCKS for line in block.splitlines() if line.startswith("lightdepth ")]
COMMANDS = list(dict.fromkeys(line.split(" #")[0].strip() for line in LINES))
MINUTES = (
    "bench",
    "ablate",
    "train --preset lightdepth",
    "train --preset tube_smoke -o runs/real",
    "export lightdepth-self -o runs/onnx",
)
"""Commands that take minutes: what they do is tested in modules of their own."""
OTHER_DATA = ("--suite", "calib_results.txt", "--join", "joined_000", "lightdepth select", "--data.frames", "runs/self")
OTHER_DATA += ("densify DATA", "lightdepth batch", "lightdepth scale", "--mm-per-unit light", "calibrate-light BOARD")
"""Commands on data that the colon does not give (its small frames do not match); likewise."""

PROCESSES = ("--trainer.devices",)
"""Commands that start themselves anew in further processes, and so these tests (tests/test_distributed.py has them)."""

OPEN_ENDED = ("view",)
"""Commands that work until a signal ends them; likewise."""

PLACES = {
    "FRAMES": "data",
    "OTHERS": "others",
    "SEQUENCE": "data",
    "VIDEO": "data",
    "MAP": "data/slam",
    "DATA": "made",
    "REPORT": "report",
    "PREDICTIONS": "predictions",
    "[B, C]": "[data]",
}
QUICK = {
    "train": "--trainer.max_steps 2 --trainer.val_check_interval 2 --data.tube.scenes 1 --data.tube.val_scenes 1 "
    "--data.tube.frames 4 --data.size [48,40]",
    "adapt": "--steps 2 --size [48,40] --held-out 0.4 --keep-worse",
    "synth": "--frames 8 --size [65,52] --slam.maps 1 --slam.keyframe_every 1",
}


def words_of(command: str) -> list[str]:
    return shlex.split(command, comments=True)[1:]


def test_the_pages_show_every_verb():
    shown = {words_of(command)[0] for command in COMMANDS} | set(re.findall(r"`lightdepth ([a-z-]+)", PAGES))
    told = re.findall(r"lightdepth ([a-z-]+)", PAGES)
    verbs = {entry.name for entry in metadata.entry_points(group=GROUP)}
    assert len(COMMANDS) > 40 and verbs - {"demo"} <= shown | set(told) and "make demo" in README


def test_the_readme_is_short_and_shows_pictures_that_are_there():
    shown = re.findall(r"!\[[^\]]+\]\(([^)]+)\)", README)
    assert len(README.splitlines()) <= 150 and len(shown) >= 2
    assert sum((ROOT / picture).stat().st_size for picture in shown) < 3e6


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_of_the_pages_is_understood(command):
    verb, *words = words_of(re.sub(r"\b[xyzuv]\b(?=[,\]])", "1", command))  # places are the reader's
    (entry,) = metadata.entry_points(group=GROUP, name=verb)
    if verb in ("bench", "train"):  # which parse their own words
        if verb == "train":
            from train.parser import training_parser

            parser = training_parser()
        else:
            from densify.commands import bench

            ways = {"compare": bench.compare_runs, "estimators": bench.compare_estimators}
            ways |= {"per-frame": bench.compare_per_frame, "completion": bench.compare_completions}
            ways |= {"speed": bench.measure_speed}
            name = words.pop(0) if words[0] in ways else ""
            function = ways.get(name, bench.run)
            parser = verb_parser(function, f"bench {name}".strip())
    else:
        parser = verb_parser(entry.load(), verb)
    assert parsed(parser, with_preset(verb, words, parser.error)) is not None


def test_the_commands_that_take_seconds_run_as_they_stand(tmp_path, monkeypatch):
    frames = colon(0, 8).frames
    write_synthetic(frames, slam(frames), tmp_path / "data")
    write_folder(colon(1, 4).frames, tmp_path / "others")
    camera = frames[0].camera
    assert isinstance(camera, Pinhole)
    monkeypatch.chdir(tmp_path)
    assert main(["predict", "data", "-o", "predictions", "--checkpoint", "decline", "--previews", "false"]) == 0
    made = {"name": "camera.json", "model": "PINHOLE", "width": camera.width, "height": camera.height}
    shown = {**made, "params": [camera.fx, camera.fy, camera.cx, camera.cy]}
    Path("camera.json").write_text(json.dumps({key: value for key, value in shown.items() if key != "name"}))
    run = [
        c
        for c in COMMANDS
        if not any(
            word in c for word in (*OTHER_DATA, *PROCESSES, *(f"lightdepth {m}" for m in (*MINUTES, *OPEN_ENDED)))
        )
    ]
    assert len(run) > 20
    for command in run:
        verb, *words = words_of(_on_the_colon(command))
        words += QUICK.get(verb, "").split()
        if "-o" in words:
            _make_room(verb, Path(words[words.index("-o") + 1]))
            words += ["--overwrite"]
        assert main([verb, *words]) == 0, command


def _make_room(verb: str, output: Path) -> None:
    """Removes what another verb made there: --overwrite would not."""
    record = output / "run.json"
    if record.is_file() and json.loads(record.read_text())["verb"] != verb:
        shutil.rmtree(output)


def _on_the_colon(command: str) -> str:
    """The command with the colon's folders and places in place of the reader's."""
    if "calibrate-light" in command:  # of the made frames one alone is left
        command = command.replace("DATA", "data")
    for word, place in PLACES.items():
        command = re.sub(rf"(?<![\w/]){re.escape(word)}(?![\w/])", place, command)
    command = command.replace("--start 60 --end 300", "--start 0 --end 0.3").replace("--frame 120", "--frame 5")
    pixels = re.search(r"--pixels '(.*?)'", command)
    if pixels:
        count = pixels[1].count("[") - 1
        command = command.replace(pixels[1], str([[40, 30], [60, 35], [45, 50]][:count]))
    points = re.search(r"--points '(\[\[.*?\]\])'", command)
    if points:
        command = command.replace(points[1], str(_places(points[1].count("x"))))
    return command


def _places(count: int) -> list[list[float]]:
    """Vertices of the densified colon, far from its rim."""
    from densify import read_dense_map

    vertices = read_dense_map("runs/dense/map_000").vertices
    return vertices[[len(vertices) // 2, len(vertices) // 3][:count]].tolist()
