import json
import sys
from dataclasses import replace

import pytest
import torch
from raising import refused
from safetensors.torch import save_file

from lightdepth.decline import log_closed_form
from lightdepth.errors import InputError
from lightdepth.network import NetworkConfig, build_network, load_pretrained
from lightdepth.network.heads import CHANNELS, UncertaintyHead, network_inputs
from lightdepth.network.pretrained import IMAGENET_STD
from lightdepth.network.unet import RESNETS, ResNet
from lightdepth.photometry import LightTerms, PhotometricCalibration

DPT = NetworkConfig(kind="dpt", encoder="vitt14")
CONFIGS = [
    NetworkConfig(),
    NetworkConfig(norm="batch", width=8, inputs=("rgb", "mask")),
    NetworkConfig(output="absolute", width=8, uncertainty=True),
    NetworkConfig(output="limited", width=8),
    NetworkConfig(output="free", width=8),
    NetworkConfig(kind="unet", uncertainty=True),
    NetworkConfig(kind="unet", encoder="efficientnet-lite0", output="limited"),
]


def dpt_network(**changes):
    """Needs the extra `dpt`, which the project's own environment has."""
    pytest.importorskip("transformers", reason="pip install 'lightdepth[dpt]' to run this")
    return build_network(replace(DPT, **changes))


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
    assert 23.5 < millions(NetworkConfig(kind="unet", encoder="resnet34")) < 25


@pytest.mark.parametrize(("encoder", "millions"), [("resnet18", 11.1765), ("resnet34", 21.2847), ("resnet50", 23.5080)])
def test_encoders_have_torchvisions_parameters(encoder, millions):
    """The published counts (11 689 512, 21 797 672, 25 557 032) less the classifier's."""
    resnet = ResNet(encoder, 3)
    assert sum(p.numel() for p in resnet.parameters()) / 1e6 == pytest.approx(millions, abs=1e-4)
    names = resnet.state_dict().keys()
    assert {"conv1.weight", "bn1.running_mean", "layer1.0.conv1.weight", "layer4.1.bn2.bias"} <= names
    assert ("layer1.0.downsample.0.weight" in names) == (encoder == "resnet50")
    assert "layer2.0.downsample.1.running_var" in names and ("layer1.0.conv3.weight" in names) == (
        encoder == "resnet50"
    )
    shapes = [f.shape[1:] for f in resnet.eval()(torch.zeros(1, 3, 64, 32))]
    assert shapes == [(c, 32 // 2**i, 16 // 2**i) for i, c in enumerate(resnet.channels)]


def test_an_untrained_residual_network_says_what_the_closed_form_says():
    image, mask, rays, light = scene(1, 32, 40)
    network = build_network(NetworkConfig(blur=0.05)).eval()
    torch.nn.init.zeros_(network.body.head.weight)
    distance, _ = network(image, mask, rays, light)
    expected = log_closed_form(image, mask, rays, light, 0.05)
    assert torch.allclose(distance.log()[mask], expected[mask], atol=1e-5)


def test_an_untrained_limited_network_follows_the_closed_form_near_its_mean_and_no_farther_than_a_factor_of_e():
    image, mask, rays, light = scene(1, 32, 40)
    image = image**4  # some of it almost black
    network = build_network(NetworkConfig(output="limited", blur=0.0)).eval()
    torch.nn.init.zeros_(network.body.head.weight)
    log_distance = network(image, mask, rays, light)[0].log()[mask]
    closed = log_closed_form(image, mask, rays, light, 0.0)[mask]
    apart = closed - closed.mean()
    said = torch.linalg.lstsq(torch.stack([apart.tanh(), torch.ones_like(apart)], 1), log_distance).solution
    assert apart.max() > 1.5 and torch.allclose(
        said, torch.tensor([1.0, float(closed.mean() - apart.tanh().mean())]), atol=1e-4
    )
    assert log_distance.max() - log_distance.min() < 2


@pytest.mark.parametrize("output", ["residual", "limited", "absolute"])
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
        ({"kind": "vgg"}, "tiny, unet"),
        ({"inputs": ["rgb", "depth"]}, "closed_form"),
        ({"output": "disparity"}, "residual"),
        ({"colour": 1}, "colour"),
        ({"kind": "unet", "encoder": "resnet51"}, "resnet18, resnet34, resnet50, efficientnet-lite0"),
        ({"encoder": "resnet18"}, "none"),
    ],
)
def test_an_unknown_configuration_is_refused_with_what_is_known(values, said):
    with refused(said):
        NetworkConfig.from_dict(values)


