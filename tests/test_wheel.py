"""What is installed is what is meant to be."""

from __future__ import annotations

import shutil
import subprocess
import sys
import zipfile
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def names(tmp_path_factory) -> list[str]:
    """Files in the wheel, built from a copy so that no build folder is left in the project."""
    if find_spec("build") is None:
        pytest.skip("needs build, of the extra dev")
    copy, out = tmp_path_factory.mktemp("copy") / "project", tmp_path_factory.mktemp("wheel")
    aside = shutil.ignore_patterns(".*", "*.egg-info", "__pycache__", "runs", "build", "dist")
    shutil.copytree(ROOT, copy, ignore=aside)
    command = [sys.executable, "-m", "build", "--wheel", "-o", str(out), str(copy)]
    if find_spec("setuptools") is not None and int(version("setuptools").split(".")[0]) >= 77:
        command.append("--no-isolation")  # else build fetches it
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    (wheel,) = out.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        return archive.namelist()


def test_top_level_names_are_the_three_packages(names):
    top = {name.split("/")[0] for name in names}
    (info,) = (name for name in top if name.endswith(".dist-info"))
    assert top == {"lightdepth", "densify", "train", info} and info.startswith("lightdepth-")


def test_every_module_is_in_the_wheel_and_nothing_else(names):
    modules = {
        str(p.relative_to(ROOT))
        for package in ("lightdepth", "densify", "train")
        for p in (ROOT / package).rglob("*.py")
    }
    weights = {str(p.relative_to(ROOT)) for p in (ROOT / "lightdepth" / "weights").glob("*") if p.is_file()}
    assert {n for n in names if ".dist-info/" not in n} == modules | weights


def test_the_default_checkpoint_is_in_the_wheel(names):
    from lightdepth.checkpoint import DEFAULT_CHECKPOINT

    assert f"lightdepth/weights/{DEFAULT_CHECKPOINT}.safetensors" in names


def test_the_licence_and_the_command_are_in_the_wheel(names):
    assert any(name.endswith("licenses/LICENSE") for name in names)
    assert any(name.endswith("entry_points.txt") for name in names)
