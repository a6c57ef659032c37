"""Processes that train together on one machine: the first one starts the others, and they look after each other.

Lightning kills all of them (SIGKILL) within five seconds of the end of one that failed, whatever they were doing: what
was begun stays, and nobody says why. Here the first process ends in order, with the exit code of the one that failed;
none is left behind; and where a collective call never returns, all end after `_PATIENCE_S`, with a sentence.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from threading import Event, Thread
from typing import Any

import lightning.pytorch as pl
import torch
from lightning.pytorch.strategies.launchers.subprocess_script import _SubprocessScriptLauncher

from lightdepth.errors import InputError, Interrupted, MachineFailure, PartialFailure
from lightdepth.signals import SIGNALS, Received

_STARTED_BY = "LIGHTDEPTH_STARTED_BY"
"""Environment of the other processes: the first one's number, and the folder in which each says that it is there."""
_PATIENCE_S, _EVERY_S = 60.0, 0.2
_LEAVING_S = 20.0
"""How long a process that fails may take until it is gone."""
_LOST = ("Connection closed by peer", "Connection reset by peer", "Broken pipe", "gloo", "NCCL", "Socket Timeout")
"""What libraries say where another process is gone."""


class Together(_SubprocessScriptLauncher):
    """Lightning's launcher of processes by the command line of the first one. `received` holds signals back."""

    def __init__(self, of: _SubprocessScriptLauncher, received: Received) -> None:
        super().__init__(of.cluster_environment, of.num_processes, of.num_nodes)
        self.received = received
        first, _, folder = os.environ.get(_STARTED_BY, "").partition(":")
        self.first = int(first) if first else None
        self._arrived = Path(folder, os.environ["LOCAL_RANK"]) if first else None

    def launch(self, function: Callable[..., Any], *args: Any, trainer: pl.Trainer | None = None, **kwargs: Any) -> Any:
        """Calls the function in all processes, which are started by the first call, unless something else has."""
        if not self.cluster_environment.creates_processes_externally:
            self._start()
        if self._arrived is not None:
            with suppress(OSError):  # the first one is gone, and with it the folder
                self._arrived.touch()
        over = Event()
        Thread(target=self._watch, args=(over,), daemon=True, name="others of a training").start()
        try:
            return super().launch(function, *args, trainer=trainer, **kwargs)  # by now all are there
        finally:
            over.set()

    def lost(self, patience_s: float = 0.0) -> BaseException | None:
        """The end of another process that failed, within some seconds; None where there is none."""
        until = time.monotonic() + patience_s
        while True:
            if self.first is not None and os.getppid() != self.first:
                return MachineFailure("the first process of the training is gone; start it again, with --resume")
            for rank, process in enumerate(self.procs, 1):
                if process.poll():
                    return _ended(rank, process.returncode)
            if time.monotonic() >= until:
                return None
            time.sleep(_EVERY_S)

    def end(self) -> None:
        """Of a run that failed: the other processes may end by themselves, and are ended after a while."""
        for wait, number in ((_LEAVING_S, signal.SIGTERM), (_LEAVING_S / 4, signal.SIGKILL)):
            until = time.monotonic() + wait
            for process in self.procs:
                with suppress(subprocess.TimeoutExpired):
                    process.wait(max(0.0, until - time.monotonic()))
            for process in self.procs:
                process.send_signal(number)  # does nothing to one that is gone
        for process in self.procs:
            process.wait()

    def _start(self) -> None:
        with tempfile.TemporaryDirectory(prefix="lightdepth-") as folder:
            os.environ[_STARTED_BY] = f"{os.getpid()}:{folder}"
            try:
                self._call_children_scripts()
                while len(os.listdir(folder)) < len(self.procs):
                    if (lost := self.lost()) is not None:
                        raise lost
                    self.received.stop()
                    time.sleep(_EVERY_S)
            finally:
                del os.environ[_STARTED_BY]

    def _watch(self, over: Event) -> None:
        """Ends the process where another one is gone and the call that waits for it does not return."""
        while not over.wait(_EVERY_S):
            if (lost := self.lost()) is not None and not over.wait(_PATIENCE_S):
                print(f"lightdepth train: {lost}; the others wait for it in vain", file=sys.stderr, flush=True)
                for process in self.procs:
                    process.kill()
                os._exit(5)


def look_after_each_other(trainer: pl.Trainer, received: Received) -> None:
    """Where the Trainer starts processes by command line, they end together, and in order."""
    found = trainer.strategy.launcher
    if isinstance(found, _SubprocessScriptLauncher):
        trainer.strategy._launcher = Together(found, received)


@contextmanager
def ending_together(trainer: pl.Trainer) -> Iterator[None]:
    """A block that fails in one process ends in all; in the others it is told as what it was there, or as their being
    apart (MachineFailure), not as what a library says of a closed connection."""
    others = trainer.strategy.launcher
    try:
        try:
            yield
        except (InputError, MachineFailure, PartialFailure):
            raise
        except RuntimeError as error:
            apart = isinstance(error, torch.distributed.DistError) or any(words in str(error) for words in _LOST)
            if not apart:
                raise
            lost = others.lost(_LEAVING_S) if isinstance(others, Together) else None
            if lost is not None:
                raise lost from error
            found = str(error).splitlines()[0]
            cure = "does each machine reach MASTER_ADDR at a MASTER_PORT that nothing else takes, and do all still run?"
            raise MachineFailure(f"the processes that train together do not meet ({found}): {cure}") from error
    except BaseException:
        # Else the others wait for an answer. NCCL's own watch tells them; to leave its group may wait for them.
        if torch.distributed.is_initialized() and torch.distributed.get_backend() == "gloo":
            torch.distributed.destroy_process_group()
        if isinstance(others, Together):
            others.end()
        raise


def _ended(rank: int, code: int) -> BaseException:
    """What the first process says, and ends with, of another one that ended with this code."""
    name = f"process {rank} of the training (from 0)"
    if code == 3:
        return InputError(name, "it could not use its input", "mend what it said above")
    if code > 128 and code - 128 in SIGNALS:
        return Interrupted(code - 128)
    if code < 0:
        with suppress(ValueError):
            how = signal.Signals(-code).name
            hint = " (as the system does when memory runs out)" if code == -signal.SIGKILL else ""
            return MachineFailure(f"{name} was ended by {how}{hint}")
    return MachineFailure(f"{name} ended with exit code {code}; what it said stands above")
