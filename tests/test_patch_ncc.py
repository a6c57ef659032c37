"""The correlation of patches, against SciPy's bilinear values and NumPy's coefficient."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import map_coordinates

from lightdepth.patch_ncc import ncc

GRID = np.stack(np.meshgrid(np.arange(-3, 4), np.arange(-3, 4)), -1).reshape(-1, 2).astype(float)


def patches(image: np.ndarray, middle: np.ndarray, beside: np.ndarray) -> np.ndarray:
    """Values (n, k, q), bilinear in double precision."""
    at = middle[:, :, None] + GRID @ beside
    return map_coordinates(image.astype(float), [at[..., 1], at[..., 0]], order=1)


def placed(middle: np.ndarray, beside: np.ndarray, apart: float = 2.0) -> np.ndarray:
    """As `ncc` takes it: pixels from the image's corner."""
    return np.concatenate([middle[:, :, None], middle[:, :, None] + apart * beside], 2) + 0.5


@given(seed=st.integers(0, 2**32 - 1), turn=st.floats(-3, 3), size=st.floats(0.3, 1.6))
@settings(max_examples=40, deadline=None)
def test_it_is_the_correlation_of_bilinear_values(seed, turn, size):
    rng = np.random.default_rng(seed)
    image = rng.normal(-2, 1, (31, 37)).astype(np.float32)
    middle = rng.uniform((0, 0), (37, 31), (5, 6, 2))
    c, s = size * np.cos(turn), size * np.sin(turn)
    beside = np.array([[c, s], [-s, c]]) + rng.normal(0, 0.02, (5, 6, 2, 2))
    own = rng.normal(0, 1, (5, len(GRID)))
    own -= own.mean(1, keepdims=True)
    known, usable = rng.uniform(size=(5, 6)) < 0.8, rng.uniform(size=image.shape) < 0.8
    found, seen = ncc(image, usable, placed(middle, beside), known, own, 2.0)
    at = middle[:, :, None] + GRID @ beside
    within = ((at > 1e-9) & (at < (36 - 1e-9, 30 - 1e-9))).all((2, 3))
    column, row = np.moveaxis((middle + 0.5).astype(int).clip(0, (36, 30)), -1, 0)
    assert (seen == (known & within & usable[row, column])).all()
    values = patches(image, middle, beside)
    for i, j in np.ndindex(seen.shape):
        expected = np.corrcoef(values[i, j], own[i])[0, 1] if seen[i, j] else 0
        assert found[i, j] == pytest.approx(expected, abs=2e-5)


def test_a_patch_that_ends_at_the_images_last_pixel_is_seen_and_reads_no_further():
    image = np.arange(64, dtype=np.float32).reshape(8, 8) ** 1.5
    own = image[1:, 1:].reshape(1, -1) - image[1:, 1:].mean()
    middle, all_of_it = np.array([[[4.0, 4.0]], [[4.1, 4.0]]]), np.ones((8, 8), bool)
    found, seen = ncc(image, all_of_it, placed(middle, np.eye(2)[None, None]), np.ones((2, 1), bool), own[[0, 0]], 2.0)
    assert found[0, 0] == pytest.approx(1, abs=1e-6) and seen.tolist() == [[True], [False]]


@pytest.mark.parametrize("flat", ["image", "patch"])
def test_what_is_flat_is_like_nothing(flat):
    rng = np.random.default_rng(0)
    image = np.full((9, 9), -1.7, np.float32) if flat == "image" else rng.normal(size=(9, 9)).astype(np.float32)
    own = rng.normal(size=(1, 49)) if flat == "image" else np.zeros((1, 49))
    three = placed(np.full((1, 1, 2), 4.0), np.array([[0.9, 0.1], [-0.1, 0.9]])[None, None])
    score, seen = ncc(image, np.ones((9, 9), bool), three, np.ones((1, 1), bool), own - own.mean(), 2.0)
    assert score[0, 0] == 0 and seen.all()


def test_places_that_are_no_numbers_are_not_seen():
    three = np.full((1, 2, 3, 2), 4.0)
    three[0, 0, 0, 0], three[0, 1, 2, 1] = np.nan, np.inf
    score, seen = ncc(
        np.ones((9, 9), np.float32), np.ones((9, 9), bool), three, np.ones((1, 2), bool), np.ones((1, 9)), 2.0
    )
    assert not seen.any() and not score.any()
