import json
import os
import pickle
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from raising import refused
from safetensors.torch import save_file
from scenes import cylinder

from lightdepth.camera import Pinhole
from lightdepth.checkpoint import DEFAULT_CHECKPOINT, ModelSource, bundled, load_model, read_card, save_model
from lightdepth.command_line.verbs import all_verbs, parsers_of
from lightdepth.command_line.words import options
from lightdepth.errors import InputError
from lightdepth.models import ConstantModel, DeclineModel, NetworkModel
from lightdepth.module import LightDepth
from lightdepth.network import NetworkConfig, build_network

SMALL = NetworkConfig(width=4, inputs=("rgb", "closed_form"))
CARD = {"rows": 24, "trained_on": "nothing"}


class Armed:
    """A pickle of this leaves a file behind when it is executed."""

    def __init__(self, trace: Path) -> None:
        self.trace = trace

    def __reduce__(self):
        return os.mkdir, (str(self.trace),)


def test_a_saved_network_comes_back_with_its_configuration_card_and_weights(tmp_path):
    network = build_network(SMALL)
    save_model(network, tmp_path / "a.safetensors", CARD, half=False)
    model = load_model(tmp_path / "a.safetensors")
    assert isinstance(model, NetworkModel)
    assert (model.network.config, model.card, model.rows, model.name) == (SMALL, CARD, 24, "a")
    assert all(torch.equal(value, model.network.state_dict()[name]) for name, value in network.state_dict().items())


def test_loading_a_network_leaves_a_caller_s_own_chance_alone():
    torch.manual_seed(3)
    expected = torch.rand(2)
    torch.manual_seed(3)
    load_model(DEFAULT_CHECKPOINT)
    assert torch.equal(torch.rand(2), expected)


def test_loading_a_network_does_not_load_pytorch_s_compiler():
    """Which takes a second, and would be the longest part of the start of every verb that predicts."""
    program = (
        "import sys; from lightdepth.checkpoint import load_model; load_model('lightdepth-both'); "
        "print('torch._dynamo' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False"]


def test_half_precision_halves_the_file_and_rounds_by_a_thousandth(tmp_path):
    network = build_network(NetworkConfig())
    for half in (True, False):
        save_model(network, tmp_path / f"{half}.safetensors", CARD, half=half)
    small, large = ((tmp_path / f"{half}.safetensors").stat().st_size for half in (True, False))
    assert small < 0.55 * large
    loaded = load_model(tmp_path / "True.safetensors").network.state_dict()
    for name, value in network.state_dict().items():
        assert loaded[name].dtype == value.dtype
        assert torch.allclose(loaded[name], value, rtol=1e-3, atol=1e-6)


def test_the_card_can_be_read_without_building_the_network(tmp_path):
    save_model(build_network(SMALL), tmp_path / "a.safetensors", CARD)
    assert read_card(tmp_path / "a.safetensors") == CARD


def test_names_give_the_models_that_need_no_training():
    assert isinstance(load_model("decline"), DeclineModel)
    assert isinstance(load_model("constant"), ConstantModel)


def test_a_network_is_where_it_was_asked_for_and_a_device_that_is_not_there_is_refused(monkeypatch):
    places = []
    monkeypatch.setattr(NetworkModel, "to", lambda model, device: places.append(device) or model)
    for there in (False, True):
        monkeypatch.setattr(torch.cuda, "is_available", lambda there=there: there)
        monkeypatch.setattr(torch.backends.mps, "is_available", lambda there=there: there)
        for device in ("auto", "cpu", "cuda", "mps"):
            if there or device in ("auto", "cpu"):
                ModelSource("lightdepth-self", device).load()
                continue
            for name in ("lightdepth-self", "decline"):
                with refused(where="--device", found=device, cure="cpu"):
                    load_model(name, device=device)
    assert places == ["cpu", "cpu", "cuda", "cpu", "cuda", "mps"]


def test_every_bundled_checkpoint_loads_and_has_a_card():
    weights = Path(__file__).parents[1] / "lightdepth" / "weights"
    for name in bundled():
        model = load_model(name)
        assert model.name == name and model.rows > 0 and model.card["trained_on"]
        assert (weights / f"{name}.md").read_text().startswith("# ")


