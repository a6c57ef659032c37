"""What is installed is what is meant to be."""

from __future__ import annotations

import shutil
import subprocess
import sys
import tarfile
import zipfile
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("lightdepth", "densify", "train")


@pytest.fixture(scope="module")
def project(tmp_path_factory) -> Path:
    """A copy of the project with what a careless person leaves in it; no build folder is left in the project itself."""
    if find_spec("build") is None:
        pytest.skip("needs build, of the extra dev")
    copy = tmp_path_factory.mktemp("copy") / "project"
    aside = shutil.ignore_patterns(".*", "*.egg-info", "__pycache__", "runs", "build", "dist")
    shutil.copytree(ROOT, copy, ignore=aside, symlinks=True)
    shutil.rmtree(copy / "site", ignore_errors=True)
    (copy / "site").mkdir()
    (copy / "site" / "index.html").write_text("what make docs made")
    for left in ("runs/mine", "realdata", "shared/realdata"):
        (copy / left).mkdir(parents=True)
        (copy / left / "patient.png").write_bytes(b"a picture")
    return copy


def built(project: Path, out: Path, kind: str) -> Path:
    command = [sys.executable, "-m", "build", f"--{kind}", "-o", str(out), str(project)]
    if find_spec("setuptools") is not None and int(version("setuptools").split(".")[0]) >= 77:
        command.append("--no-isolation")  # else build fetches it
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    (file,) = out.iterdir()
    return file


@pytest.fixture(scope="module")
def sdist(project, tmp_path_factory) -> Path:
    return built(project, tmp_path_factory.mktemp("sdist"), "sdist")


@pytest.fixture(scope="module")
def in_sdist(sdist) -> set[str]:
    """Files in the sdist, below its one folder."""
    with tarfile.open(sdist) as archive:
        return {name.partition("/")[2] for name in archive.getnames() if archive.getmember(name).isfile()}


@pytest.fixture(scope="module")
def names(sdist, tmp_path_factory) -> list[str]:
    """Files in the wheel, built from the sdist, as an index that has no wheel for a machine would have it built."""
    folder = tmp_path_factory.mktemp("unpacked")
    with tarfile.open(sdist) as archive:
        archive.extractall(folder, filter="data")
    (project,) = folder.iterdir()
    with zipfile.ZipFile(built(project, tmp_path_factory.mktemp("wheel"), "wheel")) as archive:
        return archive.namelist()


def test_top_level_names_are_the_three_packages(names):
    top = {name.split("/")[0] for name in names}
    (info,) = (name for name in top if name.endswith(".dist-info"))
    assert top == {*PACKAGES, info} and info.startswith("lightdepth-")


def test_every_module_is_in_the_wheel_and_nothing_else_but_weights_presets_pages_and_marks(names):
    modules = {str(p.relative_to(ROOT)) for package in PACKAGES for p in (ROOT / package).rglob("*.py")}
    weights = {str(p.relative_to(ROOT)) for p in (ROOT / "lightdepth" / "weights").glob("*") if p.is_file()}
    presets = {f"lightdepth/{p.relative_to(ROOT)}" for p in (ROOT / "configs").rglob("*.yaml")}
    marks = {f"{package}/py.typed" for package in PACKAGES}
    pages = {f"lightdepth/reporting/{name}" for name in ("report.css", "scene_surface.js", "scene_viewer.js")}
    assert len(presets) > 5
    assert {n for n in names if ".dist-info/" not in n} == modules | weights | presets | pages | marks


def test_the_default_checkpoint_is_in_the_wheel(names):
    from lightdepth.checkpoint import DEFAULT_CHECKPOINT

    assert f"lightdepth/weights/{DEFAULT_CHECKPOINT}.safetensors" in names


def test_the_licence_and_the_command_are_in_the_wheel(names):
    assert any(name.endswith("licenses/LICENSE") for name in names)
    assert any(name.endswith("entry_points.txt") for name in names)


def test_the_sdist_has_tests_presets_pages_and_cards_and_nothing_of_runs_or_real_data(in_sdist):
    for part in ("tests/golden", "configs", "docs", "data", "notebooks"):
        whole = {str(p.relative_to(ROOT)) for p in (ROOT / part).rglob("*") if p.is_file() and p.suffix != ".pyc"}
        assert whole and whole <= in_sdist
    assert {f"tests/{p.name}" for p in (ROOT / "tests").glob("*.py")} <= in_sdist
    assert {"README.md", "CHANGELOG.md", "LICENSE", "constraints.txt", "pyproject.toml"} <= in_sdist
    assert {"site/index.html", "mkdocs.yml"} <= in_sdist  # to be read without a network, or made again
    assert not [name for name in in_sdist if name.endswith("patient.png") or name.startswith("runs/")]


def test_the_version_stands_in_one_place_and_the_others_agree():
    import yaml

    import densify
    import lightdepth

    here = lightdepth.__version__
    assert densify.__version__ == here == version("lightdepth")
    assert yaml.safe_load((ROOT / "CITATION.cff").read_text())["version"] == here
    headings = [line for line in (ROOT / "CHANGELOG.md").read_text().splitlines() if line.startswith("## [")]
    assert headings[0] == "## [Unreleased]"
    assert not headings[1:] or headings[1].startswith(f"## [{here}] - ")
    assert f'"{here}"' not in (ROOT / "pyproject.toml").read_text()


def test_the_hooks_before_a_commit_use_the_versions_of_the_constraints():
    import yaml

    constraints = (ROOT / "constraints.txt").read_text().splitlines()
    (repo,) = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text())["repos"]
    for hook in repo["hooks"]:
        assert set(hook["additional_dependencies"]) <= set(constraints)
