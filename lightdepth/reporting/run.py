"""Run folders: what a verb writes appears whole or not at all, and says how it was made.

Work goes to a hidden folder beside OUT, which is renamed when it is complete; run.json is written last. A verb that
fails leaves OUT as it was.
"""

from __future__ import annotations

import hashlib
import json
import math
import platform
import resource
import shutil
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, is_dataclass
from importlib import metadata
from pathlib import Path
from typing import Any, TextIO

from lightdepth.errors import InputError, PartialFailure
from lightdepth.files.writing import move_whole, write_whole

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


class Run:
    """An output folder in the making. `folder` is where to write; `record` is what run.json will say besides."""

    def __init__(self, folder: Path, verb: str, arguments: Mapping[str, Any]):
        self.folder = folder
        self.record: dict[str, Any] = {"failures": [], "warnings": []}
        self._verb, self._arguments, self._start = verb, plain(arguments), time.time()

    def log(self, message: str) -> None:
        """A line for the user and for log.txt."""
        print(message, flush=True)
        self._note(message)

    def _note(self, message: str) -> None:
        with (self.folder / "log.txt").open("a", encoding="utf-8", errors="backslashreplace") as file:
            file.write(f"{time.strftime('%H:%M:%S')} {message}\n")

    def fail(self, what: str, reason: str) -> None:
        """Part of the work failed; the rest goes on (exit code 4 at the end)."""
        self.record["failures"].append({"what": what, "reason": reason})
        self.log(f"failed: {what}: {reason}")

    def warn(self, message: str) -> None:
        """Something is doubtful; the work goes on. It is in the log and in run.json."""
        self.record["warnings"].append(message)
        self.log(f"warning: {message}")

    def hash_inputs(self, **paths: Path | None) -> None:
        """Notes what files and folders were read, by name; None is one that was not given."""
        for name, path in paths.items():
            if path is not None:
                self.record.setdefault("inputs", {})[name] = {"path": str(path), "sha256": input_hash(path)}

    @contextmanager
    def hearing(self) -> Iterator[None]:
        """What is warned of meanwhile, by whom ever, is in log.txt and run.json too."""
        shown = warnings.showwarning

        def heard(
            message: Warning | str,
            category: type[Warning],
            filename: str,
            lineno: int,
            file: TextIO | None = None,
            line: str | None = None,
        ) -> None:
            shown(message, category, filename, lineno, file, line)
            if issubclass(category, UserWarning):  # a library's deprecations are no news to a user
                self.record["warnings"].append(str(message))
                self._note(f"warning: {message}")

        warnings.showwarning = heard
        try:
            yield
        finally:
            warnings.showwarning = shown

    def finish(self) -> None:
        import yaml

        (self.folder / "config.yaml").write_text(yaml.safe_dump(self._arguments, sort_keys=False), encoding="utf-8")
        write_run_json(self.folder, self._verb, self._arguments, self._start, self.record)


def recorded(*groups: object, **options: object) -> dict[str, object]:
    """The options of a verb, by name, as run.json and config.yaml hold them: the fields of its groups (dataclasses),
    then its own."""
    return {name: value for group in groups for name, value in vars(group).items()} | options


@contextmanager
def run_folder(output: Path, verb: str, arguments: Mapping[str, Any], overwrite: bool = False) -> Iterator[Run]:
    """A Run whose folder becomes `output` when the block ends well. Raises InputError when `output` is in use."""
    output = Path(output)
    if output.exists() and not output.is_dir():
        raise InputError(output, "is a file", "expected a folder to make")
    if output.is_dir() and any(output.iterdir()):
        if not overwrite:
            raise InputError(output, "already there and not empty", "choose another -o, or give --overwrite")
        if not (output / "run.json").is_file():
            raise InputError(
                output,
                "not overwritten, it has no run.json and so was not made by this program",
                "choose another -o, or remove it yourself",
            )
        for name, value in arguments.items():
            read = Path(value).resolve() if name != "output" and isinstance(value, str | Path) and value else None
            if read is not None and read.is_relative_to(output.resolve()) and read.exists():
                raise InputError(output, f"not overwritten, {value} is read from it", "choose another -o")
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
        # Beside the target, so that the finished folder arrives by a rename; a name of its own: nothing is in its way.
        staging = Path(tempfile.mkdtemp(prefix=f".{output.name}-", dir=output.parent))
        staging.chmod(0o755)
    except OSError as error:
        raise InputError(output, f"cannot be made ({error.strerror})", "choose another -o") from error
    run = Run(staging, verb, arguments)
    try:
        with run.hearing():
            yield run
        run.finish()
    except BaseException:
        shutil.rmtree(staging, ignore_errors=True)
        raise
    if output.is_dir():
        shutil.rmtree(output)
    move_whole(staging, output)
    if run.record["failures"]:
        first = run.record["failures"][0]
        raise PartialFailure(
            f"{len(run.record['failures'])} part(s) failed, the first: {first['what']}: {first['reason']}. "
            f"The rest is in {output}"
        )


def write_run_json(
    folder: Path, verb: str, arguments: Mapping[str, Any], start: float, record: Mapping[str, Any]
) -> None:
    """run.json, by rename, so that its presence means that the run is complete. `start` as of time.time()."""
    data = {
        "verb": verb,
        "arguments": plain(arguments),
        "command": [Path(sys.argv[0]).name, *sys.argv[1:]],
        "versions": versions(),
        "revision": git_revision(),
        "started": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(start)),
        "seconds": round(time.time() - start, 3),
        "peak_memory_mb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024),
        **plain(record),
    }
    write_whole(folder / "run.json", json.dumps(data, indent=1) + "\n")


def versions() -> dict[str, str]:
    """Installed versions of Python and of the packages that results depend on."""
    found = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return found


def git_revision() -> str | None:
    """Revision of the program's own checkout ("+" with uncommitted changes), or None outside one."""
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


def input_hash(path: Path) -> str:
    """SHA-256 over names and sizes of the files below a path, and over the contents of those up to 1 MB."""
    if not path.exists():
        raise InputError(path, "no such file or folder", "correct its name, or put it there")
    digest = hashlib.sha256()
    files = sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]
    for file in files:
        size = file.stat().st_size
        name = file.relative_to(path) if path.is_dir() else file.name
        digest.update(f"{name}\0{size}\0".encode("utf-8", "surrogateescape"))
        if size <= 1 << 20:
            digest.update(file.read_bytes())
    return digest.hexdigest()


def plain(value: Any) -> Any:
    """Dataclasses, paths, tuples and numpy scalars as what JSON and YAML know."""
    if is_dataclass(value) and not isinstance(value, type):
        return plain(asdict(value))
    if isinstance(value, Mapping):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(v) for v in value]
    if isinstance(value, Path):
        return str(value)
    if hasattr(value, "item") and getattr(value, "ndim", 1) == 0:
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return None  # JSON has neither NaN nor infinity
    return value
