"""What a verb that was stopped says of how to go on: the whole command line, which goes on when it is typed."""

from __future__ import annotations

import json
import signal
from pathlib import Path
from shlex import quote, split

import pytest
from lightning.pytorch import Callback
from test_train_folder import files_up_to
from training import TINY_RUN, write_sequence

import train.fit as fit_module
from lightdepth.cli import main
from lightdepth.command_line import following
from lightdepth.command_line.outcome import resuming
from lightdepth.errors import Interrupted
from lightdepth.reporting import batches
from lightdepth.reporting.run import Run
from train.ablation.run import _kept as kept_by_rows


@pytest.fixture(autouse=True)
def before_a_terminal(monkeypatch, request):
    """Somebody sits before it: logs and pipes are told no names."""
    monkeypatch.setattr(following, "on_terminal", lambda stream: "in_a_log" not in request.node.name)


CHEAP = [*TINY_RUN, "--trainer.max-steps", "3", "--trainer.logger", "none"]


class Sends(Callback):
    """Sends this process a signal before its first step, or in the middle of a later one."""

    def __init__(self, step: int) -> None:
        self.step = step

    def on_train_start(self, trainer, module):
        if not self.step:
            signal.raise_signal(signal.SIGINT)

    def on_before_backward(self, trainer, module, loss):
        if self.step and trainer.global_step == self.step:
            signal.raise_signal(signal.SIGTERM)


@pytest.fixture
def stopped_at(monkeypatch):
    """Lets trainings of this process be stopped at a step; None lets them be."""
    original = fit_module._with_callbacks

    def at(step: int | None) -> None:
        extra = [] if step is None else [Sends(step)]
        monkeypatch.setattr(
            fit_module, "_with_callbacks", lambda asked, *rest: original({**asked, "callbacks": extra}, *rest)
        )

    return at


@pytest.fixture
def stopped_in_part(monkeypatch):
    """Each frame is a part, and a signal comes behind the first one, once."""
    left, real = [1], Run.finish_part

    def finish_part(run: Run, *given, **named) -> None:
        real(run, *given, **named)
        if left:
            left.clear()
            signal.raise_signal(signal.SIGTERM)

    monkeypatch.setattr(batches, "SECONDS", 0.0)
    monkeypatch.setattr(Run, "finish_part", finish_part)


def typed(line: str) -> list[str]:
    """The words behind `next: lightdepth`."""
    assert line.startswith("next: lightdepth "), line
    return split(line)[2:]


def test_a_training_that_is_stopped_before_its_first_step_says_that_nothing_is_kept_and_what_to_do(
    tmp_path, stopped_at, capsys
):
    words = ["train", "-o", str(tmp_path / "run"), *CHEAP]
    stopped_at(0)
    assert main(words) == 128 + signal.SIGINT
    said = capsys.readouterr().err.splitlines()[-1]
    assert said.endswith("no step was made yet, so nothing is kept: the same command starts anew")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("flags", [(), ("--overwrite",)], ids=" ".join)
def test_a_training_that_is_stopped_says_the_command_that_goes_on_and_that_command_does(
    tmp_path, stopped_at, capsys, flags
):
    run = tmp_path / "it's a run"
    words = ["train", "-o", str(run), *CHEAP]
    if flags:
        assert main(words) == 0
    stopped_at(1)
    assert main([*words, *flags]) == 128 + signal.SIGTERM
    *_, said, then = capsys.readouterr().err.splitlines()
    assert said.endswith("step 2 is kept in last.ckpt: --resume goes on")
    assert typed(then) == [*words, "--resume"]
    stopped_at(None)
    assert main(typed(then)) == 0
    assert "resuming from last.ckpt, step 2" in capsys.readouterr().err
    assert json.loads((run / "run.json").read_text())["steps"] == 3


def test_a_training_that_finds_no_room_says_the_command_that_goes_on(tmp_path, stopped_at, capsys):
    words = ["train", "-o", str(tmp_path / "run"), *CHEAP]
    stopped_at(1)
    main(words)
    stopped_at(None)
    capsys.readouterr()
    with files_up_to(1 << 16):
        assert main([*words, "--resume"]) == 5
    *_, said, then = capsys.readouterr().err.splitlines()
    assert "Its checkpoints are kept: --resume goes on" in said and typed(then) == [*words, "--resume"]


