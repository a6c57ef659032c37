from dataclasses import asdict, replace

import pytest
import torch
import torch.nn.functional as F
from raising import refused

from lightdepth.frame import FrameBatch
from lightdepth.geometry import normals_from_distance
from lightdepth.losses import (
    LossConfig,
    Seen,
    albedo_loss,
    brightness_residual,
    chroma_loss,
    facing_loss,
    indirect_light,
    log_error,
    masked_median,
    mean_over_images,
    photometric_loss,
    render_image,
    rendered_log_brightness,
    rendered_rgb,
    rgb_residual,
    saturated_loss,
    self_supervised_loss,
    smoothness_guide,
    smoothness_loss,
    specular_loss,
    ssim_loss,
    supervised_loss,
    training_loss,
    uncertainty_loss,
)
from lightdepth.losses.config import TERMS
from lightdepth.photometry import LightTerms, PhotometricCalibration, bent, encode, hue_saturation_albedo

LAMBERT = LossConfig(cosine_exponent=1.0, reflectance=0.0, cosine_floor=0.0)


def pinhole_rays(height: int, width: int, batch: int = 1) -> torch.Tensor:
    v, u = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    rays = torch.stack([(u - width / 2) / width, (v - height / 2) / width, torch.ones_like(u)])
    return F.normalize(rays, dim=0).expand(batch, -1, -1, -1)


def tube_distance(rays: torch.Tensor, radius: float = 1.5, end: float = 5.0) -> torch.Tensor:
    """Inside a cylinder around the optical axis, closed at z = end."""
    wall = radius / rays[:, :2].norm(dim=1, keepdim=True).clamp(min=1e-6)
    return torch.minimum(wall, end / rays[:, 2:3])


def tube_batch(height: int = 32, width: int = 40, gain: float = 1.0, config: LossConfig = LAMBERT, batch: int = 2):
    """Images that the loss's own model of light makes of a cylinder, of one colour; and that colour."""
    rays = pinhole_rays(height, width, batch)
    distance = tube_distance(rays)
    light = LightTerms(*(t.expand(batch, *t.shape[1:]) for t in PhotometricCalibration().terms()))
    mask = torch.ones(batch, 1, height, width, dtype=torch.bool)
    colour = torch.tensor([0.55, 0.4]).reshape(1, 2, 1, 1).expand(batch, 2, height, width)
    indirect = indirect_light(distance, rays, mask, light, config)
    normals = normals_from_distance(distance, rays)
    log_v = rendered_log_brightness(distance, normals, rays, mask, light, indirect, config)
    image = log_v.exp() * encode(hue_saturation_albedo(colour), light.gamma) * gain ** (1 / 2.2)
    return FrameBatch(bent(image, config.shoulder).clamp(0, 1), mask, rays, light, distance, mask), colour


def spoilt(distance: torch.Tensor) -> torch.Tensor:
    """The same with a smooth error of some 20 %."""
    return distance * torch.exp(0.3 * torch.linspace(-1, 1, distance.shape[-1])) * 1.1


@pytest.mark.parametrize("reflectance", [0.0, 0.6])
def test_truth_has_less_loss_than_a_wrong_distance_where_the_model_holds(reflectance):
    config = replace(LAMBERT, reflectance=reflectance)
    batch, colour = tube_batch(config=config)
    total, terms = self_supervised_loss(batch.true_distance, colour, batch, config)
    wrong, wrong_terms = self_supervised_loss(spoilt(batch.true_distance), colour, batch, config)
    assert terms["photometric"] < 1e-3 and terms["chroma"] < 0.02
    assert wrong > total and wrong_terms["photometric"] > 20 * terms["photometric"]


def test_the_loss_does_not_see_gain_nor_the_scale_of_distance():
    config = LossConfig()
    dim, colour = tube_batch(gain=1.0)
    dimmer, _ = tube_batch(gain=0.5)
    distance = spoilt(dim.true_distance)
    reference, _ = self_supervised_loss(distance, colour, dim, config)
    assert torch.allclose(self_supervised_loss(distance * 30, colour, dim, config)[0], reference, rtol=1e-3)
    assert torch.allclose(self_supervised_loss(distance, colour, dimmer, config)[0], reference, rtol=1e-2)


