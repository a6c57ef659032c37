"""A training that is stopped, however often and wherever, ends as one that nothing stopped."""

import itertools
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from lightning.pytorch import Callback
from raising import refused
from safetensors.torch import load_file
from training import write_sequence

import train.fit as fit_module
from lightdepth.checkpoint import read_card
from lightdepth.errors import Interrupted
from lightdepth.signals import ending_on_signals
from train.checkpoints import WholeCheckpoints, clear_cut_off, newest
from train.commands.train import train
from train.requeue import requeued


class Signal(Callback):
    """Sends this process a signal in the middle of given steps."""

    def __init__(self, steps):
        self.steps = set(steps)

    def on_before_backward(self, trainer, module, loss):
        if trainer.global_step in self.steps:
            self.steps.discard(trainer.global_step)
            signal.raise_signal(signal.SIGTERM)


class Early(Callback):
    def on_train_start(self, trainer, module):
        signal.raise_signal(signal.SIGTERM)


@pytest.fixture(scope="module")
def sequence(tmp_path_factory) -> Path:
    return write_sequence(tmp_path_factory.mktemp("data") / "seq", 9)


@pytest.fixture
def one_thread():
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


def options(sequence, *more):
    basic = ["--data.sequences", f"[{sequence}]", "--data.size", "[24, 16]", "--model.network.width", "2"]
    basic += ["--trainer.accelerator", "cpu", "--trainer.logger", "none", "--data.batch-size", "2"]
    return [*basic, *more]


def run(folder, given, callbacks=(), resume=False):
    """A training in this process with more callbacks."""
    original = fit_module._with_callbacks
    fit_module._with_callbacks = lambda asked, *rest: original({**asked, "callbacks": list(callbacks)}, *rest)
    try:
        with ending_on_signals():
            return train(["-o", str(folder), *given, *(["--resume"] if resume else [])])
    finally:
        fit_module._with_callbacks = original


def halted(folder, given, halts):
    """The run, stopped by a signal in each of these steps and resumed."""
    for number, step in enumerate([*halts, None]):
        if step is None:
            assert run(folder, given, resume=number > 0) == 0
            return folder
        with pytest.raises(Interrupted) as stopped:
            run(folder, given, [Signal([step])], resume=number > 0)
        assert stopped.value.signal == signal.SIGTERM and not (folder / "run.json").exists()
    return folder


def difference(first, second):
    """What differs between the weights, optimisers, schedules and counters of two runs."""
    found = []
    for name in ("last", "last-previous", "best"):
        if not (second / "checkpoints" / f"{name}.ckpt").exists():
            assert not (first / "checkpoints" / f"{name}.ckpt").exists()
            continue
        one, other = (torch.load(each / "checkpoints" / f"{name}.ckpt", weights_only=True) for each in (first, second))
        for key in ("state_dict", "optimizer_states", "lr_schedulers", "global_step", "loops", "callbacks"):
            if not same(one[key], other[key]):
                found.append(f"{name}: {key}")
    if not same(*(load_file(each / "model.safetensors") for each in (first, second))):
        found.append("model.safetensors")
    if not same(*(read_card(each / "model.safetensors") for each in (first, second))):
        found.append("its card")
    records = [json.loads((each / "run.json").read_text()) for each in (first, second)]
    if records[0]["errors"] != records[1]["errors"]:
        found.append("errors")
    return found


def same(one, other):
    if isinstance(one, torch.Tensor):
        return torch.equal(one, other)
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(one[key], other[key]) for key in one)
    if isinstance(one, list | tuple):
        return len(one) == len(other) and all(itertools.starmap(same, zip(one, other, strict=True)))
    return one == other or one != one


def test_a_run_stopped_twice_within_epochs_is_the_uninterrupted_one_to_the_bit(sequence, tmp_path, one_thread):
    """Eight frames in batches of two: an epoch has four steps, and validations come in between.

    The last stop is beside no validation."""
    given = options(sequence, "--trainer.max-steps", "8", "--trainer.val-check-interval", "3")
    given += ["--fit.ema", "0.5", "--fit.patience", "3"]
    whole = halted(tmp_path / "whole", given, [])
    assert difference(halted(tmp_path / "halted", given, [2, 6]), whole) == []


