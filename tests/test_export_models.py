"""Checkpoints and predictions as other programs take them: graphs, folders for a hub, pictures of depth."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from colons import colon, truth
from raising import refused
from safetensors.torch import load_file, save_file

from densify.evaluation.depth_files import DepthReading
from lightdepth import from_pretrained
from lightdepth.camera import KannalaBrandt
from lightdepth.checkpoint import bundled, load_model, save_model
from lightdepth.cli import main
from lightdepth.datasets import write_folder
from lightdepth.decline import log_closed_form
from lightdepth.exporting import graph
from lightdepth.exporting.depth import depth_of
from lightdepth.files.exr import read_exr, write_exr
from lightdepth.files.images import read_image
from lightdepth.frame import to_batch
from lightdepth.models import NetworkModel, working_size
from lightdepth.network import NetworkConfig, build_network
from lightdepth.prediction import read_prediction

FISHEYE = KannalaBrandt(96, 80, 52.0, 51.0, 47.0, 41.0, -0.05, 0.01, 0.0, 0.0)
SIZE = (58, 48)
"""Width and height at which a network of 48 rows sees the frames."""


def network(**changes):
    """A small network whose outputs are not those of a fresh one: its last layer says something."""
    torch.manual_seed(0)
    made = build_network(NetworkConfig(width=4, **changes)).eval()
    torch.nn.init.normal_(made.body.head.weight, std=0.05)
    return made


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory) -> Path:
    file = tmp_path_factory.mktemp("model") / "small.safetensors"
    save_model(network(), file, {"rows": 48, "trained_on": "nothing", "errors": {"abs_rel": 0.5}}, half=False)
    return file


def export(what: Path | str, out: Path, *options: str) -> Path:
    assert main(["export", str(what), "-o", str(out), *options]) == 0
    return out


@pytest.fixture(scope="module")
def traced_once():
    """Tracing takes seconds, and both graphs of the checkpoint begin with it."""
    kept, traced = {}, graph.traced

    def once(network, rows, size=None):
        if size is None:
            return traced(network, rows)
        return kept.get(size) or kept.setdefault(size, traced(network, rows, size))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(graph, "traced", once)
        yield


@pytest.fixture(scope="module")
def torch_graph(checkpoint, traced_once, tmp_path_factory) -> Path:
    return export(checkpoint, tmp_path_factory.mktemp("g") / "torch", "--to", "torch", "--size", str(list(SIZE)))


@pytest.fixture(scope="module")
def onnx_graph(checkpoint, traced_once, tmp_path_factory) -> Path:
    pytest.importorskip("onnxruntime")
    pytest.importorskip("onnxscript")
    return export(checkpoint, tmp_path_factory.mktemp("g") / "onnx", "--to", "onnx", "--size", str(list(SIZE)))


@pytest.mark.parametrize("size", [(48, 61), (33, 40), (120, 37)])
def test_the_blur_by_matrices_is_the_blur(size):
    image, mask, rays, light = graph.example_inputs(*size, 2)
    terms = graph.light_terms(light)
    for blur in (0.018, 0.1, 0.0):
        found = graph.matrix_closed_form(image, mask, rays, terms, blur)
        assert torch.allclose(found, log_closed_form(image, mask, rays, terms, blur), atol=2e-6)


def test_a_torch_graph_says_what_the_network_says(torch_graph, checkpoint):
    model = load_model(checkpoint)
    inputs = graph.example_inputs(SIZE[1], SIZE[0])
    found = [v.numpy() for v in torch.export.load(torch_graph / "model.pt2").module()(*inputs)]
    assert graph.difference(found, graph.module_outputs(model.network, inputs)) < 1e-5
    assert json.loads((torch_graph / "run.json").read_text())["difference"] < 1e-5


def test_an_onnx_graph_says_what_the_network_says(onnx_graph, checkpoint):
    import onnx

    onnx.checker.check_model(str(onnx_graph / "model.onnx"))
    inputs = graph.example_inputs(SIZE[1], SIZE[0])
    found = graph.run_onnx(onnx_graph / "model.onnx", inputs)
    assert graph.difference(found, graph.module_outputs(load_model(checkpoint).network, inputs)) < 1e-5
    assert len(found) == 2 and found[0].shape == (1, 1, 48, 58)


@pytest.mark.parametrize("kind", ["onnx", pytest.param("torch", marks=pytest.mark.slow)])
def test_the_example_runs_without_the_program_and_gives_its_distance(kind, checkpoint, tmp_path, request):
    folder = request.getfixturevalue(f"{kind}_graph")
    frame = replace(colon(0, 8, 9.0, FISHEYE).frames[0], mask=None)
    write_folder([frame], tmp_path / "data")
    image = tmp_path / "data" / "frames" / f"{frame.name}.png"
    model = "model.onnx" if kind == "onnx" else "model.pt2"
    # the program cannot be imported there, and neither can torch where it has no part in it
    blocked = ["lightdepth", *(["torch"] if kind == "onnx" else [])]
    words = [str(folder / model), str(image), str(tmp_path / "data" / "camera.json"), str(tmp_path / "out.npy")]
    code = f"import sys, runpy; sys.modules |= dict.fromkeys({blocked!r}); sys.argv[1:] = {words!r}; "
    code += f"runpy.run_path({str(folder / 'example.py')!r}, run_name='__main__')"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    frame = replace(frame, image=read_image(image))  # 8 bits
    batch = to_batch(replace(frame, light=replace(frame.light, **json_light(folder))), working_size(FISHEYE, 48))
    wanted = load_model(checkpoint).network.estimate(batch.image, batch.mask, batch.rays, batch.light).distance[0, 0]
    found, mask = np.load(tmp_path / "out.npy"), batch.mask[0, 0].numpy()
    assert found.shape == wanted.shape == (48, 58) and np.array_equal(found > 0, mask) and mask.mean() > 0.5
    assert np.abs(np.log(found[mask] / wanted.detach().numpy()[mask])).max() < 1e-4


def test_the_example_without_its_words_says_which_it_takes(onnx_graph):
    run = [sys.executable, str(onnx_graph / "example.py")]
    done = subprocess.run(run, capture_output=True, text=True, check=False)
    assert done.returncode == 1 and "python example.py model.onnx IMAGE CAMERA.json OUT.npy [MASK]" in done.stderr


def json_light(folder: Path) -> dict[str, float]:
    return json.loads((folder / "model.json").read_text())["light"]


@pytest.mark.slow
@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"inputs": ("rgb", "closed_form", "ray_z", "mask", "reflectance"), "output": "absolute", "uncertainty": True},
        {"norm": "batch", "output": "free"},
        {"kind": "unet"},
        {"kind": "unet", "encoder": "efficientnet-lite0"},
    ],
)
def test_a_graph_takes_images_and_batches_of_any_size(changes, tmp_path):
    net = network(**changes)
    program = graph.traced(net, 64)
    graph.write_torch(program, tmp_path / "m.pt2")
    names = ("distance", "albedo", "log_sigma")[: 2 + (net.uncertainty is not None)]
    graph.write_onnx(program, tmp_path / "m.onnx", names)
    for size in ((64, 80, 1), (97, 133, 1), (40, 200, 3), (160, 64, 2)):
        inputs = graph.example_inputs(*size)
        wanted = graph.module_outputs(net, inputs)
        assert graph.difference(graph.run_torch(tmp_path / "m.pt2", inputs), wanted) < 1e-5
        assert graph.difference(graph.run_onnx(tmp_path / "m.onnx", inputs), wanted) < 1e-5


@pytest.mark.slow
@pytest.mark.parametrize("name", bundled())
def test_the_bundled_checkpoints_are_exported_for_any_size(name, tmp_path):
    for kind in ("onnx", "torch"):
        folder = export(name, tmp_path / kind, "--to", kind)
        assert json.loads((folder / "model.json").read_text())["difference"] < 1e-5
        assert f"# {name}" in (folder / "README.md").read_text()


def test_a_graph_that_differs_is_refused(checkpoint, tmp_path, monkeypatch, capsys):
    for name, given in {"traced": None, "write_torch": None, "run_torch": None, "difference": 0.1}.items():
        monkeypatch.setattr(graph, name, lambda *_, given=given: given)
    assert main(["export", str(checkpoint), "-o", str(tmp_path / "o"), "--to", "torch", "--size", "[48, 48]"]) == 3
    assert "differs from the network by 0.1" in capsys.readouterr().err and not (tmp_path / "o").exists()


def test_a_graph_that_takes_one_size_alone_is_refused_for_any(checkpoint, tmp_path, monkeypatch, capsys):
    def one_size(*_):
        raise RuntimeError("expected 48")

    for name in ("traced", "write_torch"):
        monkeypatch.setattr(graph, name, lambda *_: None)
    monkeypatch.setattr(graph, "run_torch", one_size)
    assert main(["export", str(checkpoint), "-o", str(tmp_path / "o"), "--to", "torch"]) == 3
    assert "give --size, the only one" in capsys.readouterr().err
    monkeypatch.setitem(sys.modules, "onnxscript", None)
    assert main(["export", str(checkpoint), "-o", str(tmp_path / "o"), "--to", "onnx"]) == 3
    assert "pip install 'lightdepth[onnx]'" in capsys.readouterr().err


def test_a_folder_for_a_hub_comes_back_by_from_pretrained_and_by_every_verb(checkpoint, tmp_path):
    folder = export(checkpoint, tmp_path / "mine", "--to", "safetensors", "--no-half")
    first, model = load_model(checkpoint), from_pretrained(folder)
    assert isinstance(model, NetworkModel) and model.name == "mine" and model.rows == 48
    kept = first.network.state_dict()
    assert all(torch.equal(v, kept[name]) for name, v in model.network.state_dict().items())
    card = (folder / "README.md").read_text()
    assert card.startswith("---\nlibrary_name: lightdepth") and "from_pretrained" in card and "abs_rel: 0.5" in card
    half = export(checkpoint, tmp_path / "half", "--to", "safetensors")
    assert (half / "model.safetensors").stat().st_size < 0.6 * (folder / "model.safetensors").stat().st_size
    write_folder(colon(0, 8, 9.0, FISHEYE).frames[:1], tmp_path / "data")
    assert main(["predict", str(tmp_path / "data"), "-o", str(tmp_path / "p"), "--checkpoint", str(folder)]) == 0


def test_config_json_stands_in_for_metadata_that_another_program_left_out(checkpoint, tmp_path):
    folder = export(checkpoint, tmp_path / "mine", "--to", "safetensors")
    save_file(load_file(folder / "model.safetensors"), folder / "model.safetensors")
    assert from_pretrained(folder).rows == 48
    (folder / "config.json").write_text("{}")
    with refused(found="metadata"):
        from_pretrained(folder)
    (folder / "config.json").unlink()
    with refused(found="metadata"):
        from_pretrained(folder)


def test_the_hub_is_asked_for_an_id_alone(checkpoint, tmp_path, monkeypatch):
    hub = pytest.importorskip("huggingface_hub")
    folder, asked = export(checkpoint, tmp_path / "mine", "--to", "safetensors"), []

    def fetched(hub_id, revision, allow_patterns):
        asked.append((hub_id, revision, tuple(allow_patterns)))
        return str(folder)

    monkeypatch.setattr(hub, "snapshot_download", fetched)
    from_pretrained(folder), from_pretrained(checkpoint), from_pretrained("decline")
    monkeypatch.chdir(tmp_path.parent)
    from_pretrained(f"{tmp_path.name}/mine")  # looks like an id, and is a path
    with refused(found="no such checkpoint"):
        load_model("someone/something")
    assert not asked
    assert from_pretrained("someone/something", revision="v1").rows == 48
    assert load_model("hf://someone/something").name == "mine"
    wanted = ("model.safetensors", "config.json", "README.md")
    assert asked == [("someone/something", "v1", wanted), ("someone/something", None, wanted)]

    def away(*_, **__):
        raise OSError("no network")

    monkeypatch.setattr(hub, "snapshot_download", away)
    with refused(where="someone/something", found="no network"):
        from_pretrained("someone/something")
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    with refused(cure="lightdepth[hub]"):
        from_pretrained("someone/something")


@pytest.fixture(scope="module")
def predictions(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("predictions") / "p"
    folder.mkdir()
    for frame in colon(0, 8, 9.0, FISHEYE).frames[:2]:
        replace(truth(frame), unit="mm").save(folder / f"{frame.name}.npz")
    return folder


def test_depth_goes_to_16_bit_png_and_is_read_back_by_evaluate(predictions, tmp_path, capsys):
    folder = export(predictions, tmp_path / "png", "--to", "png")
    step = json.loads((folder / "run.json").read_text())["step"]
    assert f"--depth-scale {step:g}" in capsys.readouterr().out
    for file in predictions.glob("*.npz"):
        codes = cv2.imread(str(folder / f"{file.stem}.png"), cv2.IMREAD_UNCHANGED)
        depth = depth_of(read_prediction(file))
        assert codes.dtype == np.uint16 and np.array_equal(codes > 0, depth > 0)
        assert np.abs(codes * step - depth).max() <= step / 2 * 1.001
        again = DepthReading("depth", step).read(folder / f"{file.stem}.png", FISHEYE)
        assert again.unit == "mm" and np.abs(again.distance / truth_of(file) - 1)[again.valid].max() < 2e-3


def truth_of(file: Path) -> np.ndarray:
    return read_prediction(file).distance


def test_depth_of_no_stated_kind_is_refused_with_the_option_that_states_it(predictions, tmp_path, capsys):
    assert main(["export", str(predictions), "-o", str(tmp_path / "exr"), "--to", "exr"]) == 0
    write_folder(colon(0, 8, 9.0, FISHEYE).frames[:2], tmp_path / "data")
    refused = ["evaluate", str(tmp_path / "exr"), "--truth", str(tmp_path / "data"), "-o", str(tmp_path / "e")]
    assert main(refused) == 3
    assert "do not say what their numbers are; say --depth-kind" in capsys.readouterr().err


def test_depth_goes_to_exr_and_comes_back_by_openexr_to_the_last_bit(predictions, tmp_path):
    exr = pytest.importorskip("OpenEXR")
    folder = export(predictions, tmp_path / "exr", "--to", "exr")
    for file in predictions.glob("*.npz"):
        with exr.File(str(folder / f"{file.stem}.exr")) as read:
            assert np.array_equal(read.channels()["Z"].pixels, depth_of(read_prediction(file)))
        again = DepthReading("depth", 1.0).read(folder / f"{file.stem}.exr", FISHEYE)
        assert np.abs(again.distance / truth_of(file) - 1)[again.valid].max() < 1e-5
    write_exr(tmp_path / "odd.exr", np.arange(15, dtype=np.float32).reshape(3, 5))
    with exr.File(str(tmp_path / "odd.exr")) as read:
        assert np.array_equal(read.channels()["Z"].pixels, np.arange(15).reshape(3, 5))


@pytest.mark.parametrize("compression", ["NO", "ZIPS", "ZIP", "PIZ"])
@pytest.mark.parametrize("kind", [np.float32, np.float16, np.uint32])
def test_an_exr_of_openexr_s_is_read_to_the_last_bit_or_refused_by_its_compression(tmp_path, compression, kind):
    exr = pytest.importorskip("OpenEXR")
    rng = np.random.default_rng(0)
    made = {"depth": rng.uniform(0, 99, (37, 21)).astype(kind), "sigma": np.zeros((37, 21), np.float32)}
    header = {"compression": getattr(exr, f"{compression}_COMPRESSION"), "type": exr.scanlineimage}
    exr.File(header, dict(made)).write(str(tmp_path / "a.exr"))
    if compression == "PIZ":
        with refused(found="PIZ compression", cure="ZIP"):
            read_exr(tmp_path / "a.exr")
        return
    found = read_exr(tmp_path / "a.exr")
    assert found.keys() == made.keys()
    assert all(found[name].dtype == made[name].dtype and np.array_equal(found[name], made[name]) for name in made)


def test_an_exr_that_is_cut_off_or_none_is_refused(tmp_path):
    write_exr(tmp_path / "a.exr", np.ones((8, 9), np.float32))
    whole = (tmp_path / "a.exr").read_bytes()
    for length in range(4, len(whole), 7):
        (tmp_path / "a.exr").write_bytes(whole[:length])
        with refused(found="a broken EXR file"):
            read_exr(tmp_path / "a.exr")
    (tmp_path / "a.exr").write_bytes(b"no picture")
    with refused(found="not an EXR file"):
        read_exr(tmp_path / "a.exr")


@pytest.mark.parametrize(("after", "number"), [(b"compression\0compression\0", -28), (b"Z\0", -1), (b"Z\0", 9)])
def test_an_exr_whose_header_leads_back_or_names_no_type_is_refused(tmp_path, after, number):
    write_exr(tmp_path / "a.exr", np.ones((8, 9), np.float32))
    whole = (tmp_path / "a.exr").read_bytes()
    at = whole.index(after) + len(after)
    (tmp_path / "a.exr").write_bytes(whole[:at] + number.to_bytes(4, "little", signed=True) + whole[at + 4 :])
    with refused(found="a broken EXR file"):
        read_exr(tmp_path / "a.exr")


def test_depth_that_does_not_fit_16_bits_is_refused(predictions, tmp_path, capsys):
    argv = ["export", str(predictions), "-o", str(tmp_path / "o"), "--to", "png", "--step"]
    assert main([*argv, "1e9"]) == 3 and "less than 10 steps" in capsys.readouterr().err
    assert main([*argv, "1e-9"]) == 3
    said = capsys.readouterr().err
    assert "more than 65535 steps of 1e-09; give a larger one, such as 0.001" in said and str(tmp_path) not in said
    for bad in ("0", "-1"):
        assert main([*argv, bad]) == 3 and "above 0" in capsys.readouterr().err
    argv[argv.index("png")] = "exr"
    assert main([*argv, "1"]) == 3 and "only png has it" in capsys.readouterr().err


@pytest.mark.parametrize("size", ["[100, 0]", "[-5, 5]"])
def test_a_size_of_no_pixels_is_refused_as_such(checkpoint, tmp_path, capsys, size):
    assert main(["export", str(checkpoint), "-o", str(tmp_path / "o"), "--to", "torch", "--size", size]) == 3
    assert f"--size: {size}; expected each number" in capsys.readouterr().err