def test_reflectance_comes_from_the_configuration_or_else_from_the_light():
    batch, colour = tube_batch()
    lit = batch._replace(light=batch.light._replace(reflectance=torch.full_like(batch.light.reflectance, 0.5)))
    fixed = self_supervised_loss(batch.true_distance, colour, batch, LossConfig(reflectance=0.5))[0]
    calibrated = self_supervised_loss(batch.true_distance, colour, lit, LossConfig(reflectance=None))[0]
    none = self_supervised_loss(batch.true_distance, colour, batch, LossConfig(reflectance=None))[0]
    assert torch.allclose(fixed, calibrated) and not torch.allclose(fixed, none)


def test_the_lights_offset_plays_no_part_because_distance_has_only_a_scale():
    batch, colour = tube_batch()
    moved = batch._replace(light=batch.light._replace(position=torch.full_like(batch.light.position, 2.0)))
    first = self_supervised_loss(batch.true_distance, colour, batch, LossConfig())[0]
    assert torch.equal(first, self_supervised_loss(batch.true_distance, colour, moved, LossConfig())[0])


def test_saturated_pixels_may_be_rendered_brighter_but_not_darker():
    everywhere = torch.ones(1, 1, 4, 4, dtype=torch.bool)
    saturated = everywhere.clone()
    saturated[..., :2] = False
    brighter, darker = torch.full((1, 1, 4, 4), -0.5), torch.full((1, 1, 4, 4), 0.5)
    assert saturated_loss(brighter, saturated, ~saturated, 0.05) == 0
    assert torch.isclose(saturated_loss(darker, saturated, ~saturated, 0.05), torch.tensor(0.475))
    assert saturated_loss(darker, everywhere, ~everywhere, 0.05) == 0  # no pixel left to know the gain from


def test_facing_punishes_only_grazing_surfaces():
    rays = pinhole_rays(6, 8)
    mask = torch.ones(1, 1, 6, 8, dtype=torch.bool)
    assert facing_loss(-rays, rays, mask, 0.03) == 0
    across = F.normalize(torch.linalg.cross(rays, torch.tensor([0.0, 1, 0]).reshape(1, 3, 1, 1).expand_as(rays), dim=1))
    assert torch.isclose(facing_loss(across, rays, mask, 0.03), torch.tensor(0.03), atol=1e-5)


def test_smoothness_is_zero_for_log_linear_distance_and_forgives_bends_at_edges():
    mask = torch.ones(1, 1, 20, 24, dtype=torch.bool)
    flat = torch.zeros(1, 1, 20, 24)
    ramp = torch.linspace(0, 1, 24).expand(1, 1, 20, 24)
    step = (torch.arange(24) >= 12).float().expand(1, 1, 20, 24)
    assert smoothness_loss(ramp, flat, mask) < 1e-6
    assert smoothness_loss(step, smoothness_guide(step * 3, mask), mask) < smoothness_loss(step, flat, mask) * 0.5


def test_smoothness_of_a_surface_hardly_depends_on_the_resolution():
    def value(rows: int) -> torch.Tensor:
        v = torch.linspace(0, 6, rows).reshape(1, 1, rows, 1).expand(1, 1, rows, rows)
        return smoothness_loss(v.sin(), 0 * v, torch.ones_like(v, dtype=torch.bool))

    assert torch.isclose(value(112), value(224), rtol=0.05)


def test_chroma_is_zero_for_the_right_colour_at_any_brightness():
    batch, colour = tube_batch(gain=1.0)
    assert chroma_loss(colour, batch.image, batch.light, batch.mask) < 1e-4
    assert chroma_loss(colour * 0.5, batch.image, batch.light, batch.mask) > 0.1


