"""Signals: they end a verb in order, once, and only where they were not ignored before."""

import os
import signal
import threading
from contextlib import suppress
from types import SimpleNamespace

import pytest

import lightdepth.cli as cli
from lightdepth.errors import Interrupted
from lightdepth.reporting.run import run_folder
from lightdepth.signals import SIGNALS, ending_on_signals, finishing_first


@pytest.fixture(autouse=True)
def heard():
    """Signals are heard, also where the tests themselves run in the background or under nohup, which ignore some."""
    usual = {n: signal.default_int_handler if n == signal.SIGINT else signal.SIG_DFL for n in SIGNALS}
    before = {number: signal.signal(number, handler) for number, handler in usual.items()}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.fixture
def verb(monkeypatch):
    """Makes a function the one verb of the program."""

    def made(function):
        entry = SimpleNamespace(name="work", load=lambda: function)
        monkeypatch.setattr(cli.metadata, "entry_points", lambda group: [entry])

    return made


@pytest.mark.parametrize("number", SIGNALS)
def test_a_signal_takes_away_what_was_half_written_says_one_line_and_ends_with_128_and_its_number(
    number, verb, tmp_path, capfd
):
    def work(argv):
        with run_folder(tmp_path / "out", "work", {}) as run:
            (run.folder / "half").write_text("half")
            signal.raise_signal(number)
            raise AssertionError("went on")

    verb(work)
    before = [signal.getsignal(n) for n in SIGNALS]
    assert cli.main(["work"]) == 128 + number
    assert list(tmp_path.iterdir()) == []
    out, err = capfd.readouterr()
    assert out == "" and err.startswith(f"lightdepth work: stopped by {number.name}; ") and err.count("\n") == 1
    assert [signal.getsignal(n) for n in SIGNALS] == before


def test_a_second_signal_does_not_tear_what_cleans_up():
    cleaned = []
    with pytest.raises(Interrupted) as caught, ending_on_signals():
        try:
            signal.raise_signal(signal.SIGTERM)
        finally:
            for number in (signal.SIGTERM, signal.SIGINT, signal.SIGINT, signal.SIGHUP):
                signal.raise_signal(number)
            cleaned.append(True)
    assert cleaned and caught.value.signal == signal.SIGTERM


def test_a_signal_that_something_swallowed_is_heard_when_it_comes_again():
    with pytest.raises(Interrupted), ending_on_signals():
        with suppress(BaseException):
            signal.raise_signal(signal.SIGTERM)
        signal.raise_signal(signal.SIGTERM)
        raise AssertionError("went on")


def test_what_was_ignored_before_stays_ignored():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with ending_on_signals():
            signal.raise_signal(signal.SIGHUP)
        assert signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


def test_a_step_is_finished_first_where_it_is_asked_for():
    steps = []
    with pytest.raises(Interrupted) as caught, ending_on_signals(), finishing_first() as received:
        for step in range(5):
            if step == 2:
                signal.raise_signal(signal.SIGUSR1)
                signal.raise_signal(signal.SIGTERM)
            steps.append(step)
            received.stop("all is kept")
    assert steps == [0, 1, 2]
    assert (caught.value.signal, caught.value.kept) == (signal.SIGUSR1, "all is kept")


def test_a_signal_that_no_step_asked_for_ends_the_run_after_the_block():
    with pytest.raises(Interrupted), ending_on_signals(), finishing_first():
        signal.raise_signal(signal.SIGTERM)


def test_a_second_interrupt_from_the_keyboard_is_not_held_back(monkeypatch):
    now = iter(range(0, 1000, 10))
    monkeypatch.setattr("time.monotonic", lambda: float(next(now)))
    with pytest.raises(Interrupted), ending_on_signals(), finishing_first() as received:
        signal.raise_signal(signal.SIGINT)
        assert received.signal == signal.SIGINT
        signal.raise_signal(signal.SIGINT)
        raise AssertionError("went on")


def test_outside_the_main_thread_nothing_changes():
    before = [signal.getsignal(n) for n in SIGNALS]
    seen = []

    def work():
        with ending_on_signals(), finishing_first():
            seen.append([signal.getsignal(n) for n in SIGNALS])

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert seen == [before]


@pytest.mark.parametrize(("number", "ended"), [(signal.SIGTERM, -signal.SIGTERM), (signal.SIGINT, 3)])
def test_a_forked_process_says_nothing_ends_when_it_is_told_to_and_leaves_the_rest_to_its_parent(number, ended, capfd):
    with ending_on_signals():
        child = os.fork()
        if child == 0:
            signal.raise_signal(number)
            os._exit(3)
        _, status = os.waitpid(child, 0)
    assert os.waitstatus_to_exitcode(status) == ended
    assert capfd.readouterr() == ("", "")