@pytest.mark.slow
@pytest.mark.parametrize("workers", [0, 1, 2])
def test_any_halts_in_any_steps_of_an_epoch_change_nothing(sequence, tmp_path, one_thread, workers):
    """Drawn by a seed that is printed, or given as LIGHTDEPTH_SEED."""
    seed = int(os.environ.get("LIGHTDEPTH_SEED", time.time_ns() % 10**6))
    print(f"LIGHTDEPTH_SEED={seed}")
    rng = np.random.default_rng([seed, workers])
    for number in range(int(os.environ.get("LIGHTDEPTH_HALTS", "8"))):
        steps, batch = int(rng.integers(2, 9)), int(rng.integers(1, 5))
        given = options(sequence, "--trainer.max-steps", str(steps), "--data.num-workers", str(workers))
        given += ["--data.batch-size", str(batch), "--trainer.val-check-interval", str(rng.integers(1, steps + 1))]
        given += ["--fit.ema", str(rng.choice([0, 0.5])), "--fit.patience", str(rng.choice([0, 1]))]
        given += ["--model.schedule", str(rng.choice(["one_cycle", "cosine", "constant"]))]
        given += ["--trainer.accumulate-grad-batches", str(rng.choice([1, 1, 2]))]
        given += ["--model.network.norm", "group"]
        halts = sorted(rng.choice(steps, int(rng.integers(1, 3)), replace=False).tolist())
        whole = halted(tmp_path / f"whole{number}", given, [])
        last = torch.load(whole / "checkpoints" / "last.ckpt", weights_only=True)["global_step"]
        run_ = halted(tmp_path / f"halted{number}", given, [h for h in halts if h < last])
        assert difference(run_, whole) == [], (halts, given)


def test_a_finished_run_that_is_made_longer_is_the_longer_one_where_the_schedule_does_not_depend_on_it(
    sequence, tmp_path, one_thread, capfd
):
    given = options(sequence, "--model.schedule", "constant", "--trainer.val-check-interval", "4")
    folder = halted(tmp_path / "longer", [*given, "--trainer.max-steps", "3"], [])
    capfd.readouterr()
    assert run(folder, [*given, "--trainer.max-steps", "6"], resume=True) == 0
    assert "warning" not in capfd.readouterr().err
    assert difference(folder, halted(tmp_path / "once", [*given, "--trainer.max-steps", "6"], [])) == []
    capfd.readouterr()
    assert run(folder, [*given, "--trainer.max-steps", "7", "--model.schedule", "cosine"], resume=True) == 0
    said = capfd.readouterr().err
    assert "steps at once" in said
    assert "--model.schedule was constant and is cosine" in said and "--trainer.max-steps was" not in said


def test_the_newest_checkpoint_that_reads_is_resumed_and_named(sequence, tmp_path):
    given = options(sequence, "--trainer.max-steps", "6", "--trainer.val-check-interval", "2")
    folder = halted(tmp_path / "run", given, [5])
    checkpoints = folder / "checkpoints"
    before = torch.load(checkpoints / "last-previous.ckpt", weights_only=True)["global_step"]
    assert 2 <= before < 6 and newest(checkpoints).path.name == "last.ckpt"
    (checkpoints / "last.ckpt").write_bytes(b"")
    best = newest(checkpoints)
    assert best.path.name == "best.ckpt" and best.step == 6 > before  # which is later here
    (checkpoints / "best.ckpt").unlink()
    start = newest(checkpoints)
    assert start.path.name == "last-previous.ckpt" and start.step == before and "last.ckpt" in start.said
    (checkpoints / "last-previous.ckpt").write_bytes(b"")
    with refused(where="last.ckpt"):
        newest(checkpoints)


def test_a_checkpoint_that_cannot_be_written_leaves_the_one_that_was_there(tmp_path):
    path = tmp_path / "last.ckpt"
    writer = WholeCheckpoints()
    writer.save_checkpoint({"step": 1}, path)
    with pytest.raises(AttributeError):
        writer.save_checkpoint({"step": lambda: 2}, path)
    assert torch.load(path, weights_only=True) == {"step": 1}
    assert {p.name for p in tmp_path.iterdir()} <= {"last.ckpt", "last-previous.ckpt"}


def test_what_a_kill_left_beside_checkpoints_goes(tmp_path, monkeypatch):
    writer, last, real = WholeCheckpoints(), tmp_path / "last.ckpt", os.replace
    writer.save_checkpoint({"step": 1}, last)

    def killed_at_the_last(made, path):
        if path == last:
            raise KeyboardInterrupt
        real(made, path)

    with monkeypatch.context() as patched, pytest.raises(KeyboardInterrupt):
        patched.setattr(os, "replace", killed_at_the_last)
        writer.save_checkpoint({"step": 2}, last)
    writer.save_checkpoint({"step": 3}, last)  # last and last-previous are one file until now
    assert {p.name for p in tmp_path.iterdir()} == {"last.ckpt", "last-previous.ckpt"}
    os.link(last, tmp_path / ".last-previous.ckpt")
    clear_cut_off(tmp_path)
    assert {p.name for p in tmp_path.iterdir()} == {"last.ckpt", "last-previous.ckpt"}