def test_supervised_terms_vanish_at_truth_times_any_scale():
    batch, _ = tube_batch()
    right = supervised_loss(batch.true_distance * 7, batch.true_distance, batch.true_valid)
    wrong = supervised_loss(spoilt(batch.true_distance), batch.true_distance, batch.true_valid)
    assert all(value < 1e-5 for value in right.values())
    assert all(wrong[name] > 0.01 for name in right)


def test_truth_is_not_read_unless_it_is_given_a_weight():
    batch, colour = tube_batch()
    poisoned = batch._replace(true_distance=batch.true_distance * torch.nan)
    distance = spoilt(batch.true_distance)
    total, terms = training_loss(distance, colour, poisoned, LossConfig())
    assert torch.isfinite(total) and "supervised" not in terms
    with_truth, terms = training_loss(distance, colour, batch, LossConfig(supervised=1.0))
    assert with_truth > total and "supervised" in terms


def blackened(batch):
    return batch._replace(image=torch.zeros_like(batch.image))


def whitened(batch):
    return batch._replace(image=torch.ones_like(batch.image))


def masked_away(batch):
    return batch._replace(mask=torch.zeros_like(batch.mask), true_valid=torch.zeros_like(batch.mask))


def without_corners(batch):
    """Corners masked, their rays not rays of any lens: what to_batch makes of an octagon."""
    mask, rays = batch.mask.clone(), batch.rays.clone()
    mask[..., :9, :9] = False
    rays[..., :9, :9] = torch.tensor([0.0, 0, 1]).reshape(3, 1, 1)
    return batch._replace(mask=mask, rays=rays, image=batch.image * mask, true_valid=mask)


def half_black(batch):
    image = batch.image.clone()
    image[0] = 0
    return batch._replace(image=image)


@pytest.mark.parametrize("spoil", [blackened, whitened, masked_away, without_corners, half_black])
@pytest.mark.parametrize("flat", [True, False])
def test_degenerate_images_give_finite_losses_and_gradients(spoil, flat):
    batch, _ = tube_batch()
    batch = spoil(batch)
    raw = (torch.zeros_like(batch.true_distance) if flat else spoilt(batch.true_distance).log()).requires_grad_()
    colour = torch.zeros(2, 2, 32, 40, requires_grad=True)
    total, terms = training_loss(raw.exp(), colour.sigmoid(), batch, LossConfig(supervised=1.0))
    total.backward()
    assert torch.isfinite(total) and all(torch.isfinite(value) for value in terms.values())
    assert torch.isfinite(raw.grad).all() and torch.isfinite(colour.grad).all()


def test_gradient_of_the_direct_model_agrees_with_differences():
    batch, _ = tube_batch(4, 5, batch=1)
    double = FrameBatch(
        *(
            LightTerms(*(t.double() for t in x)) if isinstance(x, tuple) else x.double() if x.is_floating_point() else x
            for x in batch
        )
    )

    def residual(log_distance):
        distance = log_distance.exp()
        normals = normals_from_distance(distance, double.rays)
        indirect = indirect_light(distance, double.rays, double.mask, double.light, LAMBERT)
        return rendered_log_brightness(distance, normals, double.rays, double.mask, double.light, indirect, LAMBERT)

    log_distance = double.true_distance.log() + 0.05 * torch.sin(torch.arange(20).reshape(1, 1, 4, 5))
    assert torch.autograd.gradcheck(residual, log_distance.double().requires_grad_())


def test_masked_median_and_mean_agree_with_torch_on_what_is_inside():
    generator = torch.Generator().manual_seed(0)
    values = torch.randn(3, 1, 5, 7, generator=generator)
    mask = torch.rand(3, 1, 5, 7, generator=generator) < 0.6
    mask[2] = False
    values[~mask] = torch.nan
    median = masked_median(values, mask).flatten()
    assert torch.equal(median[:2], torch.stack([values[i][mask[i]].median() for i in range(2)])) and median[2] == 0
    expected = (values[0][mask[0]].mean() + values[1][mask[1]].mean()) / 3
    assert torch.isclose(mean_over_images(values, mask), expected)