def test_the_free_output_has_a_scale_of_its_own():
    image, mask, rays, light = scene(1, 32, 40)
    network = build_network(NetworkConfig(output="free", width=8)).eval()
    torch.nn.init.zeros_(network.body.head.weight)
    torch.nn.init.constant_(network.body.head.bias, 1.5)
    brighter = light._replace(gain=light.gain * 7)
    for lamp in (light, brighter):
        assert torch.allclose(network(image, mask, rays, lamp)[0].log(), torch.tensor(1.5))


def test_a_network_without_the_head_is_sure_of_nothing_and_a_new_head_doubts_by_an_eighth():
    batch = scene(2, 33, 47)
    assert build_network(NetworkConfig(width=8)).eval().estimate(*batch).log_sigma is None
    log_sigma = build_network(NetworkConfig(width=8, uncertainty=True)).eval().estimate(*batch).log_sigma
    assert log_sigma.shape == (2, 1, 33, 47)
    assert torch.allclose(log_sigma.exp(), torch.tensor(0.135), atol=0.02)


def test_the_uncertainty_head_changes_nothing_but_itself():
    network = build_network(NetworkConfig(width=8, uncertainty=True))
    network.estimate(*scene(2, 32, 40)).log_sigma.sum().backward()
    assert all(p.grad is None for p in network.body.parameters())
    assert all((p.grad != 0).any() for p in network.uncertainty.parameters())


def test_calibration_is_part_of_the_weights():
    head = UncertaintyHead(4)
    features = torch.randn(1, 4, 8, 8, generator=torch.Generator().manual_seed(0))
    before = head(features)
    head.calibration.copy_(torch.tensor([0.5, 0.3]))
    assert torch.allclose(head(features), 0.5 * before + 0.3)
    assert "calibration" in head.state_dict()


@pytest.mark.parametrize("kind", ["tiny", "unet"])
def test_half_precision_of_the_network_leaves_the_physics_in_full(kind):
    """Under autocast the closed form is computed as without, and what comes out is float32."""
    batch = scene(1, 32, 40)
    network = build_network(NetworkConfig(kind=kind, width=8, uncertainty=True)).eval()
    torch.nn.init.zeros_(network.body.head.weight)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        half = network.estimate(*batch)
    full = network.estimate(*batch)
    assert half.distance.dtype == half.albedo_hs.dtype == half.log_sigma.dtype == torch.float32
    assert torch.equal(half.distance, full.distance)


def torchvision_like(encoder: str, seed: int = 0) -> dict[str, torch.Tensor]:
    """Random weights under torchvision's names, classifier and all."""
    torch.manual_seed(seed)
    return {**ResNet(encoder, 3).state_dict(), "fc.weight": torch.zeros(1000, 512), "fc.bias": torch.zeros(1000)}


@pytest.mark.parametrize(("encoder", "suffix"), [*((e, "safetensors") for e in RESNETS), ("resnet18", "pth")])
def test_imagenet_weights_come_from_a_file_and_see_colours_only(tmp_path, encoder, suffix):
    path, weights = tmp_path / f"w.{suffix}", torchvision_like(encoder)
    save_file(weights, str(path)) if suffix == "safetensors" else torch.save(weights, path)
    network = build_network(NetworkConfig(kind="unet", encoder=encoder, inputs=("ray_z", "rgb", "closed_form")))
    load_pretrained(network, path)
    loaded = network.body.encoder.state_dict()
    others = {name for name in loaded if "num_batches" not in name} - {"conv1.weight"}
    assert others and all(torch.equal(loaded[name], weights[name]) for name in others)
    stem = loaded["conv1.weight"]
    std = torch.tensor(IMAGENET_STD).reshape(1, 3, 1, 1)
    assert torch.allclose(stem[:, 1:4] * std, weights["conv1.weight"]) and (stem[:, [0, 4]] == 0).all()


