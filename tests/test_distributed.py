"""Two processes that train together (gloo) are one whose batch is as large as both of theirs."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path

import lightning.pytorch as pl
import pytest
import torch
from training import TINY_RUN, write_sequence

from lightdepth.losses import LossConfig
from lightdepth.module import LightDepth
from lightdepth.network import NetworkConfig
from train.colons import TubeData
from train.datamodule import FrameData, FrameDataModule
from train.running import NO_ROOT

pytestmark = pytest.mark.slow


class Plain(LightDepth):
    """Trained by plain gradient descent: errors of the last bit are not blown up by a division."""

    def configure_optimizers(self) -> torch.optim.Optimizer:
        return torch.optim.SGD(self.parameters(), lr=1e-3)


@dataclass
class Kept(pl.Callback):
    """The names of the frames of each step by process, its loss over all processes, and the first step's gradient."""

    file: Path
    data: FrameDataModule
    names: list[list[str]] = field(default_factory=list)
    losses: list[float] = field(default_factory=list)
    gradient: torch.Tensor | None = None

    def on_before_optimizer_step(self, trainer: pl.Trainer, module: pl.LightningModule, optimizer: object) -> None:
        if self.gradient is None:
            self.gradient = torch.cat([p.grad.flatten() for p in module.parameters() if p.grad is not None])

    def on_train_batch_end(self, trainer, module, outputs, batch, batch_idx) -> None:
        mine = self.data.names(trainer.current_epoch, batch_idx)
        everyone = [mine]
        if trainer.world_size > 1:
            everyone = [[] for _ in range(trainer.world_size)]
            torch.distributed.all_gather_object(everyone, mine)
        self.names.append(sorted(name for own in everyone for name in own))
        self.losses.append(float(trainer.strategy.reduce(outputs["loss"].detach(), reduce_op="mean")))

    def on_train_end(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        if trainer.is_global_zero:
            torch.save({"names": self.names, "losses": self.losses, "gradient": self.gradient}, self.file)


def trained(folder: Path, sequence: Path, batch: int, halves: bool, processes: int) -> dict:
    torch.manual_seed(0)
    model = Plain(NetworkConfig(width=4), LossConfig(self_supervised=0.3, supervised=1.0))
    tube = TubeData(scenes=2, val_scenes=1, frames=5)
    data = FrameDataModule(
        FrameData([str(sequence)], tube=tube, size=(40, 32), batch_size=batch, halves=halves, seed=2)
    )
    trainer = pl.Trainer(
        accelerator="cpu",
        devices=processes,
        strategy="ddp_fork" if processes > 1 else "auto",
        max_steps=20,
        limit_val_batches=0,
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        default_root_dir=NO_ROOT,
        callbacks=[Kept(folder / f"{processes}.pt", data)],
    )
    trainer.fit(model, datamodule=data)
    return torch.load(folder / f"{processes}.pt", weights_only=True)


@pytest.mark.parametrize("halves", [False, True])
def test_two_processes_make_the_steps_of_one_with_the_doubled_batch(tmp_path, halves):
    sequence = write_sequence(tmp_path / "seq")
    two, one = trained(tmp_path, sequence, 2, halves, 2), trained(tmp_path, sequence, 4, halves, 1)
    assert two["names"] == one["names"] and len(set(map(tuple, one["names"]))) > 10
    assert all(sum("colon" in name for name in step) == 2 for step in one["names"]) == halves
    assert two["losses"][0] == pytest.approx(one["losses"][0], rel=1e-6)
    torch.testing.assert_close(two["gradient"], one["gradient"], rtol=1e-6, atol=1e-6 * one["gradient"].abs().max())
    assert two["losses"] == pytest.approx(one["losses"], rel=1e-4) and one["losses"][-1] != one["losses"][0]


def test_two_machines_of_one_process_each_train_together(tmp_path):
    run = tmp_path / "run"
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        port = str(found.getsockname()[1])
    command = [sys.executable, "-m", "lightdepth", "train", *TINY_RUN, "--trainer.max_steps", "4", "-o", str(run)]
    command += ["--trainer.num_nodes", "2", "--trainer.devices", "1", "--trainer.strategy", "ddp"]
    place = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port, "LOCAL_RANK": "0"}
    with (tmp_path / "0.txt").open("w", encoding="utf-8") as first:
        waiting = subprocess.Popen(command, env=os.environ | place | {"NODE_RANK": "0"}, stderr=first)
        try:
            other = subprocess.run(
                command, env=os.environ | place | {"NODE_RANK": "1"}, capture_output=True, text=True, timeout=300
            )
            assert other.returncode == 0, other.stderr
            assert waiting.wait(60) == 0, (tmp_path / "0.txt").read_text(encoding="utf-8")
        finally:
            waiting.kill()  # where the other machine has failed, it waits for it
    assert json.loads((run / "run.json").read_text(encoding="utf-8"))["steps"] == 4
    assert "2 processes, batches of 4 in each." in (run / "model.md").read_text(encoding="utf-8")


def children_of(process: int) -> list[int]:
    return [int(word) for word in Path(f"/proc/{process}/task/{process}/children").read_text().split()]


@pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="needs Linux's /proc")
@pytest.mark.parametrize(
    ("number", "code", "said"),
    [(signal.SIGKILL, 5, "process 1 of the training (from 0) was ended by SIGKILL"), (signal.SIGTERM, 143, "SIGTERM")],
)
def test_where_one_of_two_processes_ends_both_end_in_order_and_can_be_resumed(tmp_path, number, code, said):
    run = tmp_path / "run"
    command = [sys.executable, "-m", "lightdepth", "train", *TINY_RUN, "-o", str(run)]
    command += ["--trainer.devices", "2", "--trainer.strategy", "ddp"]
    with (tmp_path / "said.txt").open("w", encoding="utf-8") as err:
        first = subprocess.Popen([*command, "--trainer.max_steps", "100000"], stderr=err)
        try:
            while not (run / "checkpoints" / "last.ckpt").exists() and first.poll() is None:
                time.sleep(0.2)
            (other,) = [k for k in children_of(first.pid) if b"train" in Path(f"/proc/{k}/cmdline").read_bytes()]
            os.kill(other, number)
            assert first.wait(120) == code, (tmp_path / "said.txt").read_text(encoding="utf-8")
        finally:
            first.kill()
    assert said in (tmp_path / "said.txt").read_text(encoding="utf-8")
    assert not Path(f"/proc/{other}").exists()
    steps = torch.load(run / "checkpoints" / "last.ckpt", weights_only=True)["global_step"]
    again = [*command, "--resume", "--trainer.max_steps", str(steps + 4)]
    assert subprocess.run(again, capture_output=True, timeout=300).returncode == 0
    assert json.loads((run / "run.json").read_text(encoding="utf-8"))["steps"] == steps + 4
