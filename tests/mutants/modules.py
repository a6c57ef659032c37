"""What is mutated, and the test files that may find it."""

from __future__ import annotations

from pathlib import Path

ROOT = Path(__file__).parents[2]
TESTS = ROOT / "tests"
PACKAGES = ("lightdepth", "densify", "train")

_FILES = {
    "camera": "lightdepth/camera/*.py",
    "geometry": "lightdepth/geometry.py",
    "photometry": "lightdepth/photometry.py",
    "robust": "lightdepth/robust.py",
    "alignment": "densify/alignment.py",
    "agreement": "densify/agreement.py",
    "bending": "densify/bending.py",
    "marching cubes": "densify/fusion/marching_cubes.py",
    "fusion": "densify/fusion/*.py",
    "trajectory": "densify/evaluation/trajectory.py",
    "losses": "lightdepth/losses/*.py",
    "radiosity": "lightdepth/radiosity.py",
}

TEST_FILES = """
    camera foreign_bends camera_conversion lenses calibration_formats defaults geometry photometry
    robust radiosity losses decline frame
    alignment agreement agreement_mutants agreement_parts bending metrics refine relative_pose observations
    prediction trajectory marching_cubes tiny_fusion tiny_views trajectory_paths frozen second_core compiled
    plain_fusion losses_by_hand camera_arrays highlights
"""


def mutated() -> dict[str, tuple[str, Path]]:
    """The modules by name: the room that each counts for, and its file."""
    found = {}
    for room, pattern in _FILES.items():
        for path in sorted(ROOT.glob(pattern)):
            parts = path.relative_to(ROOT).with_suffix("").parts
            found.setdefault(".".join(parts[:-1] if parts[-1] == "__init__" else parts), (room, path))
    return found


def test_files() -> list[Path]:
    return [TESTS / f"test_{name}.py" for name in TEST_FILES.split()]