def test_overwriting_leaves_the_old_result_whole_until_the_new_one_is(sequence, tmp_path):
    given = options(sequence, "--trainer.max-steps", "2", "--trainer.val-check-interval", "1")
    folder = halted(tmp_path / "run", given, [])
    old = {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    for step in (None, 1):  # before the first checkpoint, and behind it
        with pytest.raises(Interrupted):
            run(folder, [*given, "--seed", "1", "--overwrite"], [Signal([step]) if step else Early()])
        assert {p.relative_to(folder): p.read_bytes() for p in folder.rglob("*") if p.is_file()} == old
    assert (tmp_path / ".run.unfinished" / "checkpoints" / "last.ckpt").exists()
    with refused(found="unfinished"):
        train(["-o", str(folder), *given])
    assert run(folder, [*given, "--seed", "1"], resume=True) == 0
    assert json.loads((folder / "run.json").read_text())["seed"] == 1
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_a_stranger_s_checkpoints_are_not_overwritten(sequence, tmp_path):
    (tmp_path / "run" / "checkpoints").mkdir(parents=True)
    (tmp_path / "run" / "checkpoints" / "epoch9.ckpt").write_bytes(b"days of work")
    for flags in ([], ["--overwrite"]):
        with refused(where="run"):
            train(["-o", str(tmp_path / "run"), *options(sequence), *flags])
    finished = halted(tmp_path / "mine", options(sequence, "--trainer.max-steps", "1"), [])
    shutil.copy(tmp_path / "run" / "checkpoints" / "epoch9.ckpt", finished / "checkpoints")
    with refused(found="epoch9.ckpt"):
        train(["-o", str(finished), *options(sequence), "--overwrite"])


@pytest.mark.parametrize("code", [0, 1])
def test_slurm_is_asked_for_another_start_and_what_came_of_it_is_said(tmp_path, monkeypatch, code):
    scontrol = tmp_path / "scontrol"
    scontrol.write_text(f'#!/bin/sh\necho "$@" > {tmp_path}/asked\necho no >&2\nexit {code}\n')
    scontrol.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    monkeypatch.delenv("SLURM_JOB_ID", raising=False)
    assert requeued(signal.SIGUSR1) == ""
    monkeypatch.setenv("SLURM_JOB_ID", "17")
    assert requeued(signal.SIGTERM) == "" and not (tmp_path / "asked").exists()
    assert ("failed (no)" in requeued(signal.SIGUSR1)) == bool(code)
    assert (tmp_path / "asked").read_text() == "requeue 17\n"


def test_a_job_that_slurm_warns_saves_itself_asks_for_another_start_and_goes_on_by_the_same_command(sequence, tmp_path):
    scontrol = tmp_path / "scontrol"
    scontrol.write_text(f'#!/bin/sh\necho "$@" > {tmp_path}/asked\n')
    scontrol.chmod(0o755)
    given = options(sequence, "--trainer.max-steps", "100000", "--trainer.val-check-interval", "5")
    given += ["--data.num-workers", "1"]
    given[given.index("--trainer.logger") + 1] = "tensorboard"
    command = [sys.executable, "-m", "lightdepth", "train", "-o", str(tmp_path / "run"), *given, "--resume"]
    slurm = {"SLURM_JOB_ID": "17", "SLURM_NTASKS": "1", "SLURM_JOB_NAME": "train", "OMP_NUM_THREADS": "1"}
    environment = {**os.environ, **slurm, "PATH": f"{tmp_path}:{os.environ['PATH']}"}
    process = subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True, start_new_session=True)
    while not (tmp_path / "run" / "checkpoints" / "best.ckpt").exists():
        assert process.poll() is None, process.stderr.read()
        time.sleep(0.02)
    for number in (signal.SIGUSR1, signal.SIGTERM):  # as Slurm does, to all processes of the job
        os.killpg(process.pid, number)
    error = process.communicate(timeout=120)[1]
    assert process.returncode in (128 + signal.SIGUSR1, 128 + signal.SIGTERM), error
    said = next(line for line in reversed(error.splitlines()) if not line.startswith("next: "))
    assert said.startswith("lightdepth train: stopped by SIG") and "--resume goes on" in said
    start = newest(tmp_path / "run" / "checkpoints")
    assert start.step >= 5 and f"step {start.step} is kept" in said
    if process.returncode == 128 + signal.SIGUSR1:
        assert (tmp_path / "asked").read_text() == "requeue 17\n" and "in the queue again" in said
    given = [*given, "--trainer.max-steps", str(start.step + 1)]
    assert run(tmp_path / "run", given, resume=True) == 0