def test_weights_that_do_not_fit_are_listed(tmp_path):
    network = build_network(NetworkConfig(kind="unet"))
    wrong = torchvision_like("resnet18")
    del wrong["layer1.0.conv1.weight"]
    wrong["layer9.weight"] = torch.zeros(3)
    wrong["bn1.weight"] = torch.zeros(7)
    wrong["bn1.bias"] = wrong["bn1.bias"] * torch.nan
    save_file(wrong, str(tmp_path / "w.safetensors"))
    with pytest.raises(InputError) as raised:
        load_pretrained(network, tmp_path / "w.safetensors")
    said = str(raised.value)
    assert "missing layer1.0.conv1.weight" in said and "unknown layer9.weight" in said and "resnet18" in said
    assert "bn1.weight is (7,), expected (64,)" in said and "bn1.bias is not finite" in said
    save_file(torchvision_like("resnet34"), str(tmp_path / "34.safetensors"))
    with refused(found=" more"):
        load_pretrained(network, tmp_path / "34.safetensors")


def test_files_that_hold_no_weights_are_refused(tmp_path):
    network = build_network(NetworkConfig(kind="unet"))
    (tmp_path / "a.pth").write_bytes(b"rubbish")
    (tmp_path / "a.safetensors").write_bytes(b"rubbish")
    (tmp_path / "a.h5").write_bytes(b"rubbish")
    torch.save([1, 2], tmp_path / "list.pth")
    for name, said in {"no.pth": "no such", "a.pth": "damaged", "a.safetensors": "damaged", "a.h5": "unknown"}.items():
        with refused(said):
            load_pretrained(network, tmp_path / name)
    with refused(found="state dict"):
        load_pretrained(network, tmp_path / "list.pth")
    torch.save(torchvision_like("resnet18"), tmp_path / "w.pth")
    with refused(found="tiny"):
        load_pretrained(build_network(NetworkConfig()), tmp_path / "w.pth")
    with refused(cure="rgb"):
        load_pretrained(build_network(NetworkConfig(kind="unet", inputs=("closed_form",))), tmp_path / "w.pth")


def test_without_transformers_dpt_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "transformers", None)
    with refused(cure="lightdepth[dpt]"):
        build_network(DPT)


@pytest.mark.parametrize("size", [(28, 42), (33, 47)])
def test_dpt_takes_any_image_size_and_every_parameter_learns(size):
    network = dpt_network(uncertainty=True)
    distance, albedo, log_sigma = network.estimate(*scene(2, *size))
    assert distance.shape == log_sigma.shape == (2, 1, *size) and (distance > 0).all()
    (distance.log().square().mean() + albedo.square().mean() + log_sigma.mean()).backward()
    learning = [(n, p) for n, p in network.named_parameters() if p.requires_grad]
    assert not [n for n, p in learning if p.grad is None or not torch.isfinite(p.grad).all()]


