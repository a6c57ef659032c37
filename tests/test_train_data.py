"""What training is fed with: batches, augmentation, synthetic colons, sequences and lists of frames."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from raising import refused
from scenes import cylinder
from training import CAMERA, LIGHT, batch_of, write_sequence

from lightdepth.datasets import open_sequence
from lightdepth.frame import flipped, to_batch
from lightdepth.geometry import normals_from_distance
from lightdepth.photometry import irradiance
from train.augmentation import augmented
from train.colons import TubeData
from train.datamodule import FrameData, FrameDataModule
from train.frame_lists import read_frame_list
from train.loader import collate


@pytest.mark.parametrize("axis", [0, 1])
def test_a_mirrored_batch_is_lit_as_its_mirrored_scene(axis):
    """The direct light rendered from mirrored geometry is the mirrored direct light: rays and light flipped rightly."""
    batch = batch_of()

    def lit(b):
        return irradiance(b.true_distance, normals_from_distance(b.true_distance, b.rays), b.rays, b.light)

    mirrored = flipped(batch, torch.tensor([True, False]), axis)
    before, after = lit(batch), lit(mirrored)
    assert torch.allclose(after[0], before[0].flip(-1 - axis), rtol=1e-4)
    assert torch.equal(after[1], before[1])
    assert not torch.allclose(before[0], before[0].flip(-1 - axis), rtol=1e-2)  # or this would prove nothing
    twice = flipped(mirrored, torch.tensor([True, False]), axis)
    assert all(torch.equal(a, b) for a, b in zip(twice.light, batch.light, strict=True))
    assert torch.equal(twice.rays, batch.rays) and torch.equal(twice.image, batch.image)


def test_augmentation_follows_from_the_generator_and_keeps_images_in_range():
    batch = batch_of(4)
    first, second, third = (augmented(batch, torch.Generator().manual_seed(s)) for s in (1, 1, 2))
    assert torch.equal(first.image, second.image) and not torch.equal(first.image, third.image)
    assert first.image.min() >= 0 and first.image.max() <= 1


def test_what_is_saturated_stays_saturated_however_dark_the_exposure():
    batch = batch_of(8)
    white = batch._replace(image=batch.image.clone())
    white.image[..., :9, :9] = white.image[..., -9:, -9:] = 1.0
    white.image[..., :9, -9:] = white.image[..., -9:, :9] = 1.0
    drawn = augmented(white, torch.Generator().manual_seed(0)).image
    assert (drawn[..., :9, :9] == 1).all() and (drawn < 0.97).any()


def test_synthetic_colons_follow_from_the_seed_and_validation_colons_are_others():
    def made(seed):
        data = FrameDataModule(FrameData(tube=TubeData(scenes=1, val_scenes=1, frames=2), size=(40, 32), seed=seed))
        data.setup()
        assert data.counts == {"train": 2, "val": 2}
        return data._train[0], data._val[0]

    (train_a, val_a), (train_b, _), (train_c, _) = made(0), made(0), made(1)
    assert torch.equal(train_a.image, train_b.image)
    assert not torch.equal(train_a.image, train_c.image) and not torch.equal(train_a.image, val_a.image)
    assert train_a.true_valid.any()


def test_sequences_without_a_calibration_are_read_with_the_one_that_is_given(tmp_path):
    whole = write_sequence(tmp_path / "seq")
    bare = tmp_path / "bare"
    (bare / "frames").mkdir(parents=True)
    for image in (whole / "frames").iterdir():
        (bare / "frames" / image.name).write_bytes(image.read_bytes())
    with refused(found="no camera.json"):
        FrameDataModule(FrameData([str(bare)], size=(40, 32))).setup()
    white = np.full(open_sequence(whole)[0].image.shape[:2], 255, np.uint8)
    white[:8] = 0
    cv2.imwrite(str(tmp_path / "mask.png"), white)
    given = {"camera": str(whole / "camera.json"), "light": "gamma=1.7,mu=0.5", "mask": str(tmp_path / "mask.png")}
    data = FrameDataModule(FrameData([str(bare)], size=(40, 32), **given))
    data.setup()
    batch = next(iter(data.val_dataloader()))
    assert batch.light.gamma.unique() == torch.tensor(1.7) and batch.light.mu.unique() == 0.5
    assert not batch.mask[:, :, :2].any() and batch.mask[:, :, 8:].any()
    with refused(cure="C3VD"):
        FrameDataModule(FrameData([str(bare)], size=(40, 32), format="c3vd", **given)).setup()


def test_training_frames_can_be_chosen_by_a_list(tmp_path):
    sequence = write_sequence(tmp_path / "seq")
    listed = tmp_path / "list.txt"
    listed.write_text("# chosen\n0001.png\n0004\n\n0005.png\n")
    assert read_frame_list(listed) == ["0001.png", "0004", "0005.png"]
    data = FrameDataModule(FrameData([str(sequence)], frames=str(listed), size=(40, 32)))
    data.setup()
    assert data.counts == {"train": 2, "val": 1}
    listed.write_text("0999.png\n")
    with refused(found="none of the 1 listed"):
        FrameDataModule(FrameData([str(sequence)], frames=str(listed))).setup()
    with refused(found="cannot be read"):
        FrameDataModule(FrameData([str(sequence)], frames=str(tmp_path / "no.txt"))).setup()


def test_the_last_tenth_of_a_sequence_is_held_out_unless_there_are_validation_sequences(tmp_path):
    sequence, other = (str(write_sequence(tmp_path / name, 20)) for name in ("seq", "other"))
    for val_sequences, counts in (([], {"train": 18, "val": 2}), ([other], {"train": 20, "val": 20})):
        data = FrameDataModule(FrameData([sequence], val_sequences, size=(40, 32)))
        data.setup()
        assert data.counts == counts


def test_nothing_to_train_on_is_said():
    with refused(cure="data.sequences"):
        FrameDataModule(FrameData()).setup()
    with refused(cure="val-scenes"):
        FrameDataModule(FrameData(tube=TubeData(scenes=1, frames=1), size=(20, 16))).setup()


def test_every_light_keeps_its_numbers_through_collation():
    lights = [LIGHT, replace(LIGHT, mu=0.0)]
    batch = collate([to_batch(cylinder(CAMERA).frame(light=light)) for light in lights])
    assert batch.light.mu.flatten().tolist() == pytest.approx([LIGHT.mu, 0.0])


def test_pixels_that_are_no_numbers_are_masked_out():
    frame = cylinder(CAMERA).frame(light=LIGHT)
    image = frame.image.copy()
    image[3, 4] = np.nan
    batch = to_batch(replace(frame, image=image))
    assert torch.isfinite(batch.image).all() and not batch.mask[0, 0, 3, 4] and not batch.true_valid[0, 0, 3, 4]
    assert batch.mask.sum() == to_batch(frame).mask.sum() - 1