def test_photometric_is_huber_over_its_width():
    residual = torch.tensor([0.01, -1.0]).reshape(1, 1, 1, 2)
    usable = torch.ones_like(residual, dtype=torch.bool)
    expected = (0.5 * 0.01**2 / 0.05 + (1.0 - 0.025)) / 2
    assert torch.isclose(photometric_loss(residual, usable, 0.05), torch.tensor(expected))
    assert torch.equal(brightness_residual(residual, residual, usable), torch.zeros_like(residual))


def test_rendering_the_truth_gives_back_the_image():
    batch, colour = tube_batch(gain=0.5)
    assert (render_image(batch.true_distance, colour, batch, LAMBERT) - batch.image).abs().max() < 0.01


def test_the_total_is_the_weighted_sum_of_its_terms():
    batch, colour = tube_batch()
    config = LossConfig(photometric=2.0, smoothness=3.0)
    total, terms = self_supervised_loss(spoilt(batch.true_distance), colour, batch, config)
    weights = asdict(config)
    assert torch.isclose(total, sum(weights[name] * value for name, value in terms.items()))


PAPER = replace(LAMBERT, space="encoded", gain="one", huber=0.0, chroma=0.0, saturated=0.0, facing=0.0, smoothness=0.0)


@pytest.mark.parametrize("space", ["log", "encoded", "linear"])
def test_in_every_space_truth_has_no_photometric_error_and_a_wrong_distance_has(space):
    config = replace(PAPER, space=space)
    batch, colour = tube_batch(gain=0.8, config=config)
    at_gain = batch.true_distance * 0.8**-0.5  # with the gain fixed at 1, a dimmer light is a longer distance
    right = self_supervised_loss(at_gain, colour, batch, config)[1]["photometric"]
    wrong = self_supervised_loss(spoilt(at_gain), colour, batch, config)[1]["photometric"]
    assert right < 2e-3 and wrong > 20 * right


@pytest.mark.parametrize("known", [{"ambient": 0.2}, {"shoulder": 0.4}, {"ambient": 0.2, "shoulder": 0.4}])
def test_stray_light_and_a_tone_curve_that_are_known_do_no_harm(known):
    config = replace(LAMBERT, **known)
    batch, colour = tube_batch(gain=4.0, config=config)
    right, unaware = (
        self_supervised_loss(batch.true_distance, colour, batch, c)[1]["photometric"] for c in (config, LAMBERT)
    )
    assert right < 5e-3 and unaware > 20 * right
    assert (render_image(batch.true_distance, colour, batch, config) - batch.image).abs().max() < 0.01


def test_with_the_gain_fixed_the_loss_gives_distance_its_scale():
    batch, colour = tube_batch(config=PAPER)
    right, shorter = (self_supervised_loss(batch.true_distance * f, colour, batch, PAPER)[0] for f in (1.0, 0.8))
    assert right < 2e-3 < 0.02 < shorter


def test_the_papers_photometric_term_teaches_the_albedo_too():
    batch, colour = tube_batch(config=PAPER)
    wrong = colour * 0.5
    assert self_supervised_loss(batch.true_distance, wrong, batch, PAPER)[0] > 0.01
    in_log = replace(PAPER, space="log")
    assert self_supervised_loss(batch.true_distance, wrong, batch, in_log)[0] < 2e-3


def test_linear_light_is_the_encoded_to_the_power_of_gamma():
    image, rendered = torch.tensor([0.5, 0.2]).reshape(2, 1, 1, 1, 1)
    gamma = torch.tensor(2.2)
    assert torch.isclose(rgb_residual(image, rendered, gamma, "linear"), torch.tensor(0.5**2.2 - 0.2**2.2)).all()
    assert torch.isclose(rgb_residual(image, rendered, gamma, "encoded"), torch.tensor(0.3)).all()


def test_l1_is_huber_of_no_width():
    residual = torch.tensor([0.01, -1.0]).reshape(1, 1, 1, 2)
    assert torch.isclose(
        photometric_loss(residual, torch.ones_like(residual, dtype=torch.bool), 0.0), torch.tensor(0.505)
    )


