"""Commands that cannot work end with their exit code and one sentence, without a traceback; they leave nothing behind,
and their inputs as they were."""

from __future__ import annotations

import hashlib
import os
import warnings
from collections import Counter
from pathlib import Path

import pytest
from bad_commands import ROWS, Command, prepared
from more_bad_commands import MORE

from lightdepth.cli import main

ALL = [*ROWS, *MORE]


def shown(command: Command) -> str:
    return command.typed.replace("HERE/", "").replace(" -o OUT", "")


def content(folder: Path) -> str:
    """A hash of all that is in a folder: names and bytes."""
    digest = hashlib.sha256()
    for path in sorted(folder.rglob("*")):
        digest.update(os.fsencode(path.relative_to(folder)))
        digest.update(path.read_bytes() if path.is_file() else b"")
    return digest.hexdigest()


def stamps(folder: Path) -> list[tuple[str, int, int]]:
    """Names, sizes and times of all that is in a folder."""
    found = []
    for at, folders, files in os.walk(folder):
        for name in (*folders, *files):
            stat = os.lstat(os.path.join(at, name))
            found.append((os.path.join(at, name), stat.st_size * (name in files), stat.st_mtime_ns))
    return sorted(found)


@pytest.fixture(scope="module")
def here(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("bad") / "here"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        prepared(folder)
    return folder


@pytest.fixture(scope="module", autouse=True)
def unchanged(here):
    """No command changes a byte of what it is given."""
    before = content(here)
    yield
    assert content(here) == before


def ended(argv: list[str]) -> int:
    try:
        return main(argv)
    except SystemExit as stopped:
        return int(stopped.code or 0)


@pytest.mark.parametrize(
    "command",
    [pytest.param(c, id=shown(c), marks=[pytest.mark.xfail(strict=True, reason=c.fault)] * bool(c.fault)) for c in ALL],
)
def test_a_command_that_cannot_work_says_why_and_leaves_nothing(command, here, tmp_path, capfd, monkeypatch):
    monkeypatch.chdir(tmp_path)  # what is written beside the output is seen, too
    before = stamps(here)
    code = ended(command.argv(here, tmp_path / "out"))
    err = capfd.readouterr().err
    assert "Traceback" not in err
    assert code == command.code, err
    assert command.words in err, err
    assert sum(line.startswith("lightdepth") for line in err.splitlines()) == 1, err
    assert os.listdir(tmp_path) == [] and stamps(here) == before


def test_there_are_many_commands_of_every_verb_and_each_is_of_its_own():
    from importlib import metadata

    assert len({c.typed for c in ALL}) == len(ALL) >= 250
    verbs = {entry.name for entry in metadata.entry_points(group="lightdepth.commands")} - {"doctor"}  # takes nothing
    assert verbs <= {c.verb for c in ALL}


if __name__ == "__main__":
    for verb, count in Counter(c.verb for c in ALL).most_common():
        print(f"{count:5d} {verb}")
    print(f"{len(ALL):5d} in all")
