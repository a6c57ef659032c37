import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from lightning.pytorch import Callback, seed_everything
from scenes import cylinder

import train.fit as fit_module
from lightdepth.calibration import write_camera, write_light
from lightdepth.camera import Pinhole
from lightdepth.checkpoint import load_model, read_card
from lightdepth.errors import InputError
from lightdepth.frame import to_batch
from lightdepth.geometry import normals_from_distance
from lightdepth.losses import LossConfig, self_supervised_loss
from lightdepth.module import LightDepth
from lightdepth.network import NetworkConfig
from lightdepth.photometry import PhotometricCalibration, irradiance
from train.callbacks import validation_line
from train.cli import train
from train.datamodule import FrameDataModule, TubeData, augmented, collate, flipped, read_frame_list

CONFIGS = sorted((Path(__file__).parents[1] / "configs" / "train").glob("*.yaml"))
LIGHT = PhotometricCalibration(gain=100.0, position_mm=(1.0, 2.0, 0.5), direction=(0.1, -0.05, 1.0))
CAMERA = Pinhole(40, 32, 22.0, 22.0, 18.0, 17.0)
TINY_RUN = [
    *["--data.size", "[40, 32]", "--data.tube.scenes", "2", "--data.tube.val_scenes", "1", "--data.tube.frames", "4"],
    *["--model.network.width", "4", "--trainer.accelerator", "cpu", "--trainer.val_check_interval", "10"],
]


def batch_of(count: int = 2):
    return collate([to_batch(cylinder(CAMERA).frame(light=LIGHT)) for _ in range(count)])


def write_sequence(folder: Path, count: int = 12) -> Path:
    """Frames of a cylinder as a folder of images with camera and light beside them."""
    (folder / "frames").mkdir(parents=True)
    image = cylinder(CAMERA).frame(light=LIGHT).image
    for i in range(count):
        cv2.imwrite(str(folder / "frames" / f"{i:04d}.png"), np.round(image[..., ::-1] * 255).astype(np.uint8))
    write_camera(CAMERA, folder / "camera.json")
    write_light(LIGHT, folder / "light.json")
    return folder


@pytest.mark.parametrize("axis", [0, 1])
def test_a_mirrored_batch_is_lit_as_its_mirrored_scene(axis):
    """The direct light rendered from mirrored geometry is the mirrored direct light: rays and light flipped rightly."""
    batch = batch_of()

    def lit(b):
        return irradiance(b.true_distance, normals_from_distance(b.true_distance, b.rays), b.rays, b.light)

    mirrored = flipped(batch, torch.tensor([True, False]), axis)
    before, after = lit(batch), lit(mirrored)
    assert torch.allclose(after[0], before[0].flip(-1 - axis), rtol=1e-4)
    assert torch.equal(after[1], before[1])
    assert not torch.allclose(before[0], before[0].flip(-1 - axis), rtol=1e-2)  # or this would prove nothing
    twice = flipped(mirrored, torch.tensor([True, False]), axis)
    assert all(torch.equal(a, b) for a, b in zip(twice.light, batch.light, strict=True))
    assert torch.equal(twice.rays, batch.rays) and torch.equal(twice.image, batch.image)


def test_augmentation_follows_from_the_generator_and_keeps_images_in_range():
    batch = batch_of(4)
    first, second, third = (augmented(batch, torch.Generator().manual_seed(s)) for s in (1, 1, 2))
    assert torch.equal(first.image, second.image) and not torch.equal(first.image, third.image)
    assert first.image.min() >= 0 and first.image.max() <= 1


def test_synthetic_colons_follow_from_the_seed_and_validation_colons_are_others():
    def made(seed):
        data = FrameDataModule(tube=TubeData(scenes=1, val_scenes=1, frames=2), size=(40, 32), seed=seed)
        data.setup()
        assert data.counts == {"train": 2, "val": 2}
        return data._train[0], data._val[0]

    (train_a, val_a), (train_b, _), (train_c, _) = made(0), made(0), made(1)
    assert torch.equal(train_a.image, train_b.image)
    assert not torch.equal(train_a.image, train_c.image) and not torch.equal(train_a.image, val_a.image)
    assert train_a.true_valid.any()


def test_training_frames_can_be_chosen_by_a_list(tmp_path):
    sequence = write_sequence(tmp_path / "seq")
    listed = tmp_path / "list.txt"
    listed.write_text("# chosen\n0001.png\n0004\n\n0005.png\n")
    assert read_frame_list(listed) == ["0001.png", "0004", "0005.png"]
    data = FrameDataModule([str(sequence)], frames=str(listed), size=(40, 32))
    data.setup()
    assert data.counts == {"train": 2, "val": 1}
    listed.write_text("0999.png\n")
    with pytest.raises(InputError, match="none of the 1 listed"):
        FrameDataModule([str(sequence)], frames=str(listed)).setup()
    with pytest.raises(InputError, match="cannot be read"):
        FrameDataModule([str(sequence)], frames=str(tmp_path / "no.txt")).setup()