def test_ssim_agrees_with_its_formula_and_leaves_out_windows_with_an_unusable_pixel():
    generator = torch.Generator().manual_seed(0)
    image, other = torch.rand(2, 1, 3, 11, 11, generator=generator, dtype=torch.float64)
    x = torch.arange(5, dtype=torch.float64) - 2
    kernel = torch.exp(-(x**2) / (2 * 1.5**2))
    kernel = (kernel[:, None] * kernel / kernel.sum() ** 2).reshape(1, 1, 5, 5).expand(3, 1, 5, 5)

    def blurred(values):
        return F.conv2d(values, kernel, groups=3)

    a, b = blurred(image), blurred(other)
    va, vb, ab = blurred(image**2) - a * a, blurred(other**2) - b * b, blurred(image * other) - a * b
    slow = ((2 * a * b + 1e-4) * (2 * ab + 9e-4)) / ((a * a + b * b + 1e-4) * (va + vb + 9e-4))
    usable = torch.ones(1, 1, 11, 11, dtype=torch.bool)
    inner = torch.zeros_like(usable)
    inner[..., 2:-2, 2:-2] = True
    whole = ssim_loss(image, other, usable)
    assert ssim_loss(image, image, usable) < 1e-9 < whole
    usable[..., :, 0] = usable[..., :, -1] = usable[..., 0, :] = usable[..., -1, :] = False
    spoilt_border = torch.where(usable, other, torch.full_like(other, torch.nan))
    framed = ssim_loss(image, spoilt_border, usable)
    expected = ((1 - slow) / 2)[..., 1:-1, 1:-1].mean()  # windows that touch no pixel of the border
    assert torch.isclose(framed, expected, rtol=1e-4)


def test_highlights_face_the_light():
    rays = pinhole_rays(6, 8)
    everywhere = torch.ones(1, 1, 6, 8, dtype=torch.bool)
    assert specular_loss(-rays, rays, everywhere).abs() < 1e-6
    tilted = F.normalize(-rays + 0.5 * torch.tensor([1.0, 0, 0]).reshape(1, 3, 1, 1), dim=1)
    assert specular_loss(tilted, rays, everywhere) > 0.03
    assert specular_loss(tilted, rays, ~everywhere) == 0


def test_an_even_albedo_costs_nothing_and_a_speckled_one_does():
    batch, colour = tube_batch()
    speckled = colour.clone()
    speckled[:, 1, ::2, ::2] = 0.9
    assert albedo_loss(colour, batch.mask) == 0 < 0.01 < albedo_loss(speckled, batch.mask)


def test_the_likelihood_of_an_error_is_greatest_at_its_own_size():
    generator = torch.Generator().manual_seed(0)
    error = torch.distributions.Laplace(0.0, 0.2).icdf(torch.rand(1, 1, 100, 100, generator=generator))
    valid = torch.ones_like(error, dtype=torch.bool)

    def loss(sigma: float) -> torch.Tensor:
        return uncertainty_loss(torch.full_like(error, sigma).log(), error, valid)

    right = 0.2 * 2**0.5
    assert loss(right) < loss(right * 1.2) and loss(right) < loss(right / 1.2)


def test_the_uncertainty_term_teaches_nothing_but_the_uncertainty():
    batch, colour = tube_batch()
    distance = spoilt(batch.true_distance).requires_grad_()
    log_sigma = torch.full_like(distance, -2.0).detach().requires_grad_()
    config = LossConfig(self_supervised=0.0, uncertainty=1.0)
    total, terms = training_loss(distance, colour, batch, config, log_sigma)
    total.backward()
    assert "uncertainty" in terms and (distance.grad == 0).all() and (log_sigma.grad != 0).any()


def test_the_log_error_has_no_scale_and_is_zero_where_there_is_no_truth():
    batch, _ = tube_batch()
    valid = batch.true_valid.clone()
    valid[..., :5] = False
    error = log_error(batch.true_distance * 3, batch.true_distance * valid, valid)
    assert error.abs().max() < 1e-5
    assert (log_error(spoilt(batch.true_distance), batch.true_distance, valid)[..., :5] == 0).all()