def test_help_names_every_bundled_checkpoint():
    for verb in ("densify", "adapt"):
        parser = parsers_of(verb, all_verbs()[verb].load())[""]
        (said,) = (action.help for action in options(parser) if action.dest == "checkpoint")
        assert all(name in said for name in bundled()), verb


def test_the_default_checkpoint_is_bundled():
    assert DEFAULT_CHECKPOINT in bundled()
    model = load_model()
    assert model.name == DEFAULT_CHECKPOINT
    frame = cylinder(Pinhole(40, 32, 22.0, 22.0, 18.0, 17.0)).frame()
    assert model(frame).uncertainty is not None
    assert load_model("lightdepth-self")(frame).uncertainty is None  # made before there was a head for it


def test_an_unknown_name_is_refused_with_the_names_there_are():
    with refused(cure="decline") as raised:
        load_model("lightdepht")
    assert all(name in str(raised.value) for name in bundled())


def test_a_folder_or_a_foreign_suffix_is_refused(tmp_path):
    with refused(found="is a folder"):
        load_model(tmp_path)
    (tmp_path / "weights.pt").write_bytes(b"x")
    with refused(cure=".safetensors or .ckpt"):
        load_model(tmp_path / "weights.pt")


@pytest.mark.parametrize("content", [b"", b"not a checkpoint", b"\x10\x00\x00\x00\x00\x00\x00\x00{}"])
@pytest.mark.parametrize("suffix", ["safetensors", "ckpt"])
def test_rubbish_is_refused_with_the_files_name(tmp_path, content, suffix):
    path = tmp_path / f"a.{suffix}"
    path.write_bytes(content)
    with refused(where=f"a.{suffix}"):
        load_model(path)


def test_a_truncated_checkpoint_is_refused(tmp_path):
    path = tmp_path / "a.safetensors"
    save_model(build_network(SMALL), path, CARD)
    path.write_bytes(path.read_bytes()[:-100])
    with refused(found="damaged"):
        load_model(path)


def test_weights_without_a_card_or_of_another_network_are_refused(tmp_path):
    path = tmp_path / "a.safetensors"
    save_file({"w": torch.zeros(3)}, str(path))
    with refused(cure="lightdepth train"):
        load_model(path)
    metadata = {"network": json.dumps(SMALL.to_dict()), "card": json.dumps(CARD)}
    save_file({"w": torch.zeros(3)}, str(path), metadata=metadata)
    with refused(found="do not fit"):
        load_model(path)
    save_file({"w": torch.zeros(3)}, str(path), metadata={**metadata, "network": '{"kind": "vgg"}'})
    with refused(cure="tiny, unet"):
        load_model(path)


def test_weights_that_are_not_finite_are_refused(tmp_path):
    network = build_network(SMALL)
    torch.nn.init.constant_(network.body.head.bias, torch.nan)
    save_model(network, tmp_path / "a.safetensors", CARD)
    with refused(found="finite"):
        load_model(tmp_path / "a.safetensors")


def lightning_checkpoint(**extra):
    module = LightDepth(SMALL, rows=24)
    return {"hyper_parameters": dict(module.hparams), "state_dict": module.state_dict(), **extra}


def test_a_lightning_checkpoint_loads_without_pickle(tmp_path):
    torch.save(lightning_checkpoint(), tmp_path / "last.ckpt")
    model = load_model(tmp_path / "last.ckpt")
    assert (model.network.config, model.rows, model.name) == (SMALL, 24, "last")


def test_a_pickle_is_never_executed(tmp_path):
    trace = tmp_path / "executed"
    torch.save(lightning_checkpoint(callbacks=Armed(trace)), tmp_path / "a.ckpt")
    (tmp_path / "b.ckpt").write_bytes(pickle.dumps(Armed(trace)))
    (tmp_path / "c.safetensors").write_bytes(pickle.dumps(Armed(trace)))
    for name in ("a.ckpt", "b.ckpt", "c.safetensors"):
        with pytest.raises(InputError):
            load_model(tmp_path / name)
    assert not trace.exists()


def test_a_checkpoint_of_something_else_is_refused(tmp_path):
    torch.save({"state_dict": {}}, tmp_path / "a.ckpt")
    with refused(cure="lightdepth train"):
        load_model(tmp_path / "a.ckpt")
    torch.save([1, 2], tmp_path / "a.ckpt")
    with refused(cure="lightdepth train"):
        load_model(tmp_path / "a.ckpt")