def test_the_last_tenth_of_a_sequence_is_held_out_unless_there_are_validation_sequences(tmp_path):
    sequence, other = (str(write_sequence(tmp_path / name, 20)) for name in ("seq", "other"))
    for val_sequences, counts in (([], {"train": 18, "val": 2}), ([other], {"train": 20, "val": 20})):
        data = FrameDataModule([sequence], val_sequences, size=(40, 32))
        data.setup()
        assert data.counts == counts


def test_nothing_to_train_on_is_said():
    with pytest.raises(InputError, match=r"data\.sequences"):
        FrameDataModule().setup()
    with pytest.raises(InputError, match="val_scenes"):
        FrameDataModule(tube=TubeData(scenes=1, frames=1), size=(20, 16)).setup()


def test_training_steps_lower_the_loss():
    seed_everything(0, verbose=False)
    module = LightDepth(NetworkConfig(width=4, norm="group"), LossConfig(reflectance=0.0), rows=32)
    batch = batch_of()
    optimizer = torch.optim.AdamW(module.parameters(), lr=3e-3)
    losses = []
    for _ in range(30):
        total, _ = self_supervised_loss(*module(batch), batch, module.loss_config)
        optimizer.zero_grad()
        total.backward()
        optimizer.step()
        losses.append(total.item())
    assert np.mean(losses[-5:]) < 0.8 * np.mean(losses[:5])


def test_module_comes_back_from_its_plain_hyper_parameters():
    module = LightDepth(NetworkConfig(width=4), LossConfig(smoothness=3.0), rows=24)
    again = LightDepth(**json.loads(json.dumps(dict(module.hparams))))
    assert again.network.config == module.network.config
    assert (again.loss_config, again.rows) == (module.loss_config, 24)


@pytest.fixture(scope="module")
def finished_run(tmp_path_factory) -> Path:
    run = tmp_path_factory.mktemp("runs") / "first"
    assert train(["-o", str(run), *TINY_RUN, "--trainer.max_steps", "20"]) == 0
    return run


def steps_in(run: Path) -> int:
    return torch.load(run / "checkpoints" / "last.ckpt", weights_only=True)["global_step"]


def test_a_run_writes_its_files_and_the_record_is_complete(finished_run):
    for name in (
        "config.yaml",
        "log.txt",
        "model.safetensors",
        "model.md",
        "checkpoints/last.ckpt",
        "checkpoints/best.ckpt",
    ):
        assert (finished_run / name).is_file(), name
    assert list((finished_run / "tensorboard").glob("events*"))
    record = json.loads((finished_run / "run.json").read_text())
    assert record["steps"] == 20 == steps_in(finished_run) and not record["resumed"]
    assert {"loss", "abs_rel_median", "closed_form/abs_rel_median"} <= set(record["errors"])
    log = (finished_run / "log.txt").read_text()
    assert "step 20/20" in log and "left" in log and "closed form AbsRel" in log


def test_the_exported_model_and_both_checkpoints_predict(finished_run):
    frame = cylinder(CAMERA).frame(light=LIGHT)
    for name in ("model.safetensors", "checkpoints/last.ckpt", "checkpoints/best.ckpt"):
        model = load_model(finished_run / name)
        assert model.rows == 32
        assert np.isfinite(model(frame).distance).all()
    card = read_card(finished_run / "model.safetensors")
    assert card["errors"] == json.loads((finished_run / "run.json").read_text())["errors"]
    assert "no truth" in (finished_run / "model.md").read_text()


def test_a_run_is_not_overwritten_unasked(finished_run):
    before = (finished_run / "run.json").read_bytes()
    with pytest.raises(InputError, match="--resume"):
        train(["-o", str(finished_run), *TINY_RUN])
    with pytest.raises(InputError, match="contradict"):
        train(["-o", str(finished_run), *TINY_RUN, "--resume", "--overwrite"])
    assert (finished_run / "run.json").read_bytes() == before


def test_a_resumed_run_goes_on_from_its_step_with_its_own_configuration(finished_run, tmp_path):
    run = tmp_path / "resumed"
    shutil.copytree(finished_run, run)
    assert train(["-o", str(run), "--resume", "--trainer.max_steps", "30"]) == 0
    assert steps_in(run) == 30
    record = json.loads((run / "run.json").read_text())
    assert record["resumed"] and record["steps"] == 30 and record["frames"] == {"train": 8, "val": 4}
    log = (run / "log.txt").read_text()
    assert "resuming from last.ckpt" in log and "step 30/30" in log


def test_a_damaged_checkpoint_is_not_resumed_and_the_run_stays_as_it_was(finished_run, tmp_path):
    run = tmp_path / "damaged"
    shutil.copytree(finished_run, run)
    (run / "checkpoints" / "last.ckpt").write_bytes(b"damaged")
    with pytest.raises(InputError, match=r"last\.ckpt"):
        train(["-o", str(run), "--resume"])
    assert (run / "run.json").is_file()