@pytest.mark.parametrize(
    "values",
    [{"space": "hsv"}, {"gain": "two"}, {"smoothness": -1.0}, {"huber": -0.1}, {"ambient": -0.1}, {"shoulder": 1.2}],
)
def test_a_loss_that_makes_no_sense_is_refused(values):
    with refused(where="loss" if values.keys() & {"space", "gain"} else f"LossConfig.{next(iter(values))}"):
        LossConfig(**values)


def gradcheck_inputs():
    """A bumpy surface of 4x5 pixels in float64, away from every kink of the terms."""
    generator = torch.Generator().manual_seed(3)
    rays = pinhole_rays(4, 5).double()
    log_distance = (torch.rand(1, 1, 4, 5, generator=generator, dtype=torch.float64) * 0.3).requires_grad_()
    albedo = (torch.tensor([0.55, 0.4], dtype=torch.float64).reshape(1, 2, 1, 1) + torch.zeros(1, 2, 4, 5)).double()
    albedo = (albedo + 0.05 * torch.rand(1, 2, 4, 5, generator=generator, dtype=torch.float64)).requires_grad_()
    image = 0.2 + 0.6 * torch.rand(1, 3, 4, 5, generator=generator, dtype=torch.float64)
    mask = torch.ones(1, 1, 4, 5, dtype=torch.bool)
    mask[..., 0, 0] = False
    light = LightTerms(*(t.double() for t in PhotometricCalibration().terms()))
    truth = 1 + torch.rand(1, 1, 4, 5, generator=generator, dtype=torch.float64)
    return log_distance, albedo, FrameBatch(image, mask, rays, light, truth, mask)


@pytest.mark.parametrize(
    "config",
    [
        replace(LAMBERT, smoothness=0.0, chroma=0.0),
        replace(LAMBERT, photometric=0.0, facing=0.0, chroma=0.0),
        replace(LAMBERT, photometric=0.0, smoothness=0.0, facing=0.0),
        replace(PAPER, photometric=1.0, albedo=0.5),
        replace(PAPER, photometric=1.0, space="linear", huber=0.05),
        replace(PAPER, photometric=0.0, ssim=1.0),
        replace(PAPER, photometric=0.0, facing=1.0, cosine_floor=0.9),
        replace(PAPER, photometric=0.0, specular=1.0, white=0.5, highlight_size=1.0, highlight_contrast=0.0),
        replace(PAPER, photometric=0.0, saturated=1.0, white=0.5),
        replace(PAPER, photometric=0.0, supervised=1.0),
        replace(LAMBERT, smoothness=0.0, chroma=0.0, ambient=0.3, shoulder=0.5),
    ],
    ids=[
        *("log", "smoothness", "chroma", "paper", "linear", "ssim", "facing", "specular", "saturated", "supervised"),
        "ambient and shoulder",
    ],
)
def test_gradients_of_every_term_are_right(config):
    log_distance, albedo, batch = gradcheck_inputs()
    config = replace(config, gain="one")  # the median of the gain has no gradient by intent

    def loss(log_distance, albedo):
        return training_loss(log_distance.exp(), albedo, batch, config)[0]

    assert torch.autograd.gradcheck(loss, (log_distance, albedo), eps=1e-6, atol=1e-5)
    gradients = torch.autograd.grad(loss(log_distance, albedo), (log_distance, albedo), allow_unused=True)
    assert any(g is not None and (g != 0).any() for g in gradients)


def test_the_gradient_of_the_likelihood_is_right():
    log_distance, _, batch = gradcheck_inputs()
    error = log_error(log_distance.exp(), batch.true_distance, batch.true_valid).detach()
    log_sigma = torch.full_like(error, -1.0).requires_grad_()
    assert torch.autograd.gradcheck(lambda s: uncertainty_loss(s, error, batch.true_valid), (log_sigma,))


