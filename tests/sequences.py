"""Small sequences for the verb batch, and how its outputs are compared."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from colons import colon, slam

from densify.config import DensifyConfig
from densify.dense_run import Asked
from densify.inputs import MapSource, SurfaceFiles
from densify.joining import MergeConfig
from lightdepth.checkpoint import ModelSource
from lightdepth.cli import main
from lightdepth.datasets import SequenceSource, open_sequence
from lightdepth.errors import InputError
from lightdepth.maps import read_map
from lightdepth.models import DepthModel
from lightdepth.reporting.run import recorded, run_folder
from lightdepth.sfm.config import SfmConfig
from lightdepth.tube.export import write_synthetic

QUICK = ("--map", "slam", "--checkpoint", "decline", "--judge.no-on", "--no-fit-light")
"""Of everything that is left out the answer is not asked for here."""


def asked_of_all(**source: Any) -> Asked:
    """What a command line asks of all sequences that says no more than this."""
    given = SequenceSource(Path("manifest"), **source)
    config, files = DensifyConfig(), SurfaceFiles()
    return Asked(given, MapSource(), ModelSource("decline"), config, SfmConfig(), files, True, True, MergeConfig())


def made_sequences(root: Path, count: int, name: str = "case_{:02d}") -> list[Path]:
    """So many folders of frames with maps in them, of three lengths."""
    folders = []
    for number in range(count):
        frames = colon(number, 4 + number % 3, 6.0).frames
        folders.append(root / name.format(number))
        write_synthetic(frames, slam(frames), folders[-1])
    return folders


def quick_run(asked: Asked, model: DepthModel, output: Path, overwrite: bool = False, resume: bool = False) -> None:
    """In the place of dense_run: a run folder whose figures are of the input, made in an instant."""
    arguments = recorded(asked.source, asked.mapped, output=output)
    with run_folder(output, "densify", arguments, overwrite, resume) as run:
        assert asked.mapped.map is not None
        run.hash_inputs(data=asked.source.data, map=asked.mapped.map)
        (submap,) = read_map(asked.mapped.map).submaps
        seen = open_sequence(asked.source.data).first().image
        if not seen.any():
            raise InputError(asked.source.data, "all black", "expected light")
        (run.folder / "report.html").write_text(f"<p>{asked.source.data}</p>", encoding="utf-8")
        count = len(submap.keyframes)
        found = {"keyframes": count, "aligned": count, "vertices": len(submap.points), "coverage": {"well_share": 0.5}}
        run.record["maps"] = [found]
        run.record["verdict"] = {"colour": "green", "number": float(seen.mean()), "judge": "images"}


def batch(manifest: object, output: Path, *more: object, quick: tuple[str, ...] = QUICK) -> int:
    """The verb, in this process unless more is said; its exit code."""
    jobs = () if "--jobs" in more else ("--jobs", "0")
    try:
        return main(["batch", str(manifest), "-o", str(output), *quick, *map(str, (*jobs, *more))])
    except SystemExit as stopped:
        return int(stopped.code or 0)


def words(
    manifest: object, output: Path, *more: object, quick: tuple[str, ...] = QUICK, real: bool = True
) -> list[str]:
    """The verb as a command line of a process of its own; `real` false makes its runs in an instant, one by one."""
    program = ["-m", "lightdepth"] if real else [str(Path(__file__).with_name("quick_batch.py"))]
    jobs = [] if real else ["--jobs", "0"]
    return [sys.executable, *program, "batch", str(manifest), "-o", str(output), *quick, *jobs, *map(str, more)]


def called(*given: object, **named: Any) -> tuple[int, float]:
    """Exit code and seconds of the verb in a process of its own."""
    start = time.monotonic()
    done = subprocess.run(words(*given, **named), check=False, env=environment(), capture_output=True)
    return done.returncode, time.monotonic() - start


def killed_after(count: int, *given: Any, **named: Any) -> int:
    """The verb in a process of its own, which is killed when so many runs are finished, and its workers see that it is;
    how many are finished then."""
    output: Path = given[1]
    with subprocess.Popen(words(*given, **named), env=environment(), stderr=subprocess.DEVNULL) as one:
        while len(stamps(output)) < count:
            assert one.poll() is None, "it ended before"
            time.sleep(0.02)
        children = Path(f"/proc/{one.pid}/task/{one.pid}/children").read_text().split()
        one.send_signal(signal.SIGKILL)
    while any(Path(f"/proc/{child}/maps").exists() and Path(f"/proc/{child}/maps").read_bytes() for child in children):
        time.sleep(0.02)
    return len(stamps(output))


def environment() -> dict[str, str]:
    return os.environ | {"PYTHONPATH": str(Path(__file__).parents[1])}


def table(output: Path) -> list[dict[str, Any]]:
    """The table of an output, without times."""
    return [{k: v for k, v in line.items() if k != "seconds"} for line in read_table(output)]


def read_table(output: Path) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = json.loads((output / "table.json").read_text(encoding="utf-8"))
    return found


def stamps(output: Path) -> dict[str, int]:
    """When each run of an output was finished."""
    return {path.parent.name: path.stat().st_mtime_ns for path in (output / "sequences").glob("[!.]*/run.json")}
