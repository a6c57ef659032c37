import json

import pytest
import torch

from lightdepth.decline import log_closed_form
from lightdepth.errors import InputError
from lightdepth.network import NetworkConfig, build_network
from lightdepth.network.heads import CHANNELS, network_inputs
from lightdepth.photometry import LightTerms, PhotometricCalibration

CONFIGS = [
    NetworkConfig(),
    NetworkConfig(norm="batch", width=8, inputs=("rgb", "mask")),
    NetworkConfig(output="absolute", width=8),
    NetworkConfig(kind="unet"),
]


def scene(batch: int, height: int, width: int, seed: int = 0):
    """Noise through a lens that looks along z, the left column masked."""
    generator = torch.Generator().manual_seed(seed)
    image = torch.rand(batch, 3, height, width, generator=generator)
    mask = torch.ones(batch, 1, height, width, dtype=torch.bool)
    mask[..., 0] = False
    rays = torch.zeros(batch, 3, height, width)
    rays[:, 0] = torch.linspace(-0.5, 0.5, width)
    rays[:, 2] = 1
    rays = torch.nn.functional.normalize(rays, dim=1)
    light = LightTerms(*(t.expand(batch, *t.shape[1:]) for t in PhotometricCalibration().terms()))
    return image, mask, rays, light


@pytest.mark.parametrize("config", CONFIGS, ids=lambda c: f"{c.kind}-{c.norm}-{c.output}")
@pytest.mark.parametrize("size", [(32, 40), (33, 47), (5, 4)])
def test_any_image_size_gives_positive_distance_and_albedo_in_the_unit_interval(config, size):
    network = build_network(config).eval()
    with torch.no_grad():
        distance, albedo = network(*scene(2, *size))
    assert distance.shape == (2, 1, *size) and albedo.shape == (2, 2, *size)
    assert (distance > 0).all() and torch.isfinite(distance).all()
    assert (albedo >= 0).all() and (albedo <= 1).all()


def test_sizes_of_the_networks_are_as_documented():
    def millions(config):
        return sum(p.numel() for p in build_network(config).parameters()) / 1e6

    assert 0.3 < millions(NetworkConfig(kind="tiny")) < 0.5
    assert 13.5 < millions(NetworkConfig(kind="unet")) < 15


def test_an_untrained_residual_network_says_what_the_closed_form_says():
    image, mask, rays, light = scene(1, 32, 40)
    network = build_network(NetworkConfig(blur=0.05)).eval()
    torch.nn.init.zeros_(network.body.head.weight)
    distance, _ = network(image, mask, rays, light)
    expected = log_closed_form(image, mask, rays, light, 0.05)
    assert torch.allclose(distance.log()[mask], expected[mask], atol=1e-5)


@pytest.mark.parametrize("output", ["residual", "absolute"])
def test_the_scale_is_the_closed_forms_whatever_the_weights(output):
    image, mask, rays, light = scene(2, 32, 40)
    network = build_network(NetworkConfig(output=output, width=8)).eval()
    torch.nn.init.normal_(network.body.head.weight, std=0.3)
    distance, _ = network(image, mask, rays, light)
    closed = log_closed_form(image, mask, rays, light, network.config.blur)
    for i in range(2):
        inside = mask[i, 0]
        assert torch.isclose(distance[i, 0][inside].log().mean(), closed[i, 0][inside].mean(), atol=1e-4)


def test_what_lies_outside_the_mask_does_not_reach_the_network():
    image, mask, rays, light = scene(1, 32, 40)
    other = image.clone()
    other[..., 0] = 0.9
    names = tuple(CHANNELS)
    first, closed = network_inputs(image, mask, rays, light, names, 0.02)
    second, _ = network_inputs(other, mask, rays, light, names, 0.02)
    assert torch.equal(first, second)
    assert (first[..., 0] == 0).all()
    assert torch.isfinite(closed).all()


def test_the_closed_form_that_goes_in_is_free_of_gain():
    image, mask, rays, light = scene(1, 32, 40)
    brighter = light._replace(gain=light.gain * 7)
    first, _ = network_inputs(image, mask, rays, light, ("closed_form",), 0.02)
    second, _ = network_inputs(image, mask, rays, brighter, ("closed_form",), 0.02)
    assert torch.allclose(first, second, atol=1e-5)
    assert abs(float(first[mask].mean())) < 1e-5


@pytest.mark.parametrize("kind", ["tiny", "unet"])
def test_every_parameter_learns(kind):
    network = build_network(NetworkConfig(kind=kind))
    distance, albedo = network(*scene(2, 64, 64))
    (distance.log().square().mean() + albedo.square().mean()).backward()
    assert all(p.grad is not None and torch.isfinite(p.grad).all() for p in network.parameters())


def test_black_and_fully_masked_images_give_finite_numbers():
    image, mask, rays, light = scene(2, 32, 40)
    image[0] = 0
    mask[1] = False
    distance, albedo = build_network(NetworkConfig()).eval()(image, mask, rays, light)
    assert torch.isfinite(distance).all() and torch.isfinite(albedo).all()


@pytest.mark.parametrize("config", CONFIGS, ids=lambda c: f"{c.kind}-{c.norm}-{c.output}")
def test_configuration_survives_json(config):
    assert NetworkConfig.from_dict(json.loads(json.dumps(config.to_dict()))) == config


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"kind": "dpt"}, "tiny, unet"),
        ({"inputs": ["rgb", "depth"]}, "closed_form"),
        ({"output": "disparity"}, "residual"),
        ({"colour": 1}, "colour"),
    ],
)
def test_an_unknown_configuration_is_refused_with_what_is_known(values, said):
    with pytest.raises(InputError, match=said):
        NetworkConfig.from_dict(values)
