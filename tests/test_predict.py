import numpy as np
import pytest
import torch
from scenes import cylinder, slanted_plane, sphere

from lightdepth.camera import KannalaBrandt, Pinhole
from lightdepth.frame import Frame
from lightdepth.models import ConstantModel, DeclineModel, NetworkModel, predict, working_size
from lightdepth.network import NetworkConfig, build_network
from lightdepth.photometry import PhotometricCalibration

PINHOLE = Pinhole(160, 120, 90.0, 90.0, 80.0, 60.0)
FISHEYE = KannalaBrandt(150, 120, 70.0, 70.0, 75.0, 60.0, -0.13, -0.005, 0.0015, -0.0001)


def network_model(rows: int = 32, **config) -> NetworkModel:
    torch.manual_seed(0)
    return NetworkModel(build_network(NetworkConfig(width=4, **config)), rows, "test")


def models():
    return [DeclineModel(rows=64), ConstantModel(), network_model(), network_model(output="absolute")]


@pytest.mark.parametrize("model", models(), ids=lambda m: m.name)
@pytest.mark.parametrize("camera", [PINHOLE, FISHEYE], ids=lambda c: c.name)
def test_every_model_predicts_at_the_frames_own_size(model, camera):
    frame = cylinder(camera).frame("0007_color.png")
    prediction = model(frame)
    assert prediction.distance.shape == (camera.height, camera.width)
    assert prediction.distance.dtype == np.float32
    assert prediction.camera == camera
    assert (prediction.name, prediction.source, prediction.unit) == ("0007_color.png", model.name, "up to scale")
    assert np.isfinite(prediction.distance).all() and (prediction.distance > 0).all()


def test_the_closed_form_is_right_up_to_scale_where_its_assumption_holds():
    """A sphere seen from its centre faces the light everywhere."""
    frame = sphere(PINHOLE, radius=7.0).frame(light=PhotometricCalibration(gain=30.0))
    prediction = DeclineModel(rows=64)(frame)
    assert np.allclose(prediction.distance[prediction.valid], 7.0, rtol=0.02)


def test_a_nearer_wall_is_nearer_whatever_the_lens():
    for camera in (PINHOLE, FISHEYE):
        scene = cylinder(camera)
        prediction = DeclineModel()(scene.frame())
        truth = scene.distance[0, 0].numpy()
        both = prediction.valid & scene.valid[0, 0].numpy()
        ranks = [np.argsort(np.argsort(d[both])) for d in (prediction.distance, truth)]
        assert np.corrcoef(*ranks)[0, 1] > 0.8


def test_a_small_working_size_hardly_changes_the_closed_form():
    frame = slanted_plane(PINHOLE).frame(light=PhotometricCalibration(gain=60.0))
    full, small = DeclineModel(rows=120)(frame), DeclineModel(rows=40)(frame)
    ratio = np.log(full.distance / small.distance)[full.valid]
    assert np.median(np.abs(ratio)) < 0.01 and np.quantile(np.abs(ratio), 0.99) < 0.1


def test_a_network_that_corrects_nothing_agrees_with_the_closed_form():
    model = network_model(rows=60, blur=0.018)
    torch.nn.init.zeros_(model.network.body.head.weight)
    frame = cylinder(PINHOLE).frame()
    expected = DeclineModel(rows=60)(frame)
    prediction = model(frame)
    assert np.allclose(prediction.distance[prediction.valid], expected.distance[expected.valid], rtol=1e-3)


def test_black_pixels_and_masked_pixels_are_not_valid():
    scene = sphere(PINHOLE)
    frame = scene.frame()
    image, mask = frame.image.copy(), np.ones((120, 160), bool)
    image[:10] = 0
    mask[:, :20] = False
    masked = Frame("1", image, PINHOLE, frame.light, mask)
    for model in models():
        valid = model(masked).valid
        assert not valid[:10].any() and not valid[:, :20].any() and valid[10:, 20:].all()


def test_the_rim_of_the_mask_is_predicted_from_inside_it():
    """Coarse pixels that merge masked ones are invalid; the full-size rim inside them must not show it."""
    scene = sphere(PINHOLE, radius=7.0)
    frame = scene.frame(light=PhotometricCalibration(gain=30.0))
    v, u = np.mgrid[:120, :160]
    mask = np.hypot(u - 80, v - 60) < 57.3
    masked = Frame("1", frame.image * mask[..., None], PINHOLE, frame.light, mask)
    prediction = DeclineModel(rows=30)(masked)
    assert np.allclose(prediction.distance[prediction.valid], 7.0, rtol=0.05)


def test_normals_and_albedo_come_at_full_size_and_can_be_left_out():
    scene = slanted_plane(PINHOLE, normal=(0.2, 0.1, -1.0))
    for model in (DeclineModel(), network_model()):
        prediction = model(scene.frame())
        assert prediction.normals.shape == prediction.albedo.shape == (120, 160, 3)
        assert np.allclose(np.linalg.norm(prediction.normals, axis=-1), 1, atol=1e-4)
        assert ((prediction.normals * PINHOLE.rays()[0]).sum(-1) < 0.05).all()
        assert prediction.albedo.min() >= 0 and prediction.albedo.max() <= 1.0001
        model.details = False
        lean = model(scene.frame())
        assert lean.normals is None and lean.albedo is None
        assert np.array_equal(lean.distance, prediction.distance)


def test_the_closed_forms_albedo_is_the_colour_of_the_wall():
    colour = torch.tensor([1.0, 0.4, 0.3]).reshape(1, 3, 1, 1)
    light = PhotometricCalibration(gain=60.0)
    image = sphere(PINHOLE).image(light, colour)[0].permute(1, 2, 0).clamp(0, 1).numpy().astype(np.float32)
    prediction = DeclineModel()(Frame("1", image, PINHOLE, light))
    assert np.allclose(prediction.albedo, colour.flatten().numpy(), atol=0.01)


def test_a_calibration_with_twice_the_gain_puts_the_scene_further_by_root_two():
    scene = cylinder(PINHOLE)
    frame = scene.frame()
    brighter = Frame("1", frame.image, PINHOLE, PhotometricCalibration(gain=200.0))
    for model in (DeclineModel(), network_model()):
        assert np.allclose(model(brighter).distance, model(frame).distance * np.sqrt(2), rtol=1e-4)


def test_working_size_keeps_the_aspect():
    assert working_size(Pinhole(1920, 1080, 900, 900, 960, 540), 128) == (228, 128)
    assert working_size(Pinhole(1, 1000, 900, 900, 0.5, 500), 100) == (1, 100)


def test_the_constant_says_one_everywhere():
    assert (ConstantModel()(cylinder(PINHOLE).frame()).distance == 1).all()


def test_predict_is_lazy_keeps_the_order_and_reports_progress():
    done: list[int] = []
    frames = [sphere(PINHOLE).frame(f"{i}.png") for i in range(3)]
    predictions = predict(ConstantModel(), frames, done.append)
    assert next(predictions).name == "0.png" and done == []
    assert [p.name for p in predictions] == ["1.png", "2.png"] and done == [1, 2, 3]


def test_black_and_tiny_frames_are_predicted_without_complaint():
    camera = Pinhole(7, 5, 4.0, 4.0, 3.5, 2.5)
    for model in models():
        black = model(Frame("1", np.zeros((5, 7, 3), np.float32), camera))
        assert np.isfinite(black.distance).all() and not black.valid.any()
