"""The scale of a map from the light that sits beside the lens, on colons whose geometry is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lightdepth.camera import Pinhole
from lightdepth.light import millimetres as room
from lightdepth.light.millimetres import Look, millimetres
from lightdepth.photometry import PhotometricCalibration
from lightdepth.tube import render_sequence
from tests.raising import refused

CAMERA = Pinhole(120, 96, 64.0, 64.0, 60.0, 48.0)
LIGHT = PhotometricCalibration(2.2, 1.5, (4.0, 1.5, 0.0), reflectance=0.05, source="given")


def looks_under(light: PhotometricCalibration, unit_mm: float = 1.0) -> list[Look]:
    """Looks at a colon in map units of so many millimetres."""
    looks = []
    for frame in render_sequence(7003, 8, CAMERA, 24.0, None, light).frames:
        pose = np.linalg.inv(frame.true_world_from_cam)
        pose[:3, 3] /= unit_mm
        looks.append(Look(CAMERA, pose, frame.image, frame.valid, frame.true_distance / unit_mm))
    return looks


@pytest.fixture(autouse=True)
def quick(monkeypatch) -> None:
    for name, value in (("_PLACES", 600), ("_CELL", 0.2), ("_DRAWN", 4)):
        monkeypatch.setattr(room, name, value)


def test_the_light_s_offset_tells_the_millimetres_of_a_map_unit():
    found = millimetres(looks_under(LIGHT, 2.0), LIGHT, near=2.5)
    assert found.mm_per_unit == pytest.approx(2.0, rel=0.1) and not found.refused
    assert 0 < found.deviation < 0.5 and found.views > 1000


def test_an_offset_too_small_to_be_seen_tells_nothing():
    light = replace(LIGHT, position_mm=(0.1, 0.0, 0.0))
    found = millimetres(looks_under(light), light)
    assert found.refused.startswith("shading hardly changes with the scale: the light's offset is 0.")


@pytest.mark.parametrize(
    ("light", "why"),
    [
        (replace(LIGHT, source="assumed"), "nobody gave the light"),
        (replace(LIGHT, position_mm=(0.0, 0.0, 0.0)), "the light is said to sit in the camera"),
    ],
)
def test_without_the_light_s_position_nothing_is_said(light, why):
    blank = Look(CAMERA, np.eye(4), np.zeros((96, 120, 3)), np.ones((96, 120), bool), np.ones((96, 120)))
    assert millimetres([blank] * 3, light).refused == f"{why}: its position is needed"


def test_what_shows_nothing_is_refused_with_how_much_is_needed():
    white = Look(CAMERA, np.eye(4), np.ones((96, 120, 3)), np.ones((96, 120), bool), np.ones((96, 120)))
    assert millimetres([white] * 3, LIGHT).refused.startswith("0 views of places")
    with refused(where="the looks", found="2 of them"):
        millimetres([white] * 2, LIGHT)
