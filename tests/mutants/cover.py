"""Which tests run which lines of the mutated modules, and how long each takes; kept until a file changes."""

from __future__ import annotations

import ast
import functools
import hashlib
import json
import os
import re
import signal
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from mutants.forked import OPTIONS, forked_value
from mutants.modules import PACKAGES, ROOT, TESTS

LONGEST = 4.0
"""Seconds of processor time, with lines being traced, beyond which a test is not used."""


@dataclass(frozen=True)
class Cover:
    """Seconds by test; tests by file of a module and line."""

    seconds: dict[str, float]
    lines: dict[str, dict[int, set[str]]]

    def of(self, path: Path, first: int, last: int) -> list[str]:
        """The tests of some lines, the quickest first. Lines that run at import are covered by whatever runs a line of
        the module, and by the test files that name it."""
        lines = self.lines.get(str(path.relative_to(ROOT)), {})
        found: set[str] = set().union(*(lines.get(n, set()) for n in range(first, last + 1)))
        if _at_import(path, first):  # and some of them by a test that was the first to import the module
            found = set().union(*lines.values()) | {t for t in self.seconds if _names(ROOT / t.split("::")[0], path)}
        return sorted(found, key=lambda t: (self.seconds[t], t))


@functools.cache
def _inside(path: Path) -> list[tuple[int, int]]:
    """Lines of the bodies of all functions."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    functions = [n for n in ast.walk(tree) if isinstance(n, ast.FunctionDef | ast.Lambda)]
    bodies = [n.body if isinstance(n.body, list) else [n.body] for n in functions]
    return [(body[0].lineno, body[-1].end_lineno or 0) for body in bodies]


def _at_import(path: Path, line: int) -> bool:
    return not any(first <= line <= last for first, last in _inside(path))


@functools.cache
def _names(test: Path, module: Path) -> bool:
    parts = module.relative_to(ROOT).with_suffix("").parts
    text = test.read_text(encoding="utf-8")
    return ".".join(parts) in text or f"from {'.'.join(parts[:-1])} import" in text


def measured(files: list[Path], modules: list[Path], kept: Path) -> Cover:
    """The cover of some test files, those measured anew that have changed."""
    shared = [p for package in PACKAGES for p in sorted((ROOT / package).rglob("*.py"))]
    shared += [p for p in sorted(TESTS.glob("*.py")) if not p.name.startswith("test_")]
    base = hashlib.sha256(b"".join(p.read_bytes() for p in shared)).hexdigest()
    known: dict[str, Any] = json.loads(kept.read_text(encoding="utf-8")) if kept.is_file() else {}
    seconds: dict[str, float] = {}
    lines: dict[str, dict[int, set[str]]] = {}
    for file in files:
        key = _key(file, base)
        if known.get(file.name, {}).get("key") != key:
            begun = time.process_time(), time.monotonic()
            known[file.name] = {"key": key, **forked_value(lambda file=file: _run(file, modules))}
            failed = known[file.name]["failed"]
            print(
                f"cover of {file.name}: {time.monotonic() - begun[1]:.0f} s, not used: {failed or 'none'}", flush=True
            )
            kept.parent.mkdir(parents=True, exist_ok=True)
            kept.write_text(json.dumps(known), encoding="utf-8")
        found = known[file.name]
        seconds |= found["seconds"]
        for path, by_line in found["lines"].items():
            for line, tests in by_line.items():
                lines.setdefault(path, {}).setdefault(int(line), set()).update(tests)
    return Cover(seconds, lines)


def _key(file: Path, base: str) -> str:
    text = file.read_text(encoding="utf-8")
    beside = [TESTS / f"{name}.py" for name in re.findall(r"^from (test_\w+) import", text, re.M)]
    return hashlib.sha256(base.encode() + b"".join(p.read_bytes() for p in [file, *beside])).hexdigest()


def _run(file: Path, modules: list[Path]) -> dict[str, Any]:
    import coverage

    os.chdir(ROOT)
    cover = coverage.Coverage(data_file=None, include=[str(p) for p in modules], config_file=False)
    plugin = _Contexts(cover)
    cover.start()
    pytest.main([*OPTIONS, str(file)], plugins=[plugin])
    cover.stop()
    return plugin.found()


class _TooLong(Exception):
    pass


class _Contexts:
    """Switches the context of coverage by test and by fixture that several tests share, and measures their time."""

    def __init__(self, cover: Any):
        self._cover = cover
        self._uses: dict[str, list[str]] = {}
        self._seconds: dict[str, float] = {}
        self._shared: dict[str, float] = {}
        self.failed: list[str] = []

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Iterator[Any]:
        _clear_caches()
        self._uses[item.nodeid] = list(getattr(item, "fixturenames", []))
        self._cover.switch_context(item.nodeid)
        signal.signal(signal.SIGPROF, _too_long)
        signal.setitimer(signal.ITIMER_PROF, LONGEST)
        begun, shared = time.process_time(), sum(self._shared.values())
        try:
            return (yield)
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0)
            taken = time.process_time() - begun - (sum(self._shared.values()) - shared)
            self._seconds[item.nodeid] = taken
            self._cover.switch_context("")

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef: Any) -> Iterator[Any]:
        if fixturedef.scope == "function":
            return (yield)
        name, begun = f"fixture {fixturedef.argname}", time.process_time()
        self._cover.switch_context(name)
        try:
            return (yield)
        finally:
            self._shared[name] = self._shared.get(name, 0.0) + time.process_time() - begun
            self._cover.switch_context(next(reversed(self._uses)))

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if not report.passed:
            self.failed.append(report.nodeid)

    def found(self) -> dict[str, Any]:
        users: dict[str, list[str]] = {}
        used = [t for t in self._seconds if t not in self.failed]
        for test in used:
            users[test] = [test]
            for name in self._uses[test]:
                users.setdefault(f"fixture {name}", []).append(test)
        data, lines = self._cover.get_data(), {}
        for path in data.measured_files():
            by_line = {
                line: sorted({t for context in contexts for t in users.get(context, [])})
                for line, contexts in data.contexts_by_lineno(path).items()
            }
            lines[str(Path(path).relative_to(ROOT))] = {n: tests for n, tests in by_line.items() if tests}
        seconds = {
            t: self._seconds[t] + sum(self._shared.get(f"fixture {name}", 0.0) for name in self._uses[t]) for t in used
        }
        return {"seconds": seconds, "lines": lines, "failed": self.failed}


def _too_long(*_: object) -> None:
    raise _TooLong


def _clear_caches() -> None:
    """Forgets what functions remember, so that every test runs the lines that it stands on."""
    for name, module in list(sys.modules.items()):
        if name.split(".")[0] in PACKAGES or (TESTS / f"{name}.py").is_file():
            for value in list(vars(module).values()):
                if isinstance(value, functools._lru_cache_wrapper):
                    value.cache_clear()