def test_overwriting_starts_anew_but_not_before_the_data_are_known_to_be_there(finished_run, tmp_path):
    run = tmp_path / "again"
    shutil.copytree(finished_run, run)
    with pytest.raises(InputError):
        train(["-o", str(run), "--overwrite", "--data.sequences", f"[{tmp_path / 'missing'}]"])
    assert steps_in(run) == 20
    assert train(["-o", str(run), "--overwrite", *TINY_RUN, "--trainer.max_steps", "2"]) == 0
    assert steps_in(run) == 2


def test_an_interrupted_run_resumed_ends_where_an_uninterrupted_one_does(finished_run, tmp_path):
    """Same order, augmentation and schedule: the checkpoint at step 10 of 20, continued, gives the same weights."""
    run = tmp_path / "interrupted"
    arguments = ["-o", str(run), *TINY_RUN, "--trainer.max_steps", "20"]

    class Interrupted(RuntimeError):
        pass

    class Stop(Callback):
        def on_train_batch_start(self, trainer, module, batch, batch_idx):
            if trainer.global_step == 10:
                raise Interrupted

    original = fit_module._with_callbacks
    fit_module._with_callbacks = lambda given, output, echo: original({**given, "callbacks": [Stop()]}, output, echo)
    try:
        with pytest.raises(Interrupted):
            train(arguments)
    finally:
        fit_module._with_callbacks = original
    assert steps_in(run) == 10 and not (run / "run.json").exists()
    with pytest.raises(InputError, match="unfinished"):
        train(arguments)
    assert train([*arguments, "--resume"]) == 0
    weights = [
        torch.load(r / "checkpoints" / "last.ckpt", weights_only=True)["state_dict"] for r in (run, finished_run)
    ]
    assert all(torch.allclose(weights[0][name], weights[1][name], atol=1e-5) for name in weights[0])


def test_training_on_a_folder_without_truth_reports_the_loss_alone(tmp_path):
    sequence = write_sequence(tmp_path / "seq")
    run = tmp_path / "run"
    options = ["--data.sequences", f"[{sequence}]", "--data.size", "[40, 32]", "--model.network.width", "4"]
    assert train(["-o", str(run), *options, "--trainer.max_steps", "3", "--trainer.accelerator", "cpu"]) == 0
    errors = json.loads((run / "run.json").read_text())["errors"]
    assert "loss" in errors and "abs_rel_median" not in errors
    assert list(json.loads((run / "run.json").read_text())["inputs"]) == [str(sequence)]


def test_a_run_on_a_split_names_it_in_its_record_and_card(tmp_path):
    for name in ("a", "b"):
        write_sequence(tmp_path / "root" / name, 4)
    split = tmp_path / "mine" / "splits" / "two.yaml"
    split.parent.mkdir(parents=True)
    split.write_text("parts: {train: [a], val: [b], test: [not there]}\n")
    run = tmp_path / "run"
    options = ["--data.split", str(split), "--data.root", str(tmp_path / "root"), "--data.size", "[40, 32]"]
    options += ["--model.network.width", "4", "--trainer.max_steps", "2", "--trainer.accelerator", "cpu"]
    assert train(["-o", str(run), *options]) == 0
    record = json.loads((run / "run.json").read_text())
    assert record["split"] == str(split) and record["frames"] == {"train": 4, "val": 4}
    assert list(record["inputs"]) == [str(tmp_path / "root" / name) for name in "ab"]
    assert "1 sequences of the split mine/two" in (run / "model.md").read_text()


@pytest.mark.parametrize("path", CONFIGS, ids=lambda p: p.name)
def test_every_shipped_configuration_loads_and_says_what_it_is_for(path, capsys):
    assert path.read_text().startswith("# ")
    with pytest.raises(SystemExit) as stopped:
        train(["--config", str(path), "--print_config"])
    assert stopped.value.code == 0
    assert "max_steps" in capsys.readouterr().out


def test_dotted_overrides_reach_the_configuration(capsys):
    with pytest.raises(SystemExit):
        train(
            [
                "--data.tube.scenes",
                "4",
                "--model.network.kind",
                "unet",
                "--model.loss.smoothness",
                "3",
                "--print_config",
            ]
        )
    shown = capsys.readouterr().out
    assert "scenes: 4" in shown and "kind: unet" in shown and "smoothness: 3.0" in shown


def test_a_mistyped_option_is_wrong_usage(capsys):
    with pytest.raises(SystemExit) as stopped:
        train(["-o", "x", "--data.tube.scene", "4"])
    assert stopped.value.code == 2


def test_the_validation_line_names_network_and_closed_form():
    metrics = {f"val/{p}{n}_median": 0.5 for p in ("", "closed_form/") for n in ("abs_rel", "rmse_mm", "medae_mm")}
    assert "closed form AbsRel 0.5" in validation_line({**metrics, "val/loss": 1.0})
    assert validation_line({"val/loss": 1.0}) == "validation loss 1"


def test_every_light_keeps_its_numbers_through_collation():
    lights = [LIGHT, replace(LIGHT, mu=0.0)]
    batch = collate([to_batch(cylinder(CAMERA).frame(light=light)) for light in lights])
    assert batch.light.mu.flatten().tolist() == pytest.approx([LIGHT.mu, 0.0])
