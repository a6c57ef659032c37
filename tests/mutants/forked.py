"""Tests in a forked process: what they import of others is imported once, before the fork; what is ours, after it."""

from __future__ import annotations

import ctypes
import gc
import importlib
import importlib.util
import json
import os
import resource
import select
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from importlib.machinery import ModuleSpec, SourceFileLoader
from pathlib import Path
from types import CodeType
from typing import Any

import pytest

from mutants.modules import PACKAGES, ROOT, TESTS

_MEMORY = 4 << 30
"""Bytes that a mutant may take beyond what is there at the fork."""
_WALL = 8.0
"""Seconds on the clock, for each second of processor time that a test may take, until a test that waits is ended."""

OPTIONS = ["-q", "-p", "no:cacheprovider", "-o", "addopts=", "-m", "not slow"]

_OURS = {*PACKAGES, "tests", "mutants", *(path.stem for path in TESTS.glob("*.py"))}


@dataclass(frozen=True)
class Outcome:
    """`status` is killed, survived, timeout or error (of the harness); `by` the test; seconds of processor time."""

    status: str
    by: str
    seconds: float


class Planted(SourceFileLoader):
    """Loads one module from other code than its file's."""

    def __init__(self, name: str, path: Path, code: CodeType):
        super().__init__(name, str(path))
        self._code = code

    def get_code(self, fullname: str) -> CodeType:
        return self._code

    def find_spec(self, name: str, path: object = None, target: object = None) -> ModuleSpec | None:
        return importlib.util.spec_from_file_location(name, self.path, loader=self) if name == self.name else None


def warm(files: Iterable[Path]) -> None:
    """Imports what the test files import, but for the project and the tests themselves."""
    names = forked_value(lambda: _imported(files))
    if spec := importlib.util.find_spec("libusb_package"):  # as lightdepth.native does it for Open3D
        found = [*Path(spec.origin or "").parent.glob("libusb-1.0.so*")]
        if found:
            ctypes.CDLL(str(found[0]), ctypes.RTLD_GLOBAL)
    for name in names:
        try:
            importlib.import_module(name)
        except Exception:  # a part of a package that is not meant to be imported by itself
            continue
    ours = [n for n in sys.modules if _ours(n) and not n.startswith("mutants")]
    assert not ours, f"imported before the fork: {ours}"
    gc.collect()
    gc.freeze()


def _ours(name: str) -> bool:
    return name.split(".")[0] in _OURS


def _imported(files: Iterable[Path]) -> list[str]:
    before = set(sys.modules)
    pytest.main([*OPTIONS, "--collect-only", *map(str, files)])
    return [n for n in sys.modules if n not in before and not _ours(n)]


def forked_value(function: Callable[[], Any]) -> Any:
    """What a function gives in a process of its own."""
    with tempfile.NamedTemporaryFile("r+", encoding="utf-8") as file:
        pid = os.fork()
        if not pid:
            try:
                _quiet()
                text = json.dumps(function())
                Path(file.name).write_text(text, encoding="utf-8")
            finally:
                os._exit(0)
        os.waitpid(pid, 0)
        text = Path(file.name).read_text(encoding="utf-8")
    if not text:
        raise RuntimeError("a process of the harness died")
    return json.loads(text)


def _quiet() -> None:
    nothing = os.open(os.devnull, os.O_RDWR)
    for stream in (0, 1, 2):
        os.dup2(nothing, stream)


class _Told:
    """A plugin that tells the parent which test begins and which one fails, and holds each to its time."""

    def __init__(self, write: int, allowed: dict[str, float]):
        self._write, self._allowed = write, allowed

    def tell(self, what: str, which: str) -> None:
        os.write(self._write, f"{what} {which}\n".encode())

    def pytest_runtest_logstart(self, nodeid: str) -> None:
        used = sum(resource.getrusage(resource.RUSAGE_SELF)[:2])
        limit = int(used + self._allowed.get(nodeid, 10.0)) + 1
        resource.setrlimit(resource.RLIMIT_CPU, (limit, resource.RLIM_INFINITY))
        self.tell("begun", nodeid)

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.failed:
            self.tell("failed", report.nodeid)

    def pytest_collectreport(self, report: pytest.CollectReport) -> None:
        if report.failed:
            self.tell("failed", f"import of {report.nodeid}")

    def pytest_sessionfinish(self, exitstatus: int) -> None:
        self.tell("ended", str(int(exitstatus)))


def run_tests(tests: list[str], allowed: dict[str, float], planted: Planted | None) -> Outcome:
    """Runs tests in this order in a forked process until one fails; allowed is each one's limit in seconds."""
    folder = tempfile.mkdtemp(prefix="mutant-")
    read, write = os.pipe()
    pid = os.fork()
    if not pid:
        try:
            os.setpgid(0, 0)
            os.close(read)
            _quiet()
            resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
            size = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0]) * resource.getpagesize()
            resource.setrlimit(resource.RLIMIT_AS, (size + _MEMORY, size + _MEMORY))
            if planted is not None:
                sys.meta_path.insert(0, planted)
            os.chdir(ROOT)
            told = _Told(write, allowed)
            pytest.main([*OPTIONS, "-x", f"--basetemp={folder}/t", *tests], plugins=[told])
        finally:
            os._exit(0)
    os.close(write)
    try:
        lines, waited_for = _listen(read, pid, allowed)
    finally:
        os.close(read)
    _, status, used = os.wait4(pid, 0)
    shutil.rmtree(folder, ignore_errors=True)
    return Outcome(*_judged(lines, status, waited_for), used.ru_utime + used.ru_stime)


def _listen(read: int, pid: int, allowed: dict[str, float]) -> tuple[list[list[str]], bool]:
    """What the child tells until it ends, and whether it had to be ended because it waited."""
    text, until = "", time.monotonic() + 120.0
    while True:
        ready, _, _ = select.select([read], [], [], max(0.0, until - time.monotonic()))
        if not ready:
            os.killpg(pid, signal.SIGKILL)
            return [line.split(" ", 1) for line in text.splitlines()], True
        more = os.read(read, 65536).decode()
        if not more:
            return [line.split(" ", 1) for line in text.splitlines()], False
        text += more
        begun = [line.split(" ", 1)[1] for line in text.splitlines() if line.startswith("begun ")]
        until = time.monotonic() + _WALL * (allowed.get(begun[-1], 10.0) if begun else 15.0)


def _judged(lines: list[list[str]], status: int, waited_for: bool) -> tuple[str, str]:
    failed = [which for what, which in lines if what == "failed"]
    begun = [which for what, which in lines if what == "begun"]
    ended = [which for what, which in lines if what == "ended"]
    if failed:
        return "killed", failed[0]
    if waited_for or (os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGXCPU):
        return "timeout", begun[-1] if begun else "before the first test"
    if ended == ["0"]:
        return "survived", ""
    if not ended and begun:
        return "killed", f"{begun[-1]} (the process died)"
    return "error", f"pytest ended with {ended}"
