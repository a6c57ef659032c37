"""The gate for depth: smoke and clipping are doubted, what leaves the contrast of light is not."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from lightdepth.camera import Pinhole
from lightdepth.depth_gate import DepthGate, Lit
from lightdepth.frame import Frame
from lightdepth.photometry import PhotometricCalibration

LIGHT = PhotometricCalibration(gamma=2.0)


def lit(near: float, far: float, size: tuple[int, int] = (160, 128), mask: np.ndarray | None = None) -> Frame:
    """Linear light that falls from near, at the left, to far, at the right, in equal ratios."""
    width, height = size
    row = np.exp(np.linspace(np.log(near), np.log(far), width)) ** (1 / LIGHT.gamma)
    image = np.broadcast_to(row[None, :, None], (height, width, 3)).astype(np.float32)
    camera = Pinhole(width, height, width / 2, width / 2, width / 2, height / 2)
    return Frame("000007", image, camera, LIGHT, mask)


def through_smoke(frame: Frame, share: float) -> Frame:
    linear = frame.image**LIGHT.gamma
    return replace(frame, image=(((1 - share) * linear + share * 0.3) ** (1 / LIGHT.gamma)).astype(np.float32))


@pytest.mark.parametrize("size", [(160, 128), (640, 512), (80, 64)])
def test_contrast_is_the_ratio_of_bright_to_dark_light_at_any_size(size):
    assert Lit.of(lit(0.5, 0.05, size)).contrast == pytest.approx(10**0.8, rel=0.06)


def test_brightness_alone_changes_nothing():
    assert Lit.of(lit(0.2, 0.04)).contrast == pytest.approx(Lit.of(lit(0.8, 0.16)).contrast, rel=1e-3)


def test_what_lies_outside_the_mask_does_not_count():
    mask = np.zeros((128, 160), bool)
    mask[20:100, 30:130] = True
    frame = lit(0.5, 0.05, mask=mask)
    blackened = replace(frame, image=np.where(mask[..., None], frame.image, 0).astype(np.float32))
    assert Lit.of(blackened) == Lit.of(replace(frame, image=np.where(mask[..., None], frame.image, 1)))


def test_more_smoke_leaves_less_contrast_until_it_is_doubted():
    found = [Lit.of(through_smoke(lit(0.5, 0.02), share)).contrast for share in (0, 0.3, 0.6, 0.97)]
    assert found == sorted(found, reverse=True)
    assert DepthGate().doubt(through_smoke(lit(0.5, 0.02), 0.3)) == ""
    assert "smoke" in DepthGate().doubt(through_smoke(lit(0.5, 0.02), 0.97))


def test_a_clipped_frame_is_doubted_and_says_how_much_of_it_is_white():
    frame = lit(0.5, 0.02)
    clipped = replace(frame, image=np.clip(frame.image * 8, 0, 1))
    assert "% of it is white" in DepthGate().doubt(clipped)


def test_blur_noise_and_brightness_are_no_reason_to_doubt():
    frame, rng = lit(0.5, 0.05), np.random.default_rng(0)
    blurred = replace(frame, image=cv2.GaussianBlur(frame.image, (0, 0), 6))
    noisy = replace(frame, image=(frame.image + rng.normal(0, 0.08, frame.image.shape)).clip(0, 1).astype(np.float32))
    assert [DepthGate().doubt(each) for each in (frame, blurred, noisy)] == ["", "", ""]


@pytest.mark.parametrize("image", [0.0, 1 / 255])
def test_a_black_frame_and_one_with_no_valid_pixel_are_doubted(image):
    frame = lit(0.5, 0.05)
    assert "black" in DepthGate().doubt(replace(frame, image=np.full_like(frame.image, image)))
    assert "masked" in DepthGate().doubt(replace(frame, mask=np.zeros((128, 160), bool)))


def test_a_larger_limit_doubts_more():
    frame = lit(0.5, 0.2)
    assert not DepthGate(1.3).doubt(frame) and DepthGate(3.0).doubt(frame)
