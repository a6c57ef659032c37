"""A calibrated image, its number, and the batch made of it."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from raising import refused
from scenes import C3VD, ENDOMAPPER, LENSES, PINHOLE, cylinder, slanted_plane, sphere

from lightdepth.camera import Pinhole
from lightdepth.errors import InputError
from lightdepth.frame import Frame, brightest, check_image_size, frame_number, to_batch
from lightdepth.photometry import PhotometricCalibration

SMALL = Pinhole(8, 6, 6.0, 6.0, 4.0, 3.0)


def grey(camera=SMALL, value: float = 0.5, **more) -> Frame:
    return Frame("0001.png", np.full((camera.height, camera.width, 3), value, np.float32), camera, **more)


@pytest.mark.parametrize(
    ("name", "number"),
    [
        ("0012_color.png", 12),
        ("12_color.png", 12),
        ("0012_color", 12),
        ("0012_depth.tiff", 12),
        ("out33.png", 33),
        ("frame_000123.jpg", 123),
        ("00004584.jpg", 4584),
        ("cecum_t1_a/rgb/0007.png", 7),
        ("Seq_001\\images\\out5.png", 5),
        ("3D_maps/2/keyframe-14", 14),
        ("clip2_frame_0040.v1", 40),
        ("0000.png", 0),
    ],
)
def test_the_number_of_a_frame_is_the_last_integer_of_its_stem(name, number):
    assert frame_number(name) == number


def test_the_brightest_channel_is_the_maximum_over_channels_whatever_an_image_holds():
    image = np.random.default_rng(0).normal(size=(5, 7, 3)).astype(np.float32)
    image[1, 2, 1], image[3, 3] = np.nan, (-np.inf, np.inf, 0)
    np.testing.assert_array_equal(brightest(image), image.max(-1))
    assert brightest(image).dtype == np.float32


@pytest.mark.parametrize("name", ["mask.png", "", "seq_3/thumbnail.jpg", "video.mp4", "2024/"])
def test_names_without_a_number_are_refused_by_name(name):
    with refused(found="no number in the name") as error:
        frame_number(name)
    assert str(error.value).startswith(name)


def test_padded_and_unpadded_c3vd_names_meet():
    assert {grey().number, frame_number("1_color.png"), frame_number("0001_depth.tiff")} == {1}


def test_a_resized_image_is_refused_with_the_ratio_and_the_cure():
    with pytest.raises(InputError) as error:
        check_image_size("0001.png", 675, 540, C3VD)
    message = str(error.value)
    for part in ("0001.png", "675x540", "1350x1080", "ratio 0.5", "multiply fx, fy, cx, cy by 0.5", "width 675"):
        assert part in message


def test_a_cropped_image_is_refused_with_both_ratios():
    with pytest.raises(InputError) as error:
        check_image_size("0001.png", 1350, 1000, C3VD)
    for part in ("ratios 1 in width and 0.9259 in height", "cropped or padded", "calibration of this image format"):
        assert part in str(error.value)
    check_image_size("0001.png", 1350, 1080, C3VD)


@pytest.mark.parametrize("what", ["mask", "true_distance"])
def test_arrays_of_another_size_are_refused_with_both_sizes(what):
    with refused(found=f"{what.replace('_', ' ')} is 4x3, the image 8x6"):
        grey(**{what: np.ones((3, 4), bool if what == "mask" else np.float32)})


@pytest.mark.parametrize("shape", [(6, 8), (6, 8, 4)])
def test_images_that_are_not_rgb_are_refused(shape):
    with refused(cure="expected (H, W, 3)"):
        Frame("0001.png", np.zeros(shape, np.float32), SMALL)


def test_valid_is_the_mask_inside_the_field_of_the_lens():
    camera = ENDOMAPPER.resized(72, 54)
    mask = np.zeros((54, 72), bool)
    mask[:, :36] = True
    np.testing.assert_array_equal(grey(camera).valid, camera.rays()[1])
    np.testing.assert_array_equal(grey(camera, mask=mask).valid, mask & camera.rays()[1])


@pytest.mark.parametrize("name", LENSES)
def test_a_batch_of_one_has_the_shapes_and_types_of_its_docstring(name):
    batch = to_batch(slanted_plane(LENSES[name].resized(30, 24)).frame())
    for tensor, channels, dtype in [
        (batch.image, 3, torch.float32),
        (batch.mask, 1, torch.bool),
        (batch.rays, 3, torch.float32),
        (batch.true_distance, 1, torch.float32),
        (batch.true_valid, 1, torch.bool),
    ]:
        assert tensor.shape == (1, channels, 24, 30) and tensor.dtype == dtype
    torch.testing.assert_close(batch.rays.norm(dim=1), torch.ones(1, 24, 30))
    assert batch.light.gamma.shape == (1, 1, 1, 1) and batch.light.position.shape == (1, 3, 1, 1)


def test_a_batch_without_truth_holds_zeros_and_says_so():
    batch = to_batch(grey())
    assert (batch.true_distance == 0).all() and not batch.true_valid.any()
    assert batch.mask.all()


def test_truth_counts_only_where_it_is_a_positive_number_inside_the_mask():
    truth = np.full((6, 8), 9.0, np.float32)
    truth[0, :4] = [0, -1, np.nan, np.inf]
    mask = np.ones((6, 8), bool)
    mask[5] = False
    batch = to_batch(grey(true_distance=truth, mask=mask))
    expected = np.ones((6, 8), bool)
    expected[0, :4] = expected[5] = False
    np.testing.assert_array_equal(batch.true_valid[0, 0], expected)
    np.testing.assert_array_equal(batch.true_distance[0, 0], np.where(expected, 9, 0))


def test_channels_stay_rgb():
    image = np.zeros((6, 8, 3), np.float32)
    image[..., 0], image[2, 3] = 0.25, (0.1, 0.2, 0.3)
    batch = to_batch(Frame("0001.png", image, SMALL))
    torch.testing.assert_close(batch.image[0, :, 2, 3], torch.tensor([0.1, 0.2, 0.3]))
    assert (batch.image[0, 0, 0] == 0.25).all()


@pytest.mark.parametrize("size", [(160, 120), (64, 48), (211, 90), (640, 48)], ids=str)
def test_resizing_keeps_each_truth_one_of_the_surfaces_it_saw(size):
    """A near fold before a far wall: no distance between the two may appear."""
    truth = np.full((480, 640), 80.0, np.float32)
    truth[:, 123:301] = 5.0
    batch = to_batch(grey(PINHOLE, true_distance=truth), size)
    assert set(batch.true_distance.unique().tolist()) == {5.0, 80.0}
    assert float((batch.true_distance == 5).float().mean()) == pytest.approx(178 / 640, abs=2 / size[0])


def test_resized_truth_is_that_of_the_resized_camera():
    whole = sphere(C3VD.resized(270, 216))
    tube = cylinder(C3VD.resized(270, 216), farthest=30)
    for scene, tolerance in [(whole, 1e-6), (tube, 0.05)]:
        batch = to_batch(scene.frame(), (90, 72))
        expected = (sphere if scene is whole else cylinder)(C3VD.resized(90, 72))
        both = batch.true_valid & expected.valid
        assert both.float().mean() > 0.7
        torch.testing.assert_close(batch.true_distance[both].double(), expected.distance[both], rtol=tolerance, atol=0)


def test_resized_rays_are_those_of_the_resized_camera():
    batch = to_batch(grey(ENDOMAPPER.resized(144, 108)), (48, 36))
    rays, valid = ENDOMAPPER.resized(48, 36).rays()
    np.testing.assert_allclose(batch.rays[0].permute(1, 2, 0).numpy()[valid], rays[valid], atol=1e-6)


def test_rays_do_not_jump_at_the_end_of_the_field():
    for lens in (C3VD, ENDOMAPPER):
        rays = to_batch(grey(lens.resized(72, 54))).rays
        steps = torch.cat([rays.diff(dim=d).norm(dim=1).flatten() for d in (-1, -2)])
        assert steps.max() < 0.3  # the axis, put there instead, would be a jump of more than 1


def test_images_are_averaged_over_the_pixels_they_merge():
    image = np.random.default_rng(0).random((6, 8, 3), np.float32)
    batch = to_batch(Frame("0001.png", image, SMALL), (4, 3))
    expected = image.reshape(3, 2, 4, 2, 3).mean((1, 3))
    np.testing.assert_allclose(batch.image[0].permute(1, 2, 0), expected, atol=1e-6)


def test_a_merged_pixel_is_valid_only_when_all_of_it_is():
    mask = np.ones((6, 8), bool)
    mask[3, 5] = False
    expected = np.ones((3, 4), bool)
    expected[1, 2] = False
    np.testing.assert_array_equal(to_batch(grey(mask=mask), (4, 3)).mask[0, 0], expected)
    narrow = to_batch(grey(mask=mask), (8, 3)).mask[0, 0]  # only the height shrinks
    assert int((~narrow).sum()) == 1 and not narrow[1, 5]


def test_a_batch_moves_as_a_whole():
    batch = to_batch(grey(light=PhotometricCalibration(mu=1.0))).to("meta")
    assert all(t.device.type == "meta" for t in (batch.image, batch.rays, batch.true_valid, *batch.light))
