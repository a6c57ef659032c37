"""Checkpoints of strangers: nothing is executed, and no memory is given to what a file only says that it holds."""

from __future__ import annotations

import json
import os
import pickle
import struct
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
import torch
from raising import refused
from safetensors.torch import save

from lightdepth.checkpoint import load_model, read_card
from lightdepth.errors import InputError
from lightdepth.network import NetworkConfig, build_network
from lightdepth.network.pretrained import read_weights
from train.adapting.card import source_colons

SMALL = NetworkConfig(width=4)


class Reaching:
    """A pickle of it makes a file, where pickles are executed."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):
        return os.system, (f"touch {self.path}",)


def weights(config: NetworkConfig = SMALL) -> dict[str, torch.Tensor]:
    return build_network(config).state_dict()


def lightning(path: Path, network: object = None, state: object = None, rows: object = 32, **more: object) -> Path:
    state = {f"network.{k}": v for k, v in weights().items()} if state is None else state
    hyper = {"network": SMALL.to_dict() if network is None else network, "rows": rows}
    torch.save({"hyper_parameters": hyper, "state_dict": state, **more}, path)
    return path


def exported(path: Path, network: object, card: object = None, tensors: dict[str, torch.Tensor] | None = None) -> Path:
    said = {"network": json.dumps(network), "card": json.dumps({"rows": 32} if card is None else card)}
    path.write_bytes(save(weights() if tensors is None else tensors, metadata=said))
    return path


@pytest.mark.parametrize("place", ["beside the weights", "among them", "in place of all", "in a legacy file"])
def test_no_pickle_is_executed(place, tmp_path):
    canary, path = tmp_path / "canary", tmp_path / "last.ckpt"
    if place == "beside the weights":
        lightning(path, extra=Reaching(canary))
    elif place == "among them":
        lightning(path, state={"network.stem": Reaching(canary)})
    elif place == "in place of all":
        path.write_bytes(pickle.dumps(Reaching(canary)))
    else:
        torch.save(Reaching(canary), path, _use_new_zipfile_serialization=False)
    for read in (load_model, lambda file: read_weights(file.rename(tmp_path / "weights.pth"))):
        with pytest.raises(InputError):
            read(path)
    assert not canary.exists()


def nested(depth: int) -> list:
    """A list that is 2 ** depth values long where it is written out, and a few bytes where it is pickled."""
    value: list = ["x"]
    for _ in range(depth):
        value = [value, value]
    return value


def test_a_tensor_that_is_stored_in_part_only_is_refused_before_it_is_copied(tmp_path):
    huge = torch.zeros(1).expand(1 << 20, 1 << 20)
    for path in (
        lightning(tmp_path / "one.ckpt", state={"network.stem.0.weight": huge}),
        lightning(tmp_path / "other.ckpt", optimizer_states=[{"state": {0: {"exp_avg": huge}}}]),
    ):
        with refused(found="a part only", where=path.name):
            load_model(path)
    torch.save({"fc": huge}, tmp_path / "weights.pth")
    with refused(found="a part only"):
        read_weights(tmp_path / "weights.pth")
    one = torch.zeros(1 << 16)
    with refused(found="larger than the file"):
        load_model(lightning(tmp_path / "many.ckpt", state={f"network.{i}": one.view(-1) for i in range(9)}))


def test_an_archive_of_weights_that_grows_when_it_is_unpacked_is_refused(tmp_path):
    plain = lightning(tmp_path / "plain.ckpt")
    with zipfile.ZipFile(plain) as of, zipfile.ZipFile(tmp_path / "bomb.ckpt", "w", zipfile.ZIP_DEFLATED) as to:
        for part in of.infolist():
            to.writestr(part.filename, of.read(part))
    assert load_model(plain)
    with refused(found="larger unpacked"):
        load_model(tmp_path / "bomb.ckpt")


@pytest.mark.parametrize(
    "change",
    [
        {"width": 100_000},
        {"width": 4.5},
        {"width": [4]},
        {"width": -1},
        {"blur": 1e9},
        {"blur": float("nan")},
        {"inputs": ["rgb"] * 1000},
        {"inputs": 3},
        {"inputs": [["rgb"]]},
        {"kind": {"dpt": 1}},
        {"encoder": ["vitl14"]},
        {"kind": "dpt", "encoder": "vitl14"},
        {"kind": "unet"},
        {"width": 5},
        {"more": 1},
    ],
    ids=str,
)
def test_a_network_that_the_weights_are_not_of_is_refused_whatever_it_asks_for(change, tmp_path):
    network = {**SMALL.to_dict(), **change}
    with refused(where="a.safetensors"):
        load_model(exported(tmp_path / "a.safetensors", network))
    with refused(where="a.ckpt"):
        load_model(lightning(tmp_path / "a.ckpt", network))
    (tmp_path / "model.safetensors").write_bytes(save(weights()))
    (tmp_path / "config.json").write_text(json.dumps({"network": network, "card": {}}))
    with pytest.raises(InputError):
        load_model(tmp_path)


@pytest.mark.parametrize("rows", [0, -1, 10**30, "32", 1e3, None, [32]], ids=range(7))
def test_rows_that_no_image_has_are_refused(rows, tmp_path):
    with refused(found="rows"):
        load_model(exported(tmp_path / "a.safetensors", SMALL.to_dict(), {"rows": rows}))
    with refused(found="rows"):
        load_model(lightning(tmp_path / "a.ckpt", rows=rows))


def test_what_a_pickle_holds_many_times_over_is_never_written_out(tmp_path):
    for path in (
        lightning(tmp_path / "a.ckpt", {**SMALL.to_dict(), "kind": nested(60)}),
        lightning(tmp_path / "b.ckpt", {**SMALL.to_dict(), "width": nested(60)}),
        lightning(tmp_path / "c.ckpt", rows=nested(60)),
        lightning(tmp_path / "d.ckpt", nested(60)),
        lightning(tmp_path / "e.ckpt", state=nested(60)),
    ):
        with refused(where=path.name) as raised:
            load_model(path)
        assert len(str(raised.value)) < 600


def test_headers_and_configurations_of_no_measure_are_refused_by_name(tmp_path):
    path = tmp_path / "a.safetensors"
    path.write_bytes(struct.pack("<Q", 99_000_000) + b"{}")
    with refused(found="header"):
        load_model(path)
    with refused(found="header"):
        read_weights(path)
    for network in ("[" * 5000, '{"width": ' + "[" * 5000, "[1", "3", '"tiny"', "null"):
        path.write_bytes(save(weights(), metadata={"network": network, "card": "{}"}))
        with pytest.raises(InputError):
            read_card(path)
    (tmp_path / "model.safetensors").write_bytes(save(weights()))
    for text in ("[]", "3", "[" * 5000):
        (tmp_path / "config.json").write_text(text)
        with pytest.raises(InputError):
            load_model(tmp_path)


@pytest.mark.parametrize(
    "tube",
    [
        {"frames": 10**9},
        {"frames": "many"},
        {"travel": float("nan")},
        {"lenses": ["c3vd"] * 1000},
        {"lenses": ["../x"]},
        {"mu": [0, 1, 2]},
        {"gamma": "12"},
        {"family": ["plain"]},
        [1],
        "plain",
    ],
    ids=str,
)
def test_colons_that_a_card_asks_to_be_replayed_are_of_a_size_that_was_trained_on(tube):
    with refused(where="card"):
        source_colons({"tube": tube}, 1)


LIMITED = """
import resource, sys
from lightdepth.checkpoint import load_model
from lightdepth.errors import InputError
def grown():
    return int(next(l for l in open('/proc/self/status') if l.startswith('VmHWM')).split()[1]) / 1e3
before = grown()
for path in sys.argv[1:]:
    try:
        load_model(path)
    except InputError:
        continue
    sys.exit(f'{path} was read')
print(grown() - before)
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads the memory that a process had from /proc")
def test_hostile_checkpoints_cost_no_memory(tmp_path):
    paths = [
        exported(tmp_path / "wide.safetensors", {"kind": "tiny", "width": 8000}, tensors={"a": torch.zeros(1)}),
        exported(tmp_path / "large.safetensors", {"kind": "tiny", "width": 256}, tensors={"a": torch.zeros(1)}),
        lightning(tmp_path / "expanded.ckpt", state={"network.a": torch.zeros(1).half().expand(1 << 16, 1 << 16)}),
        lightning(tmp_path / "nested.ckpt", {"kind": nested(60)}),
    ]
    assert paths[0].stat().st_size < 400
    done = subprocess.run(
        [sys.executable, "-c", LIMITED, *map(str, paths)], capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 0, done.stderr
    assert float(done.stdout) < 300  # MB; the wide network alone would take 10 GB
