"""Refinement: the light of one image corrects a wrong start, and leaves what it cannot judge."""

import numpy as np
import pytest
import torch
from colons import colon
from raising import refused
from scenes import cylinder

from lightdepth.camera import Pinhole
from lightdepth.frame import to_batch
from lightdepth.losses import LossConfig
from lightdepth.models import ConstantModel, DeclineModel
from lightdepth.photometry import PhotometricCalibration
from lightdepth.refine import RefineConfig, RefinedModel, refine

CAMERA = Pinhole(80, 64, 60.0, 60.0, 40.0, 32.0)
LAMBERT = LossConfig(smoothness=1.0, cosine_exponent=1.0, chroma=0.0, reflectance=None, saturated=0.0)


@pytest.fixture(scope="module")
def frame():
    """The inside of a cylinder, seen by the very model that the loss has."""
    return cylinder(CAMERA).frame(light=PhotometricCalibration(gamma=2.2, mu=1.0, gain=150.0))


def relative_error(log_t: torch.Tensor, batch) -> float:
    error = (log_t - batch.true_distance.clamp(min=1e-6).log())[batch.true_valid]
    return float((error - error.median()).abs().mean())


def test_a_flat_start_finds_the_tube(frame):
    batch = to_batch(frame)
    flat = torch.zeros_like(batch.true_distance)
    config = RefineConfig(steps=150, loss=LAMBERT)
    assert relative_error(refine(flat, batch, config), batch) < 0.35 * relative_error(flat, batch)  # .28 to .06


def test_the_closed_form_of_a_colon_gets_better_without_truth():
    errors = []
    for seed in (3, 4, 5):
        frame = colon(seed).frames[0]
        batch = to_batch(frame)
        start = torch.from_numpy(DeclineModel(details=False)(frame).distance).log()[None, None]
        errors.append([relative_error(x, batch) for x in (start, refine(start, batch, RefineConfig()))])
    closed, refined = np.mean(errors, axis=0)
    assert refined < 0.95 * closed


def test_no_steps_change_nothing_and_an_anchor_holds_the_start(frame):
    batch = to_batch(frame)
    start = torch.from_numpy(DeclineModel(details=False)(frame).distance).log()[None, None]
    torch.testing.assert_close(refine(start, batch, RefineConfig(steps=0)), start)
    moved = [(refine(start, batch, RefineConfig(steps=20, anchor=a)) - start).abs().mean() for a in (0.0, 20.0)]
    assert moved[1] < 0.2 * moved[0]


def test_images_without_a_usable_pixel_keep_a_finite_start(frame):
    batch = to_batch(frame)
    start = torch.zeros_like(batch.true_distance)
    for image in (torch.zeros_like(batch.image), torch.ones_like(batch.image)):
        assert torch.isfinite(refine(start, batch._replace(image=image), RefineConfig(steps=5))).all()
    nowhere = batch._replace(mask=torch.zeros_like(batch.mask))
    assert torch.isfinite(refine(start, nowhere, RefineConfig(steps=5))).all()


def test_a_refined_model_gives_whole_predictions_at_the_frame_s_size(frame):
    config = RefineConfig(steps=10, rows=32)
    for model in (DeclineModel(), ConstantModel()):
        plain, refined = model(frame), RefinedModel(model, config)(frame)
        assert refined.distance.shape == (64, 80) and np.isfinite(refined.distance).all()
        assert refined.source == f"{model.name}, refined in 10 steps" and refined.uncertainty is None
        assert (refined.normals is None) == (plain.normals is None)
        assert np.abs(np.log(refined.distance / plain.distance)).max() > 0.01
    np.testing.assert_array_equal(RefinedModel(model, config)(frame).distance, refined.distance)


def test_settings_that_mean_nothing_are_refused():
    for wrong in ({"steps": -1}, {"rows": 4}, {"levels": 0}, {"anchor": -1.0}, {"learning_rate": 0.0}):
        with refused(cure="expected at least"):
            RefineConfig(**wrong)