@pytest.mark.parametrize("published", ["depth anything", "dinov2", "old names"])
def test_dpt_takes_the_weights_of_depth_anything_or_dinov2_from_a_file(tmp_path, published):
    """The files are made from our own random weights under the names of the published ones."""
    donor = dpt_network(inputs=("rgb",)).body.state_dict()
    given = {n: v for n, v in donor.items() if not n.startswith("head.")}
    if published == "dinov2":
        given = {n.removeprefix("backbone."): v for n, v in given.items() if n.startswith("backbone.")}
        given["embeddings.mask_token"] = torch.zeros(1, 192)
    else:
        given = {n.replace("conv", "head.conv") if n.startswith("conv") else n: v for n, v in given.items()}
        given["head.conv3.weight"] = torch.zeros(1, 32, 1, 1)
    if published == "old names":
        for new, old in {"q_proj": "attention.query", "k_proj": "attention.key", "v_proj": "attention.value"}.items():
            given = {n.replace(f"attention.{new}", f"attention.{old}"): v for n, v in given.items()}
        given = {n.replace("attention.o_proj", "attention.output.dense"): v for n, v in given.items()}
    save_file({n: v.contiguous().clone() for n, v in given.items()}, str(tmp_path / "w.safetensors"))
    network = dpt_network()
    fresh = network.body.neck.state_dict()["fusion_stage.layers.0.projection.weight"].clone()
    load_pretrained(network, tmp_path / "w.safetensors")
    loaded = network.body.state_dict()
    stem = "backbone.embeddings.patch_embeddings.projection.weight"
    same = [n for n in donor if n != stem and not n.startswith(("head.", "neck.", "conv"))]
    assert all(torch.equal(loaded[n], donor[n]) for n in same)
    std = torch.tensor(IMAGENET_STD).reshape(1, 3, 1, 1)
    assert torch.allclose(loaded[stem][:, :3] * std, donor[stem], atol=1e-6) and (loaded[stem][:, 3:] == 0).all()
    neck = "neck.fusion_stage.layers.0.projection.weight"
    assert torch.equal(loaded[neck], fresh if published == "dinov2" else donor[neck])
    with refused(found="missing backbone"):
        save_file({"neck.x": torch.zeros(1)}, str(tmp_path / "no.safetensors"))
        load_pretrained(network, tmp_path / "no.safetensors")


class Plain(torch.nn.Module):
    """A network that takes the light as separate tensors: a saved program knows no NamedTuple of ours."""

    def __init__(self, network) -> None:
        super().__init__()
        self.network = network

    def forward(self, image, mask, rays, *light):
        return self.network(image, mask, rays, LightTerms(*light))


@pytest.mark.slow
@pytest.mark.parametrize("size", [(256, 320), (518, 518)])
def test_dpt_runs_trains_is_saved_and_exported_at_real_sizes(tmp_path, size):
    from lightdepth.checkpoint import load_model, save_model

    network = dpt_network(encoder="vits14")
    image, mask, rays, light = scene(1, *size)
    optimizer = torch.optim.AdamW(network.parameters(), lr=1e-4)
    before = network.body.head.weight.detach().clone()
    network(image, mask, rays, light)[0].log().square().mean().backward()
    optimizer.step()
    assert not torch.equal(network.body.head.weight, before)
    save_model(network, tmp_path / "a.safetensors", {"rows": size[0]}, half=False)
    loaded = load_model(tmp_path / "a.safetensors").network
    with torch.no_grad():
        expected = loaded(image, mask, rays, light)
        program = torch.export.export(Plain(loaded), (image, mask, rays, *light))
        torch.export.save(program, tmp_path / "a.pt2")
        exported = torch.export.load(tmp_path / "a.pt2").module()(image, mask, rays, *light)
    assert all(torch.allclose(a, b, rtol=1e-4, atol=1e-5) for a, b in zip(exported, expected, strict=True))


def test_the_tiny_network_is_exported_by_torch_export_and_saved(tmp_path):
    image, mask, rays, light = scene(1, 32, 40)
    network = Plain(build_network(NetworkConfig(width=4)).eval().requires_grad_(False))
    given = (image, mask, rays, *light)
    torch.export.save(torch.export.export(network, given), tmp_path / "a.pt2")
    exported = torch.export.load(tmp_path / "a.pt2").module()
    assert all(torch.allclose(a, b, atol=1e-5) for a, b in zip(exported(*given), network(*given), strict=True))


@pytest.mark.parametrize("width", [1, 9, 16, 31, 110])
@pytest.mark.parametrize("norm", ["batch", "group"])
def test_the_tiny_network_has_any_width(width, norm):
    with torch.device("meta"):
        network = build_network(NetworkConfig(width=width, norm=norm))
    groups = [m for m in network.modules() if isinstance(m, torch.nn.GroupNorm)]
    assert all(m.num_channels // m.num_groups >= min(8, m.num_channels) for m in groups)
    assert bool(groups) == (norm == "group")