def test_a_job_that_is_in_the_queue_again_is_not_to_be_started_by_hand(tmp_path, stopped_at, capsys, monkeypatch):
    monkeypatch.setattr(fit_module, "requeued", lambda number: "job 17 is in the queue again")
    stopped_at(1)
    main(["train", "-o", str(tmp_path / "run"), *CHEAP])
    assert capsys.readouterr().err.splitlines()[-1].endswith("goes on. job 17 is in the queue again")


@pytest.mark.parametrize("manner", [(), ("--quiet",), ("--json",)], ids=" ".join)
def test_a_prediction_that_is_stopped_says_the_command_that_goes_on_and_that_command_does(
    tmp_path, stopped_in_part, capfd, manner
):
    data = write_sequence(tmp_path / "the data", 3)
    words = ["predict", str(data), "--checkpoint", "decline", "-o", str(tmp_path / "out"), *manner]
    assert main(words) == 128 + signal.SIGTERM
    said = capfd.readouterr()
    assert said.err.splitlines()[-2].endswith("1 finished part is kept: --resume goes on")
    then = said.err.splitlines()[-1]
    assert typed(then) == [*words, "--resume"]
    if "--json" in manner:
        assert json.loads(said.out)["next"] == "the same command with --resume"  # a program is told no names
    assert main(typed(then)) == 0
    assert (tmp_path / "out" / "run.json").is_file()


def test_an_ablation_that_is_in_the_queue_again_says_so():
    error = Interrupted(signal.SIGUSR1, "step 3 is kept. job 17 is in the queue again")
    with (
        pytest.raises(Interrupted, match=r"finished trainings are kept\. job 17 is in the queue again$"),
        kept_by_rows(),
    ):
        raise error


def test_an_ablation_that_is_stopped_goes_on_by_its_own_command_and_has_no_other(tmp_path, stopped_at, capsys):
    settings = tmp_path / "small.yaml"
    settings.write_text(
        "rows: [{name: ours}]\njudged: [{name: other, make: variant, strength: weak, first: 5, count: 1}]\n"
        "settings: {data.size: [40, 32], data.tube.scenes: 1, data.tube.val_scenes: 1, data.tube.frames: 4,\n"
        "           model.network.width: 4, trainer.max_steps: 3, trainer.accelerator: cpu}\n"
    )
    base = Path(__file__).parents[1] / "configs" / "train" / "tube_smoke.yaml"
    stopped_at(1)
    words = ["ablate", "--config", str(settings), "--base", str(base), "--seeds", "3", "-o", str(tmp_path / "run")]
    assert main(words) == 128 + signal.SIGTERM
    said = capsys.readouterr().err.splitlines()[-1]
    assert said == "lightdepth ablate: stopped by SIGTERM; finished trainings are kept: the same command goes on"


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["train", "-o", "my run", "--overwrite"], f"train -o {quote('my run')} --resume"),
        (["train", "--resume", "-o", "run"], "train --resume -o run"),
        (["predict", "--overw", "-o", "out", "--", "-data"], "predict -o out --resume -- -data"),
        (["adapt", "data", "-o", "out", "--overlap", "0.1"], "adapt data -o out --overlap 0.1 --resume"),
        (["bench", "per-frame", "-o", "$HOME"], "bench per-frame -o '$HOME' --resume"),
    ],
)
def test_the_command_that_goes_on_is_the_one_that_was_typed_with_resume_in_the_place_of_overwrite(words, line):
    assert resuming(words).named == f"lightdepth {line}"


def test_in_a_log_the_command_that_goes_on_has_no_names(tmp_path, stopped_in_part, capfd):
    data = write_sequence(tmp_path / "Doe", 3)
    assert main(["predict", str(data), "--checkpoint", "decline", "-o", str(tmp_path / "out")]) == 128 + signal.SIGTERM
    said = capfd.readouterr().err
    assert said.splitlines()[-1] == "next: the same command with --resume" and "Doe" not in said
    assert resuming(["predict", "--overwrite"]).anonymous.endswith("--resume in the place of --overwrite")
