"""What Lightning does of its own accord on a cluster."""

from __future__ import annotations

import ast
from pathlib import Path

import lightning.pytorch as pl
import pytest
import torch
from raising import refused

from lightdepth.errors import MachineFailure
from train.fit import _refusals_named
from train.folder import first_process
from train.running import NO_ROOT, trainer_of_one
from train.together import ending_together
from train.watching import with_callbacks

ROOT = Path(__file__).resolve().parents[1]


def test_no_checkpoint_that_lies_about_is_taken_on_a_cluster(tmp_path, monkeypatch):
    (tmp_path / "hpc_ckpt_1.ckpt").write_text("of a stranger")
    monkeypatch.chdir(tmp_path)
    cluster = {"JOB_ID": "7", "NTASKS": "1", "JOB_NAME": "batch", "PROCID": "0", "LOCALID": "0", "NODEID": "0"}
    for name, value in cluster.items():
        monkeypatch.setenv(f"SLURM_{name}", value)
    for given, taken in (({}, True), ({"default_root_dir": NO_ROOT}, False)):
        trainer = pl.Trainer(devices=1, accelerator="cpu", logger=False, enable_checkpointing=False, **given)
        assert bool(trainer._checkpoint_connector._hpc_resume_path) == taken


def test_a_job_that_lightning_cannot_run_in_is_told_as_a_mistake():
    with refused("--ntasks-per-node"), _refusals_named(RuntimeError):
        raise RuntimeError("You set `--ntasks=4`. HINT: Use `--ntasks-per-node=4` instead.")


def test_processes_that_do_not_meet_are_a_failure_of_the_machine_s():
    with (
        pytest.raises(MachineFailure, match=r"do not meet \(port taken\): .*MASTER_PORT"),
        ending_together(trainer_of_one()),
    ):
        raise torch.distributed.DistNetworkError("port taken\nand where")


@pytest.mark.parametrize(("said", "first"), [({}, True), ({"NODE_RANK": "1"}, False), ({"NODE_RANK": "0"}, True)])
def test_of_several_machines_the_first_one_s_process_writes(monkeypatch, said, first):
    for name in ("RANK", "NODE_RANK", "GROUP_RANK"):
        monkeypatch.delenv(name, raising=False)
    for name, value in said.items():
        monkeypatch.setenv(name, value)
    assert first_process() == first


def test_adapting_is_of_one_process_whatever_the_job_has(monkeypatch):
    for name, value in {"JOB_ID": "7", "NTASKS": "4", "JOB_NAME": "batch"}.items():
        monkeypatch.setenv(f"SLURM_{name}", value)
    assert trainer_of_one(1).world_size == 1


def test_every_trainer_has_no_folder_of_its_own():
    called = [
        node
        for path in (ROOT / "train").rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Call) and ast.unparse(node.func) in ("pl.Trainer", "Trainer")
    ]
    given = [{word.arg: ast.unparse(word.value) for word in call.keywords} for call in called]
    assert len(given) >= 2 and all(words.get("default_root_dir") == "NO_ROOT" or None in words for words in given)
    assert "NO_ROOT" in with_callbacks.__code__.co_names  # of the one whose options are put together elsewhere