def test_rendered_colour_is_brightness_times_the_encoded_albedo():
    log_v = torch.tensor(0.5).log().reshape(1, 1, 1, 1)
    albedo = torch.tensor([0.5, 0.6]).reshape(1, 2, 1, 1)  # red, saturation 0.6
    red, green, blue = rendered_rgb(log_v, albedo, torch.tensor(2.0).reshape(1, 1, 1, 1)).flatten()
    assert torch.isclose(red, torch.tensor(0.5)) and torch.isclose(green, torch.tensor(0.5 * 0.4**0.5))
    assert torch.isclose(green, blue)


def test_the_indirect_light_of_a_large_image_is_that_of_a_small_one():
    def light(rows: int) -> torch.Tensor:
        batch, _ = tube_batch(rows, rows * 5 // 4, batch=1)
        found = indirect_light(batch.true_distance, batch.rays, batch.mask, batch.light, LossConfig(reflectance=0.6))
        return torch.nn.functional.interpolate(found, (32, 40), mode="area")

    assert torch.allclose(light(384).log(), light(128).log(), atol=0.03)
    assert not torch.allclose(light(384).log(), light(32).log(), atol=0.03)


def test_what_is_rendered_brighter_than_white_counts_as_white_in_ssim():
    image = torch.rand(1, 3, 12, 12, generator=torch.Generator().manual_seed(0))
    usable = torch.ones(1, 1, 12, 12, dtype=torch.bool)
    rendered = (image * 1.5 - 0.2).clamp(0, 1)
    beyond = torch.where(rendered == 1, 1.7, torch.where(rendered == 0, -0.4, rendered))
    assert (rendered == 1).any() and (rendered == 0).any()
    torch.testing.assert_close(ssim_loss(image, beyond, usable), ssim_loss(image, rendered, usable))


@pytest.mark.parametrize("name", ["ssim", "specular", "albedo"])
def test_a_term_is_taken_where_it_has_a_weight_and_the_total_is_their_weighted_sum(name):
    batch, albedo = tube_batch()
    config = replace(LAMBERT, **{name: 0.7})
    total, terms = self_supervised_loss(spoilt(batch.true_distance), albedo, batch, config)
    always = {"photometric", "saturated", "facing", "smoothness", "chroma"}
    assert set(terms) == always | {name}
    torch.testing.assert_close(total, sum(getattr(config, term) * value for term, value in terms.items()))
    assert set(self_supervised_loss(batch.true_distance, None, batch, LAMBERT)[1]) == always - {"chroma"}


@pytest.mark.parametrize("name", [*TERMS, "self_supervised", "supervised", "uncertainty", "huber", "ambient"])
def test_no_weight_is_below_zero_and_zero_is_one(name):
    assert getattr(LossConfig(**{name: 0.0}), name) == 0
    with refused(where="LossConfig"):
        LossConfig(**{name: -1e-3})


@pytest.mark.parametrize("shoulder", [0.19, 1.01])
def test_a_shoulder_lies_between_a_fifth_and_white(shoulder):
    assert [LossConfig(shoulder=s).shoulder for s in (0.2, 1.0)] == [0.2, 1.0]
    with refused(where="LossConfig"):
        LossConfig(shoulder=shoulder)


def test_white_pixels_and_black_ones_tell_nothing_of_distance_and_only_white_ones_in_the_mask_are_saturated():
    batch, _ = tube_batch()
    image, mask = batch.image.clone(), batch.mask.clone()
    image[..., :4, :], image[..., 4:8, :], mask[..., 2:6, :] = 1.0, 0.0, False
    image[:, 0, 8:10] = 0.971
    seen = Seen.of(batch._replace(image=image, mask=mask), LAMBERT)
    white = torch.zeros_like(mask)
    white[..., :2, :], white[..., 8:10, :] = True, True
    assert torch.equal(seen.saturated, white)
    assert not (seen.usable & (white | ~mask)).any() and not seen.usable[..., :8, :].any()
    assert seen.usable[..., 14:, :].float().mean() > 0.9
    torch.testing.assert_close(seen.log_v.exp(), image.amax(1, keepdim=True).clamp(min=0.01))
