"""No verb is silent for longer than ten seconds; by a clock of the test's own, and once on the real thread."""

from __future__ import annotations

import threading
from types import SimpleNamespace

import pytest
import torch

from lightdepth.command_line import heartbeat
from lightdepth.command_line.heartbeat import SECONDS, Heartbeat, at_work, beating, duration
from lightdepth.reporting.progress import Progress, Stages, counted_through
from train.callbacks import TrainingProgress


@pytest.fixture
def clock(monkeypatch) -> list[float]:
    now = [100.0]
    for place in ("command_line.heartbeat", "reporting.progress"):
        monkeypatch.setattr(f"lightdepth.{place}.time", SimpleNamespace(monotonic=lambda: now[0]))
    return now


class Verb:
    """A verb whose heart beats every half a second, with the seconds at which something was said."""

    def __init__(self, clock: list[float]) -> None:
        self.clock, self.lines, self.at = clock, list[str](), [clock[0]]
        self.heart = Heartbeat("lightdepth sparse", lambda: self.at[-1], self.say)

    def say(self, line: str) -> None:
        self.lines.append(line)
        self.at.append(self.clock[0])

    def works(self, seconds: float) -> None:
        for _ in range(round(2 * seconds)):
            self.clock[0] += 0.5
            self.heart.beat(self.clock[0])

    @property
    def longest_silence(self) -> float:
        return max(b - a for a, b in zip(self.at, self.at[1:], strict=False))


def test_work_that_nobody_counts_is_told_every_ten_seconds_with_the_last_line_of_the_log(clock):
    verb = Verb(clock)
    verb.works(12)
    verb.heart.stage("light: is fitted on the map\nand more")
    verb.works(25)
    assert verb.longest_silence <= SECONDS and len(verb.lines) == 3
    assert verb.lines[0].startswith("lightdepth sparse: 10 s so far, still starting")
    assert "starting" not in verb.lines[2] and verb.lines[2].endswith("since: light: is fitted on the map")


def test_a_verb_that_has_said_something_is_no_longer_starting(clock):
    verb = Verb(clock)
    verb.works(21)
    verb.say("a line of its own")
    verb.works(11)
    assert ["starting" in line for line in verb.lines] == [True, True, False, False]


def test_only_a_verb_that_compiles_loops_says_so_and_once(clock):
    verb = Verb(clock)
    verb.works(11)
    heartbeat.compiles(1, begins=True)
    verb.works(20)
    heartbeat.compiles(1, begins=False)
    verb.works(10)
    assert ["it compiles loops" in line for line in verb.lines] == [False, True, False, False]


def test_a_long_line_of_the_log_is_named_by_its_beginning(clock):
    verb = Verb(clock)
    verb.heart.stage(f"map_000: {'10 of 10 keyframes aligned, ' * 9}")
    verb.works(12)
    assert verb.lines[0].endswith("...") and "map_000: 10 of 10" in verb.lines[0] and len(verb.lines[0]) < 120


def test_a_verb_that_says_something_itself_is_not_told_of(clock):
    verb = Verb(clock)
    for _ in range(10):
        verb.works(9)
        verb.say("a line of its own")
    assert set(verb.lines) == {"a line of its own"}


def test_a_step_that_takes_long_is_told_with_rate_and_time_left(clock, capsys):
    verb = Verb(clock)
    with Progress("Densifying", 10) as bar:
        for _ in range(4):
            verb.works(2)
            bar.advance()
        verb.works(11)
    assert verb.longest_silence <= SECONDS
    assert verb.lines[-1].startswith("Densifying: 4/10, ") and verb.lines[-1].endswith(
        " s into the next, 2 s each, about 12 s left"
    )


def test_a_step_that_takes_longer_than_all_was_to_take_has_no_time_left(clock, capsys):
    verb = Verb(clock)
    with Progress("Densifying", 10) as bar:
        for _ in range(6):
            verb.works(2)
            bar.advance()
        verb.works(30)
    assert "about" in verb.lines[0] and verb.lines[-1].endswith(" s into the next")


def test_a_line_that_ends_a_silence_is_not_said_twice(clock, capsys):
    verb = Verb(clock)
    with Progress("Matching", 100) as bar:
        for _ in range(80):
            verb.works(0.5)
            bar.advance()
    assert len(verb.lines) == 4 and "into the next" not in verb.lines[0]
    assert capsys.readouterr().err.splitlines() == ["Matching: 80 in 40.0 s"]


def test_stages_are_counted_one_after_the_other(clock, capsys):
    with Stages("sparse map") as told:
        for stage, count in (("features", 40), ("matches", 400)):
            for done in range(0, count + 1, count // 10):
                told(stage, done, count)
                clock[0] += 5
    lines = capsys.readouterr().err.splitlines()
    assert "sparse map: features: 16/40, 1.25 s each, about 30 s left" in lines
    assert any(line.startswith("sparse map: features: 40 in ") for line in lines)
    assert any(line.startswith("sparse map: matches: 160/400, 8 a second") for line in lines)


def test_what_is_counted_inside_something_counted_has_no_last_line(clock, capsys):
    with Progress("Benchmark", 2):
        assert list(counted_through([1, 2], "Judging maps")) == [1, 2]
    assert [line.split(":")[0] for line in capsys.readouterr().err.splitlines()] == ["Benchmark"]


def test_a_heart_beats_on_a_thread_of_its_own(monkeypatch):
    monkeypatch.delenv("LIGHTDEPTH_HEARTBEAT", raising=False)
    monkeypatch.setattr(heartbeat, "SECONDS", 0.02)
    monkeypatch.setattr(heartbeat, "_LOOKS", 0.01)
    said = threading.Event()
    lines: list[str] = []

    def say(line: str) -> None:
        lines.append(line)
        said.set()

    with at_work(lambda now: "at it"), beating(Heartbeat("verb", lambda: 0.0, say)):
        assert said.wait(60)
    assert lines[0] == "at it" and not [t for t in threading.enumerate() if t.name == "heartbeat"]


def test_a_training_with_slow_steps_says_a_line_at_least_every_ten_seconds(monkeypatch):
    now, lines = [0.0], list[str]()
    monkeypatch.setattr("train.callbacks.time", SimpleNamespace(monotonic=lambda: now[0]))
    progress = TrainingProgress(lines.append, every=100)
    trainer = SimpleNamespace(
        global_step=0, estimated_stepping_batches=1000, accumulate_grad_batches=1, world_size=1, logger=None
    )
    trainer.callback_metrics = {"train/loss": torch.tensor(0.5)}
    batch = SimpleNamespace(image=torch.zeros(2, 3, 4, 4))
    progress.on_train_start(trainer, None)
    for step in range(1, 31):
        trainer.global_step, now[0] = step, 4.0 * step
        progress.on_train_batch_end(trainer, None, None, batch, 0)
    assert len(lines) == 10 and lines[0].startswith("step 3/1000") and "left" in lines[0]


def test_times_are_told_as_exactly_as_it_matters():
    assert [duration(s) for s in (3.4, 119, 150, 7300)] == ["3 s", "119 s", "2 min", "2 h 2 min"]
