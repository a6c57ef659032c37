"""Training: runs that write what they say, go on where they ended, and stop with a diagnosis."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from colons import colon
from lightning.pytorch import Callback, seed_everything
from raising import refused, warned
from scenes import cylinder
from training import CAMERA, LIGHT, TINY_RUN, batch_of, write_sequence

import train.fit as fit_module
from lightdepth.checkpoint import load_model, read_card
from lightdepth.command_line.dry import Planned
from lightdepth.datasets import write_c3vd, write_folder
from lightdepth.datasets.endomapper import write_endomapper
from lightdepth.decline import log_closed_form
from lightdepth.errors import InputError, PartialFailure
from lightdepth.losses import LossConfig, self_supervised_loss
from lightdepth.metrics import inconsistency
from lightdepth.models import NetworkModel
from lightdepth.module import LightDepth
from lightdepth.network import NetworkConfig
from lightdepth.tube import lens
from train.callbacks import Speed, validation_line
from train.commands.train import train

CONFIGS = sorted((Path(__file__).parents[1] / "configs" / "train").glob("*.yaml"))


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
    with refused(cure="--resume"):
        train(["-o", str(finished_run), *TINY_RUN])
    with refused(found="contradict"):
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


def test_damaged_checkpoints_are_not_resumed_and_the_run_stays_as_it_was(finished_run, tmp_path):
    run = tmp_path / "damaged"
    shutil.copytree(finished_run, run)
    for checkpoint in (run / "checkpoints").iterdir():
        checkpoint.write_bytes(b"damaged")
    with refused(where="last.ckpt"):
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
    with pytest.raises(Interrupted), Halt(at=10):
        train(arguments)
    assert steps_in(run) == 10 and not (run / "run.json").exists()
    with refused(found="unfinished"):
        train(arguments)
    assert train([*arguments, "--resume"]) == 0
    weights = [
        torch.load(r / "checkpoints" / "last.ckpt", weights_only=True)["state_dict"] for r in (run, finished_run)
    ]
    assert equal(*weights)


def test_training_on_a_folder_without_truth_reports_the_loss_alone(tmp_path):
    sequence = write_sequence(tmp_path / "seq")
    run = tmp_path / "run"
    options = ["--data.sequences", f"[{sequence}]", "--data.size", "[40, 32]", "--model.network.width", "4"]
    assert train(["-o", str(run), *options, "--trainer.max_steps", "3", "--trainer.accelerator", "cpu"]) == 0
    errors = json.loads((run / "run.json").read_text())["errors"]
    assert "loss" in errors and "abs_rel_median" not in errors
    assert next(iter(json.loads((run / "run.json").read_text())["inputs"])).startswith("sequences-")


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
    assert record["split"].startswith("split-") and record["frames"] == {"train": 4, "val": 4}
    assert [name.startswith("sequences-") for name in record["inputs"]] == [True, True]
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


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ("val_check_interval 0.5", "expected a whole number of batches, or --trainer.check-val-every-n-epoch 1"),
        ("val_check_interval 0", "expected a number above 0"),
        ("val_check_interval 1.5 check_val_every_n_epoch 1", "a share of an epoch, above 0 and up to 1.0"),
        ("check_val_every_n_epoch 0", "expected a number of at least 1"),
        ("max_steps 0", "a number above 0, or -1 for no limit"),
        ("max_epochs -2", "expected a number of at least -1"),
        ("limit_val_batches 0", "expected a number above 0"),
        ("limit_train_batches 1.5", "a share above 0 and up to 1.0, or a number of batches"),
        ("accumulate_grad_batches 0", "expected a number of at least 1"),
        ("accelerator cpu devices 9999", "at most, the cores of this machine"),
        ("accelerator cpu limit_train_batches 0.01", "Lightning says: You requested to check 0.01"),
    ],
)
def test_a_setting_that_cannot_train_is_refused_by_name(tmp_path, options, said):
    words = options.split()
    given = [word for name, value in zip(words[::2], words[1::2], strict=True) for word in (f"--trainer.{name}", value)]
    with refused(said, where="--trainer"):
        train(["-o", str(tmp_path / "run"), *TINY_RUN, "--trainer.max_steps", "2", *given])
    assert not (tmp_path / "run" / "run.json").exists()


def test_settings_of_lightning_s_that_do_nothing_are_no_options_and_old_files_that_have_them_are_read(tmp_path, capsys):
    gone = {"limit_test_batches": 3, "model_registry": None, "barebones": False, "enable_checkpointing": True}
    with pytest.raises(SystemExit):
        train(["--help-all"])
    shown = capsys.readouterr().out
    assert not any(f"--trainer.{name.replace('_', '-')}" in shown for name in gone)
    (tmp_path / "old.yaml").write_text(json.dumps({"trainer": {**gone, "max_steps": 77}}))
    with warned("no longer exist", "limit_test_batches") as said, pytest.raises(SystemExit) as stopped:
        train(["--config", str(tmp_path / "old.yaml"), "--print_config"])
    assert stopped.value.code == 0 and len(said) == 1
    assert "max_steps: 77" in capsys.readouterr().out


def test_the_validation_line_names_network_and_closed_form():
    metrics = {f"val/{p}{n}_median": 0.5 for p in ("", "closed_form/") for n in ("abs_rel", "rmse_mm", "medae_mm")}
    assert "closed form AbsRel 0.5" in validation_line({**metrics, "val/loss": 1.0})
    assert validation_line({"val/loss": 1.0}) == "validation loss 1"


def quick(tmp_path: Path, *options: str, name: str = "run", sequence: Path | None = None, steps: int = 12) -> Path:
    """A run of a few steps on a dozen frames of a cylinder."""
    folder = sequence or tmp_path / "seq"
    if not folder.exists():
        write_sequence(folder)
    basic = ["--data.sequences", f"[{folder}]", "--data.size", "[40, 32]", "--model.network.width", "4"]
    basic += ["--trainer.accelerator", "cpu", "--trainer.max_steps", str(steps), "--trainer.val_check_interval", "6"]
    assert train(["-o", str(tmp_path / name), *basic, *options]) == 0
    return tmp_path / name


def state(run: Path, key: str = "state_dict") -> dict[str, torch.Tensor]:
    return torch.load(run / "checkpoints" / "last.ckpt", weights_only=True)[key]


def equal(first: dict[str, torch.Tensor], second: dict[str, torch.Tensor]) -> bool:
    return first.keys() == second.keys() and all(torch.equal(first[name], second[name]) for name in first)


def test_two_runs_of_one_seed_are_equal_to_the_bit_and_of_two_seeds_are_not(tmp_path):
    first, second = (quick(tmp_path, name=name) for name in ("a", "b"))
    assert equal(state(first), state(second))
    assert not equal(state(first), state(quick(tmp_path, "--seed", "1", name="c")))


@pytest.mark.parametrize("schedule", ["one_cycle", "cosine"])
def test_averaged_weights_are_what_is_exported_and_a_resumed_average_is_the_uninterrupted_one(tmp_path, schedule):
    options = ["--fit.ema", "0.8", "--model.schedule", schedule, "--fit.monitor", "last"]
    whole = quick(tmp_path, *options, name="whole", steps=10)
    averaged, current = state(whole), state(whole, "current_model_state")
    assert steps_in(whole) == 10 and not equal(averaged, current)
    exported = load_model(whole / "model.safetensors").network.state_dict()
    for name, value in exported.items():
        assert torch.equal(value, averaged[f"network.{name}"].half().float()), name

    run = tmp_path / "halted"
    with pytest.raises(Interrupted), Halt(at=6):
        quick(tmp_path, *options, name="halted", steps=10)
    assert steps_in(run) == 6
    quick(tmp_path, *options, "--resume", name="halted", steps=10)
    assert equal(state(run), averaged) and equal(state(run, "current_model_state"), current)


class Interrupted(RuntimeError):
    pass


class Halt(Callback):
    """Within `with`, runs end with Interrupted after step `at`."""

    def __init__(self, at: int) -> None:
        self.at = at

    def on_train_batch_start(self, trainer, module, batch, batch_idx):
        if trainer.global_step == self.at:
            raise Interrupted

    def __enter__(self):
        self.original = fit_module._with_callbacks
        fit_module._with_callbacks = with_callback(self)

    def __exit__(self, *raised):
        fit_module._with_callbacks = self.original


@pytest.mark.parametrize(("schedule", "last"), [("constant", 2e-3), ("cosine", 0.0)])
def test_the_learning_rate_follows_its_schedule(tmp_path, schedule, last):
    run = quick(tmp_path, "--model.schedule", schedule, steps=6)
    saved = torch.load(run / "checkpoints" / "last.ckpt", weights_only=True)
    assert saved["optimizer_states"][0]["param_groups"][0]["lr"] == pytest.approx(last, abs=2e-4)
    with refused(cure="one_cycle"):
        LightDepth(schedule="step")


def test_half_precision_trains_without_a_single_bad_number_and_pure_half_precision_is_refused(tmp_path):
    run = quick(tmp_path, "--trainer.precision", "bf16-mixed")
    errors = json.loads((run / "run.json").read_text())["errors"]
    assert all(np.isfinite(value) for value in errors.values())
    assert all(torch.isfinite(value).all() for value in state(run).values())
    whole = json.loads((quick(tmp_path, name="whole") / "run.json").read_text())["errors"]
    assert errors["loss"] == pytest.approx(whole["loss"], rel=0.2)
    with refused(cure="bf16-mixed"):
        quick(tmp_path, "--trainer.precision", "bf16-true", name="pure")


def test_gradients_are_clipped_unless_told_otherwise(capsys):
    with pytest.raises(SystemExit):
        train(["--print_config"])
    assert "gradient_clip_val: 1.0" in capsys.readouterr().out


def test_a_run_that_no_longer_gets_better_ends_early(tmp_path):
    options = ["--fit.patience", "1", "--model.learning_rate", "1e-9", "--trainer.val_check_interval", "2"]
    run = quick(tmp_path, *options, steps=40)
    assert steps_in(run) < 40
    with refused(found="criterion"):
        quick(tmp_path, "--fit.patience", "1", "--fit.monitor", "last", name="no")


def test_speed_is_told_beside_that_without_waiting_for_frames(tmp_path, monkeypatch):
    run = quick(tmp_path)
    said = r"[\d.]+ frames/s \([\d.]+ without waiting for them\)"
    assert re.search(said, (run / "log.txt").read_text()) and re.search(said, (run / "report.html").read_text())
    found = json.loads((run / "run.json").read_text())["timings"]
    assert 0 < found["frames_per_s"] <= found["without_waiting"] and 0 <= found["waiting_share"] < 1
    monkeypatch.setattr(Speed, "waiting", 0.25)
    run = quick(tmp_path, name="slow")
    assert "25% of the training was spent waiting for frames: --data.num-workers" in (run / "log.txt").read_text()


def test_kept_frames_are_the_runs_own_affair_and_a_dry_run_keeps_none(tmp_path):
    kept = tmp_path / "kept"
    kept.mkdir()
    with pytest.raises(Planned):
        quick(tmp_path, "--data.cache", str(kept), "--dry_run")
    assert not any(kept.iterdir())
    plain = quick(tmp_path, name="plain")
    runs = [quick(tmp_path, "--data.cache", str(kept), name=name) for name in ("cold", "warm")]
    assert equal(state(plain), state(runs[0])) and equal(state(plain), state(runs[1]))
    assert len([file for file in kept.rglob("*.safetensors") if file.stem.isdecimal()]) == 12
    for run in runs:
        assert "cache: cache-00000000" in (run / "config.yaml").read_text()  # known by name, and not read for it
        assert str(kept) not in (run / "run.json").read_text() + (run / "log.txt").read_text()


def write_images(folder: Path, image: np.ndarray, count: int = 12) -> Path:
    """A sequence whose frames are all this image (32, 40, 3)."""
    write_sequence(folder, count)
    for i in range(count):
        cv2.imwrite(str(folder / "frames" / f"{i:04d}.png"), image)
    return folder


@pytest.mark.parametrize(("value", "said"), [(0, "100% black"), (255, "100% of the pixels are saturated")])
def test_frames_without_a_usable_pixel_end_the_run_with_their_names(tmp_path, value, said):
    sequence = write_images(tmp_path / "seq", np.full((32, 40, 3), value, np.uint8))
    if not value:  # where all are black, the sequence is refused before
        cv2.imwrite(str(sequence / "frames" / "0011.png"), np.full((32, 40, 3), 100, np.uint8))
    with pytest.raises(InputError) as stopped:
        quick(tmp_path, "--fit.diagnosis.blind", "3", sequence=sequence)
    assert said in str(stopped.value) and f"{sequence}: 00" in str(stopped.value)


def test_one_black_frame_among_others_does_no_harm(tmp_path):
    sequence = write_sequence(tmp_path / "seq")
    cv2.imwrite(str(sequence / "frames" / "0003.png"), np.zeros((32, 40, 3), np.uint8))
    cv2.imwrite(str(sequence / "frames" / "0004.png"), np.full((32, 40, 3), 255, np.uint8))
    run = quick(tmp_path, sequence=sequence)
    assert all(torch.isfinite(value).all() for value in state(run).values())


def test_a_frame_that_cannot_be_read_is_left_out_and_said_whichever_process_reads_it(tmp_path):
    sequence = write_sequence(tmp_path / "seq", 12)
    for torn in ("0003.png", "0011.png"):  # the second validates, with one that is whole
        (sequence / "frames" / torn).write_bytes((sequence / "frames" / torn).read_bytes()[:100])
    runs, said = [], []
    for workers in ("0", "2"):
        (tmp_path / workers).mkdir()
        runs.append(
            quick(tmp_path / workers, "--data.num_workers", workers, "--data.held_out", "0.2", sequence=sequence)
        )
        record, log = (json.loads((runs[-1] / "run.json").read_text()), (runs[-1] / "log.txt").read_text())
        assert record["frames"] == {"train": 10, "val": 2} and record["unread"] == {"train": 1, "val": 1}
        said.append(sorted(record["warnings"]))
        assert all(log.count(f"warning: {sentence}") == 1 for sentence in said[-1])
    assert said[0] == said[1] and len(said[0]) == 2
    assert re.match("left out of training, with the next frame in its place: .*0003.png: not a readable", said[0][0])
    assert re.match("left out of validation: .*0011.png: not a readable image", said[0][1])
    assert equal(*map(state, runs))


def test_frames_of_which_none_can_be_read_end_the_run_whichever_process_reads_them(tmp_path):
    sequence = write_sequence(tmp_path / "seq", 12)
    (sequence / "frames" / "0011.png").write_bytes(b"torn")
    for workers in ("0", "2"):
        with pytest.raises(InputError, match=r"0011\.png: not a readable image"):
            quick(tmp_path / workers, "--data.num_workers", workers, sequence=sequence)


class Poison(Callback):
    """Makes the gradients of these steps NaN."""

    def __init__(self, steps) -> None:
        self.steps = steps

    def on_after_backward(self, trainer, module):
        if trainer.global_step in self.steps or trainer.fit_loop.total_batch_idx in self.steps:
            next(p for p in module.parameters() if p.grad is not None).grad.fill_(torch.nan)


def with_callback(callback):
    original = fit_module._with_callbacks
    return lambda given, *rest: original({**given, "callbacks": [callback]}, *rest)


def test_a_step_with_a_bad_gradient_is_left_out_and_training_goes_on(tmp_path, monkeypatch):
    monkeypatch.setattr(fit_module, "_with_callbacks", with_callback(Poison({3, 4})))
    run = quick(tmp_path)
    assert all(torch.isfinite(value).all() for value in state(run).values())


def test_gradients_that_stay_bad_end_the_run_with_a_diagnosis_and_its_checkpoint(tmp_path, monkeypatch):
    monkeypatch.setattr(fit_module, "_with_callbacks", with_callback(Poison(range(4, 1000))))
    with pytest.raises(PartialFailure) as stopped:
        quick(tmp_path, "--fit.diagnosis.patience", "3")
    assert "gradient of network.body" in str(stopped.value) and "seq: 00" in str(stopped.value)
    assert all(torch.isfinite(value).all() for value in state(tmp_path / "run").values())
    assert not (tmp_path / "run" / "run.json").exists()


def test_a_distance_that_collapses_is_called_so(tmp_path):
    with pytest.raises(PartialFailure, match=r"constant for 4 batches"):
        options = ["--fit.diagnosis.constant", "4", "--model.network.output", "free", "--model.learning_rate", "1e-12"]
        quick(tmp_path, *options)


def test_an_albedo_cannot_eat_the_shading():
    """With value 1 no albedo, however dark its other channels, stands in for the shading that distance explains."""
    batch = batch_of(1)
    config = LossConfig(reflectance=0.0, gain="one", space="encoded", chroma=0.0)
    flat = torch.full_like(batch.true_distance, float(batch.true_distance.median())) / 10
    dark, bright = (torch.full((1, 2, 32, 40), v) for v in (0.95, 0.05))
    for albedo in (dark, bright):
        shaded = self_supervised_loss(batch.true_distance / 10, albedo * 0, batch, config)[1]["photometric"]
        assert self_supervised_loss(flat, albedo, batch, config)[1]["photometric"] > 2 * shaded


def test_an_uncertainty_head_is_trained_calibrated_and_saved_and_the_distance_stays_as_it_started(tmp_path):
    options = [*TINY_RUN, "--trainer.max_steps", "6", "--model.network.uncertainty", "true"]
    options += ["--model.loss.uncertainty", "1", "--model.freeze_distance", "true"]
    run = tmp_path / "run"
    assert train(["-o", str(run), *options]) == 0
    card = read_card(run / "model.safetensors")
    assert card["uncertainty"]["frames"] == 4 and set(card["uncertainty"]["coverage"]) == {"50%", "68%", "90%", "95%"}
    assert "uncertainty head alone" in card["trained_on"] and (run / "uncertainty.png").is_file()
    assert "sparsification" in (run / "model.md").read_text()
    seed_everything(0, verbose=False)
    fresh = LightDepth(NetworkConfig(width=4, uncertainty=True), LossConfig(uncertainty=1.0)).network.state_dict()
    model = load_model(run / "model.safetensors")
    assert isinstance(model, NetworkModel)
    learned = {n: v for n, v in model.network.state_dict().items()}
    assert all(torch.equal(learned[n], fresh[n].half().float()) for n in fresh if n.startswith("body."))
    assert any(
        not torch.equal(learned[n], fresh[n].half().float()) for n in fresh if n.startswith("uncertainty.layers")
    )
    assert learned["uncertainty.calibration"].tolist() == pytest.approx(
        [card["uncertainty"]["exponent"], np.log(card["uncertainty"]["scale"])], abs=2e-2
    )
    frame = cylinder(CAMERA).frame(light=LIGHT)
    prediction = model(frame)
    assert prediction.uncertainty.shape == prediction.distance.shape and (prediction.uncertainty > 0).all()
    with refused(cure="network.uncertainty"):
        LightDepth(NetworkConfig(), LossConfig(uncertainty=1.0))


def test_a_run_starts_from_a_checkpoint_that_fits(tmp_path):
    start = quick(tmp_path, name="first") / "model.safetensors"
    module = LightDepth(NetworkConfig(width=4, uncertainty=True), start=str(start))
    given = load_model(start).network.state_dict()
    assert all(torch.equal(module.network.state_dict()[n], v) for n, v in given.items())
    for config, checkpoint, said in (
        (NetworkConfig(width=8), str(start), "fit"),
        (NetworkConfig(), "decline", "no weights"),
    ):
        with refused(said):
            LightDepth(config, start=checkpoint)


def frames_for(path: Path, folder: Path) -> list[str]:
    """What the configuration needs to be tried: colons it makes itself, or a small tree of its data set."""
    if "tube:" in path.read_text():
        return [f"--data.tube.{name}={count}" for name, count in (("scenes", 1), ("val_scenes", 1), ("frames", 4))]
    lens_of = {"endomapper.yaml": "fisheye"}.get(path.name, "c3vd")
    frames = colon(0, 6, 10.0, lens(lens_of, 100, 80)).frames
    if path.name == "c3vd.yaml":
        write_c3vd(frames, folder)
    elif path.name == "endomapper.yaml":
        write_endomapper([replace(frame, name=f"out{n}") for n, frame in enumerate(frames, 1)], folder)
    else:
        write_folder(frames, folder)
    return ["--data.sequences", f"[{folder}]"]


@pytest.mark.parametrize("path", CONFIGS, ids=lambda p: p.name)
def test_every_shipped_configuration_takes_two_steps_and_its_model_predicts(path, tmp_path):
    small = ["--data.size", "[40, 32]", "--data.batch_size", "2", "--data.num_workers", "0"]
    small += ["--trainer.max_steps", "2", "--trainer.accelerator", "cpu"]
    if path.stem == "large":
        small += ["--model.pretrained", "null"]  # an extra, which need not be there
    run = tmp_path / "run"
    assert train(["--config", str(path), "-o", str(run), *frames_for(path, tmp_path / "data"), *small]) == 0
    prediction = load_model(run / "model.safetensors")(cylinder(CAMERA).frame(light=LIGHT))
    assert np.isfinite(prediction.distance).all() and prediction.distance.std() >= 0


def test_the_mirrored_and_darker_batch_changes_nothing_for_the_closed_form_and_something_for_a_guess():
    batch = batch_of()

    def closed_form(b):
        return log_closed_form(b.image, b.mask, b.rays, b.light).exp(), None

    def guess(b):
        return closed_form(b)[0] * torch.exp(b.image[:, :1] - b.rays[:, :1] * torch.linspace(0, 1, 40)), None

    assert inconsistency(closed_form, batch, closed_form(batch)[0]) < 1e-3
    assert inconsistency(guess, batch, guess(batch)[0]) > 0.02


@pytest.mark.slow
def test_two_processes_train_together_although_only_one_of_them_sees_truth(tmp_path):
    """The validation frames are one without truth and one with: one for each process."""
    blind, seeing = write_sequence(tmp_path / "blind", 1), tmp_path / "seeing"
    write_folder(colon(0, 1, 10.0, CAMERA).frames, seeing)
    options = ["--data.val_sequences", f"[{blind}, {seeing}]", "--data.batch_size", "1", "--trainer.devices", "2"]
    options += ["--trainer.strategy", "ddp_fork", "--fit.ema", "0.5", "--model.network.uncertainty", "true"]
    run = quick(tmp_path, *options, "--model.loss.uncertainty", "1", sequence=write_sequence(tmp_path / "seq"))
    record = json.loads((run / "run.json").read_text())
    assert record["steps"] == 12 and "abs_rel_median" in record["errors"]
    assert (run / "log.txt").read_text().count("step 12/12") == 1
