"""A folder with a user's own train.py, densify.py and data/ breaks no verb, however lightdepth is started."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from lightdepth.command_line.own_packages import own_packages_first

HOME = Path(__file__).resolve().parents[1]
SCRIPT = [str(Path(sys.executable).with_name("lightdepth"))]
MODULE = [sys.executable, "-m", "lightdepth"]
SPAWNED = [
    sys.executable,
    "-c",
    "import multiprocessing, sys\n"
    "multiprocessing.set_start_method('spawn')\n"
    "from lightdepth.cli import main\n"
    "sys.exit(main())",
]
TWO_STEPS = ["--data.size", "[32, 24]", "--data.tube.scenes", "1", "--data.tube.val_scenes", "1"]
TWO_STEPS += ["--data.tube.frames", "4", "--data.batch_size", "2", "--model.network.width", "1"]
TWO_STEPS += ["--trainer.max_steps", "2", "--trainer.val_check_interval", "2", "--data.num_workers", "2"]


@pytest.fixture
def folder(tmp_path) -> Path:
    """A project of the user's."""
    for name in ("train", "densify"):
        (tmp_path / f"{name}.py").write_text(f"raise SystemExit('the user\\'s {name}.py has run')\n")
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "__init__.py").write_text("raise SystemExit('the user\\'s data has run')\n")
    return tmp_path


def run(start: list[str], *argv: str, folder: Path, here: bool) -> subprocess.CompletedProcess[str]:
    """A process in the user's folder; `here` puts that folder on the path."""
    if start is SCRIPT and not Path(SCRIPT[0]).exists():
        pytest.skip("lightdepth is not installed as a script")
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"} | ({"PYTHONPATH": "."} if here else {})
    return subprocess.run([*start, *argv], cwd=folder, env=environment, capture_output=True, text=True, check=False)


@pytest.mark.parametrize("here", [False, True], ids=["", "PYTHONPATH=."])
@pytest.mark.parametrize("start", [SCRIPT, MODULE], ids=["script", "python -m"])
def test_verbs_are_found_past_files_of_their_names(start, here, folder):
    """The list of verbs has the line of each from its module, for which its package is loaded."""
    done = run(start, "--help", folder=folder, here=here)
    assert done.returncode == 0 and done.stderr == "", done.stderr
    told = {verb: words for verb, *words in map(str.split, done.stdout.splitlines()[2:-2])}
    assert told["densify"] and told["train"]


def test_a_verb_runs_past_files_of_its_name(folder):
    done = run(MODULE, "densify", "--help", folder=folder, here=True)
    assert done.returncode == 0 and "usage: lightdepth densify" in done.stdout, done.stderr


def test_loader_workers_that_are_spawned_find_our_packages(folder):
    """What is unpickled in a worker is imported by name there, with the path that the worker was handed."""
    program = (
        "import multiprocessing\n"
        "from importlib.util import find_spec\n"
        "from lightdepth.command_line.own_packages import own_packages_first\n"
        "own_packages_first()\n"
        "with multiprocessing.get_context('spawn').Pool(1) as pool:\n"
        "    print(pool.apply(find_spec, ('train',)).origin)\n"
    )
    done = run([sys.executable, "-c", program], folder=folder, here=True)
    assert done.stdout.strip() == str(HOME / "train" / "__init__.py"), done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("here", [False, True], ids=["", "PYTHONPATH=."])
@pytest.mark.parametrize("start", [SCRIPT, MODULE, SPAWNED], ids=["script", "python -m", "spawned workers"])
def test_training_with_two_workers_runs_past_files_of_its_names(start, here, folder):
    done = run(start, "train", "--preset", "tube_smoke", *TWO_STEPS, "-o", "out", folder=folder, here=here)
    assert done.returncode == 0, done.stderr
    assert (folder / "out" / "model.safetensors").is_file()


def test_the_user_s_folder_goes_to_the_end_and_the_rest_keeps_its_order(folder, monkeypatch):
    before = [str(folder), "/first", str(HOME), "/last"]
    monkeypatch.setattr(sys, "path", list(before))
    own_packages_first()
    assert sys.path == ["/first", str(HOME), "/last", str(folder)]
    own_packages_first()
    assert sys.path == ["/first", str(HOME), "/last", str(folder)]


def test_a_path_without_files_of_our_names_stays_as_it_is(tmp_path, monkeypatch):
    (tmp_path / "train").mkdir()  # a folder with data, no package
    monkeypatch.setattr(sys, "path", [str(tmp_path), "/first"])
    own_packages_first()
    assert sys.path == [str(tmp_path), "/first"]


def test_a_module_of_our_name_that_is_loaded_already_is_said(folder):
    (folder / "train.py").write_text("")
    program = "import train, sys\nfrom lightdepth.cli import main\nsys.exit(main(['train', '--help']))"
    done = run([sys.executable, "-c", program], folder=folder, here=True)
    assert done.returncode == 3 and "train.py: loaded under the name 'train'" in done.stderr
    assert "Traceback" not in done.stderr
