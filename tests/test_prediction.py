"""What a model says about one frame, and its file."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from raising import refused
from scenes import LENSES, slanted_plane

from lightdepth.prediction import DepthPrediction, read_prediction


def full_prediction(name: str = "c3vd") -> DepthPrediction:
    rng = np.random.default_rng(0)
    scene = slanted_plane(LENSES[name].resized(45, 36))
    return replace(
        scene.prediction(),
        unit="mm",
        source="tiny-synthetic",
        albedo=rng.random((36, 45, 3)).astype(np.float32),
        normals=scene.normals[0].permute(1, 2, 0).numpy().astype(np.float32),
        uncertainty=rng.random((36, 45)).astype(np.float32),
    )


@pytest.mark.parametrize("name", LENSES)
def test_a_prediction_survives_its_file(tmp_path, name):
    prediction = full_prediction(name)
    prediction.save(tmp_path / "0000_color.npz")
    again = read_prediction(tmp_path / "0000_color.npz")
    for key in ("name", "unit", "source", "camera"):
        assert getattr(again, key) == getattr(prediction, key)
    for key in ("distance", "valid", "uncertainty"):
        np.testing.assert_array_equal(getattr(again, key), getattr(prediction, key))
    for key in ("albedo", "normals"):  # stored in half precision, read in single
        np.testing.assert_allclose(getattr(again, key), getattr(prediction, key), atol=1e-3)
    for key in ("distance", "albedo", "normals", "uncertainty"):
        assert getattr(again, key).dtype == np.float32


def test_what_a_model_does_not_estimate_stays_none(tmp_path):
    slanted_plane(LENSES["pinhole"].resized(20, 15)).prediction().save(tmp_path / "a.npz")
    again = read_prediction(tmp_path / "a.npz")
    assert again.albedo is again.normals is again.uncertainty is None
    assert again.unit == "up to scale"


def test_scaling_multiplies_the_distance_and_nothing_else():
    prediction = full_prediction()
    scaled = prediction.scaled(2.5)
    np.testing.assert_allclose(scaled.distance, prediction.distance * 2.5, rtol=1e-6)
    assert scaled.distance.dtype == np.float32
    assert scaled.valid is prediction.valid and scaled.normals is prediction.normals


@pytest.mark.parametrize("wrong", [{"distance": np.ones((9, 9), np.float32)}, {"valid": np.ones((36, 45), np.uint8)}])
def test_shapes_and_types_are_checked_at_birth(wrong):
    with pytest.raises(AssertionError):
        replace(full_prediction(), **wrong)


def saved(path, **changes) -> None:
    """A prediction's file with some of its arrays replaced, or left out where None."""
    full_prediction().save(path)
    with np.load(path) as data:
        arrays = {**data, **changes}
    np.savez(path, **{key: value for key, value in arrays.items() if value is not None})


def broken_meta(**changes) -> np.ndarray:
    camera = {"model": "PINHOLE", "width": 45, "height": 36, "params": [1, 1, 1, 1]}
    return np.array(json.dumps({"name": "a", "unit": "mm", "source": "b", "camera": camera, **changes}))


CORRUPT = {
    "empty": lambda path: path.write_bytes(b""),
    "text": lambda path: path.write_text("distance 12"),
    "truncated": lambda path: (full_prediction().save(path), path.write_bytes(path.read_bytes()[:2000])),
    "another array": lambda path: np.save(path.open("wb"), np.ones(3)),
    "another npz": lambda path: np.savez(path, depth=np.ones(3)),
    "no distance": lambda path: saved(path, distance=None),
    "of another shape": lambda path: saved(path, distance=np.ones((3, 4), np.float32)),
    "unknown array": lambda path: saved(path, colour=np.ones(3)),
    "meta not JSON": lambda path: saved(path, meta=np.array("{")),
    "meta a list": lambda path: saved(path, meta=np.array("[1]")),
    "no camera": lambda path: saved(path, meta=broken_meta(camera={"width": 45, "height": 36, "params": []})),
    "pickled": lambda path: saved(path, albedo=np.array([{}], dtype=object)),
}


@pytest.mark.parametrize("how", CORRUPT)
def test_a_file_that_is_no_prediction_is_refused_by_name(tmp_path, how):
    path = tmp_path / "bad.npz"
    CORRUPT[how](path)
    with refused(where="bad.npz", found="not a prediction", cure="`lightdepth predict`"):
        read_prediction(path)


def test_a_prediction_that_is_not_there_is_refused_by_name(tmp_path):
    with refused(where="none.npz", found="cannot be read"):
        read_prediction(tmp_path / "none.npz")


def test_bytes_gone_bad_inside_the_file_are_refused(tmp_path):
    path = tmp_path / "bad.npz"
    full_prediction().save(path)
    content = bytearray(path.read_bytes())
    for start in range(200, len(content) - 400, 150):
        content[start : start + 8] = b"\xff" * 8
    path.write_bytes(content)
    with refused(found="not a prediction"):
        read_prediction(path)
