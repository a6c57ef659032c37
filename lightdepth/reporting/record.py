"""run.json: what a run was asked for, which versions made it, and which files it has."""

from __future__ import annotations

import json
import platform
import resource
import subprocess
import sys
import time
from collections.abc import Mapping
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

from lightdepth.command_line.outcome import outcome
from lightdepth.files.replacing import listed
from lightdepth.files.writing import write_whole
from lightdepth.reporting.names import Names
from lightdepth.reporting.same import plain

PACKAGES = (
    "lightdepth",
    "torch",
    "lightning",
    "kornia",
    "numpy",
    "scipy",
    "open3d",
    "open3d-cpu",
    "pycolmap",
    "opencv-python-headless",
)

_NO_NAMES = Names()


def write_run_json(
    folder: Path,
    verb: str,
    arguments: Mapping[str, Any],
    start: float,
    record: Mapping[str, Any],
    names: Names = _NO_NAMES,
) -> None:
    """run.json, by rename, so that its presence means that the run is complete. `start` as of time.monotonic(), which
    no clock that is set back moves; `names` are what inputs are called in it."""
    told, seconds = plain(record), time.monotonic() - start
    data = {
        "verb": verb,
        "arguments": names.hidden(plain(arguments), exactly=True),
        "command": names.command([Path(sys.argv[0]).name, *sys.argv[1:]]),
        "versions": versions(),
        "revision": git_revision(),
        "started": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(time.time() - seconds)),
        "seconds": round(seconds, 3),
        "peak_memory_mb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024),
        **{key: names.hidden(value, exactly=key == "inputs") for key, value in told.items()},
        "files": listed(folder),
    }
    write_whole(folder / "run.json", json.dumps(data, indent=1) + "\n")
    outcome().record = data


def versions() -> dict[str, str]:
    """Installed versions of Python and of the packages that results depend on."""
    found = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return found


@cache
def git_revision() -> str | None:
    """Revision of the program's own checkout ("+" with uncommitted changes) when it is first asked for, or None outside
    one: a process that makes many runs works with what it has loaded."""
    root = Path(__file__).resolve().parents[2]
    if not (root / ".git").exists():
        return None
    try:
        call = {"cwd": root, "capture_output": True, "text": True, "timeout": 10, "check": True}
        revision = subprocess.run(["git", "rev-parse", "HEAD"], **call).stdout.strip()  # type: ignore[call-overload]  # options by name
        changed = subprocess.run(["git", "status", "--porcelain", "-uno"], **call).stdout.strip()  # type: ignore[call-overload]  # options by name
    except (OSError, subprocess.SubprocessError):
        return None
    result: str | None = revision + ("+" if changed else "")
    return result
