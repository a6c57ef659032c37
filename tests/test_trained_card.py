"""What the card of a checkpoint says that it learned from."""

from pathlib import Path
from types import SimpleNamespace

import lightdepth
from lightdepth.checkpoint import read_card
from lightdepth.module import LightDepth
from lightdepth.network import NetworkConfig
from train.colons import TubeData
from train.trained_card import trained_on

PACKAGED = Path(lightdepth.__file__).parent / "weights"


def test_a_card_says_whose_weights_a_training_began_with(tmp_path, monkeypatch):
    monkeypatch.setattr("lightdepth.module.load_pretrained", lambda *_: None)
    data = SimpleNamespace(tube=TubeData(), sequences=["a"], split=None, size=(8, 8))
    (tmp_path / "Miller.pth").write_bytes(b"weights")
    own = NetworkConfig.from_dict(read_card(PACKAGED / "lightdepth-both.safetensors")["network"])
    for given, said in (
        ({"pretrained": "imagenet"}, "Its encoder began with the weights of ImageNet."),
        ({"pretrained": str(tmp_path / "Miller.pth")}, "Its encoder began with the weights of the file "),
        ({"start": "lightdepth-both"}, "All its weights began with those of lightdepth-both."),
        ({"start": str(PACKAGED / "lightdepth-both.safetensors")}, "those of the checkpoint "),
    ):
        text = trained_on(LightDepth(own if "start" in given else NetworkConfig(), **given), data)
        assert said in text and "Miller" not in text and str(PACKAGED) not in text
    assert "began" not in trained_on(LightDepth(), data)
