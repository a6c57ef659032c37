"""The folder of a training: what is left in it when the machine fails, and whose runs are gone on with."""

from __future__ import annotations

import json
import logging
import math
import os
import resource
import shutil
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import torch
from raising import refused
from training import TINY_RUN

from lightdepth.cli import main
from lightdepth.files.writing import PARTIAL, our_mark, write_whole
from lightdepth.reporting.unfinished import begin
from lightdepth.signals import Received
from train.checkpoints import Checkpoints
from train.commands.train import _with_own_config, train
from train.folder import check_output, training_folder
from train.running import flushes, while_training


@contextmanager
def files_up_to(size: int) -> Iterator[None]:
    """No file grows beyond so many bytes, as on a disk that is full."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def contents(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


@pytest.fixture(scope="module")
def finished_run(tmp_path_factory) -> Path:
    run = tmp_path_factory.mktemp("runs") / "first"
    assert train(["-o", str(run), *TINY_RUN, "--trainer.max_steps", "2"]) == 0
    return run


def test_a_library_that_only_says_that_it_failed_does_not_hide_a_full_disk(tmp_path):
    with files_up_to(1 << 16), pytest.raises(OSError, match="too large") as failed:
        write_whole(tmp_path / "a.ckpt", lambda path: torch.save({"weights": torch.zeros(1 << 16)}, path))
    assert failed.value.filename == str(tmp_path / "a.ckpt") and not list(tmp_path.iterdir())

    def mistaken(path: Path) -> None:
        raise RuntimeError("a mistake of ours")

    with pytest.raises(RuntimeError, match="a mistake of ours"):
        write_whole(tmp_path / "a.ckpt", mistaken)


def test_a_checkpoint_that_finds_no_room_ends_a_training_with_a_sentence_and_without_remains(tmp_path, capsys):
    given = ["train", "-o", str(tmp_path / "run"), *TINY_RUN, "--trainer.max_steps", "2"]
    with files_up_to(1 << 16):
        code = main(given)
    said = capsys.readouterr().err.splitlines()[-1]
    assert code == 5 and "Nothing of it is kept" in said and "MB are free" in said
    assert not list(tmp_path.iterdir())


def test_a_disk_that_is_full_costs_neither_the_old_result_nor_the_last_checkpoint(finished_run, tmp_path, capsys):
    run = tmp_path / "run"
    shutil.copytree(finished_run, run)
    before = contents(run)
    with files_up_to(1 << 16):
        assert main(["train", "-o", str(run), *TINY_RUN, "--trainer.max_steps", "2", "--overwrite"]) == 5
        assert contents(run) == before and os.listdir(tmp_path) == ["run"]
        assert main(["train", "-o", str(run), "--resume", "--trainer.max_steps", "4"]) == 5
    assert "--resume goes on" in capsys.readouterr().err.splitlines()[-2]
    assert train(["-o", str(run), "--resume", "--trainer.max_steps", "4"]) == 0


def test_what_a_killed_training_was_writing_does_not_keep_the_next_one_from_starting_anew(finished_run, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(finished_run, run)
    check_output(run, resume=False, overwrite=True)
    (run / "run.json").rename(run / f"{PARTIAL}{our_mark()}run.json")  # killed before it was renamed
    begin(run, {"verb": "train", "arguments": {}})
    with training_folder(run, resume=False, overwrite=True) as folder:
        shutil.copytree(finished_run, folder)
    assert os.listdir(tmp_path) == ["run"] and contents(run) == contents(finished_run)
    (run / "run.json").unlink()
    begin(run, {"verb": "train", "arguments": {}})
    (run / "notes.txt").write_text("mine")
    with refused("notes.txt in it is not of a run"):
        check_output(run, resume=False, overwrite=True)


def test_a_folder_of_another_program_is_not_gone_on_with_for_a_file_of_the_name_of_ours(tmp_path):
    run = tmp_path / "run"
    run.mkdir()
    (run / "run.json").write_text('{"mine": 1}')
    (run / "log.txt").write_text("mine")
    before = contents(run)
    with refused("run.json was not written by this program", cure="another -o"):
        train(["-o", str(run), *TINY_RUN, "--resume"])
    assert contents(run) == before


def test_a_whole_run_without_its_checkpoints_is_not_replaced_unasked(finished_run, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(finished_run, run)
    shutil.rmtree(run / "checkpoints")
    before = contents(run)
    with refused("its checkpoints are gone", cure="--overwrite"):
        train(["-o", str(run), "--resume", "--trainer.max_steps", "4"])
    assert contents(run) == before and json.loads(before["run.json"])["steps"] == 2


def test_a_run_that_goes_on_to_its_last_step_exports_that_and_not_what_chose_before(finished_run, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(finished_run, run)
    assert (run / "checkpoints" / "best.ckpt").is_file()
    assert train(["-o", str(run), "--resume", "--trainer.max_steps", "3", "--fit.monitor", "last"]) == 0
    card = (run / "model.md").read_text(encoding="utf-8")
    assert "- checkpoint: last" in card and "- steps: 3" in card and "chose" not in card
    assert "These frames also chose the checkpoint" in (finished_run / "model.md").read_text(encoding="utf-8")


def test_the_least_value_of_one_measure_is_not_held_against_another(tmp_path):
    def checkpoints(monitor: str) -> Checkpoints:
        return Checkpoints(tmp_path, monitor, 10, 0, Received(), None)

    saved = {**checkpoints("val/loss").state_dict(), "best": 0.25, "best_batches": 10}
    for monitor, best in (("val/loss", 0.25), ("val/photometric", math.inf)):
        found = checkpoints(monitor)
        found.load_state_dict(saved)
        assert found.state_dict()["best"] == best


def test_after_a_training_the_process_warns_logs_and_computes_as_before(recwarn):
    def state() -> tuple[object, ...]:
        levels = [logging.getLogger(name).level for name in ("lightning.pytorch", "lightning.fabric")]
        return list(warnings.filters), levels, torch.get_float32_matmul_precision(), flushes()

    before = state()
    with while_training():
        warnings.warn("the loader does not have many workers", stacklevel=1)
        assert all(now != then for now, then in zip(state(), before, strict=True))
    assert state() == before and not recwarn.list
    warnings.warn("the loader does not have many workers", stacklevel=1)
    assert len(recwarn.list) == 1


def test_a_run_that_was_to_take_the_place_of_another_goes_on_with_its_own_settings(tmp_path):
    def settings(place: Path) -> Path:
        place.mkdir()
        (place / "config.yaml").write_text("seed: 1\n")
        return place / "config.yaml"

    argv = ["--resume", "-o", str(tmp_path / "run")]
    of_finished = settings(tmp_path / "run")
    assert _with_own_config(argv) == ["--config", str(of_finished), *argv]
    of_other = settings(tmp_path / ".run.unfinished")
    assert _with_own_config(argv) == ["--config", str(of_other), *argv]
