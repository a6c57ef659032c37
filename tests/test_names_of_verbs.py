"""Every verb calls its inputs by names that tell nobody, in all that it makes and in what it says of it."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
import test_names
from colons import colon, slam
from test_names import telling

from lightdepth.cli import main
from lightdepth.files.named_inputs import INPUTS
from lightdepth.tube.export import write_synthetic

CANARY = "mustermann"
"""A name of lower-case letters alone, which is hidden only because this program has no such word."""
QUICK = "--no-fit-light --no-merge --judge.on false"
FEW = "--trainer.max_steps 2 --trainer.val_check_interval 2 --data.size [48,40]"
PLACES = {"FRAMES": CANARY, "MODEL": f"{CANARY}.safetensors", "SETTINGS": f"{CANARY}.yaml", "OTHERS": f"more/{CANARY}"}


@pytest.fixture(scope="module")
def patient(tmp_path_factory) -> Path:
    """A folder of the patient's name with a sequence and its map, a run and predictions inside it, a checkpoint and
    settings, all of that name."""
    folder = tmp_path_factory.mktemp("names") / CANARY
    frames = colon(0, 8).frames
    write_synthetic(frames, slam(frames), folder / CANARY)
    write_synthetic(frames[:2], slam(frames[:2]), folder / "more" / CANARY)
    weights = Path(test_names.__file__).parents[1] / "lightdepth" / "weights"
    shutil.copy(weights / "lightdepth-self.safetensors", folder / f"{CANARY}.safetensors")
    (folder / f"{CANARY}.yaml").write_text(
        "frames: 8\nsize: [64, 52]\nslam: {maps: 1, keyframe_every: 1}\n", encoding="utf-8"
    )
    for command in (
        "predict FRAMES --checkpoint decline --no-previews -o FRAMES/predictions",
        f"densify FRAMES --map FRAMES/slam --checkpoint decline {QUICK} -o FRAMES/run",
    ):
        assert main(typed(command, folder, Path())) == 0
    return folder


def typed(command: str, folder: Path, output: Path) -> list[str]:
    for place, name in PLACES.items():
        command = command.replace(place, str(folder / name))
    return command.replace("OUT", str(output)).split()


def slow(command: str):
    return pytest.param(command, marks=pytest.mark.slow)


ROWS = [
    "import FRAMES -o OUT",
    slow("calibrate-light FRAMES --map FRAMES/slam -o OUT/light.json"),
    "calibrate-light FRAMES -o OUT/light.json",
    "convert-camera FRAMES/camera.json -o OUT/camera.yaml",
    "convert-camera FRAMES/camera.json --to vicalib -o OUT/camera.xml",
    "select FRAMES --map FRAMES/slam -o OUT/list.yaml",
    slow("live FRAMES --map FRAMES/slam --checkpoint MODEL --no-fit-light -o OUT"),
    "predict FRAMES --checkpoint MODEL --no-previews -o OUT",
    slow(f"densify FRAMES --map FRAMES/slam --checkpoint MODEL {QUICK} -o OUT"),
    "evaluate FRAMES/predictions --truth FRAMES -o OUT",
    slow("evaluate FRAMES/run --truth FRAMES -o OUT"),
    slow("evaluate FRAMES/slam --truth FRAMES -o OUT"),
    "measure FRAMES/run --frame 4 --pixels [[40,30],[60,35]] -o OUT/way.ply",
    "measure FRAMES/run --frame 4 --pixels [[40,30],[60,35]]",
    "scale FRAMES/run --light gamma=2.2,mu=0 --length.mm 5 --length.ends [[0,0,1],[0,0,2]] --length.map 0 -o OUT",
    "synth --config SETTINGS -o OUT",
    slow("sparse FRAMES --poses FRAMES/truth/poses.tum -o OUT"),
    slow(f"train --preset tube_smoke --data.sequences [FRAMES] --data.val-sequences [OTHERS] {FEW} -o OUT"),
    slow(
        "adapt FRAMES --map FRAMES/slam --checkpoint MODEL --steps 2 --size [48,40] --held-out 0.4 --keep-worse -o OUT"
    ),
    slow("bench --checkpoints [MODEL] --cases [] -o OUT"),
    "export FRAMES/predictions --to png -o OUT",
    slow("export FRAMES/predictions --to exr -o OUT"),
    "export MODEL --to safetensors -o OUT",
    slow("export MODEL --to onnx -o OUT"),
    *(f"export FRAMES/run --to {to} -o OUT" for to in ("colmap", "nerfstudio", "ply", "glb", "obj", "climb", "tum")),
    "doctor",
]


@pytest.mark.parametrize("command", ROWS)
def test_a_verb_tells_no_name_in_what_it_makes_and_says(command, patient, tmp_path, capfd):
    """With --json, when all that it says besides goes to standard error: its last lines are held against it here."""
    out = tmp_path / "out"
    if "OUT/" in command:
        out.mkdir()
    assert main([*typed(command, patient, out), "--json"]) == 0
    said = capfd.readouterr()
    assert CANARY not in (said.out + said.err).lower()
    assert telling(tmp_path, CANARY) == [] and ("OUT" not in command or any(out.iterdir()))
    found, (then, written) = json.loads(said.out), said.err.splitlines()[-2:]
    assert found["exit_code"] == 0 and found["verb"] == command.split()[0] and found["result"]
    assert then == f"next: {found['next']}"
    if "OUT" not in command:
        assert written == "written: nothing" and found["files"] == []
        return
    assert written.startswith(f"written: {found['output']}") and found["output"].startswith(str(out))
    assert set(found["files"]) == {str(p) for p in out.rglob("*") if p.is_file()}


def test_a_verb_that_is_asked_to_keeps_the_names_of_its_inputs(patient, tmp_path, capfd):
    command = "evaluate FRAMES/predictions --truth FRAMES --keep-names -o OUT"
    assert main(typed(command, patient, tmp_path / "out")) == 0
    assert CANARY in capfd.readouterr().out and "metrics.md" in telling(tmp_path / "out", CANARY)
    assert not (tmp_path / "out" / INPUTS).exists()


@pytest.mark.parametrize("kept", [False, True])
def test_a_run_s_factor_serves_a_checkpoint_whose_name_is_hidden(patient, tmp_path, kept):
    """The run says the name of the contents, with `--keep-names` the file's own; either way it is known again."""
    run = tmp_path / "run"
    keep = ["--keep-names"] if kept else []
    assert main([*typed("predict OTHERS --checkpoint MODEL --no-previews -o OUT", patient, run), *keep]) == 0
    called = json.loads((run / "run.json").read_text())["checkpoint"]
    assert (called == CANARY) is kept and (called.startswith("checkpoint-") is not kept)
    (run / "uncertainty.json").write_text(json.dumps({"checkpoint": called, "factor": 3.0}))
    for more in ([], ["--keep-names"]):
        out = tmp_path / f"out{len(more)}"
        command = typed("predict OTHERS --checkpoint MODEL --no-previews -o OUT", patient, out)
        assert main([*command, "--uncertainty", str(run), *more]) == 0
        assert json.loads((out / "run.json").read_text())["uncertainty_factor"] == 3.0
    assert (
        main(typed(f"predict OTHERS --checkpoint lightdepth-self --uncertainty {run} -o OUT", patient, run / "no")) == 3
    )
