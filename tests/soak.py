"""Soak: hours of work in one process, after which it holds what it held before, and what was kept of the work.

    python tests/soak.py                                    2000 keyframes live, 200 sequences one after the other
    python tests/soak.py --keyframes 60 --sequences 0       a short one, of the first part alone

The first part plays one submap whose world goes on: some frames of a colon, again and again at places of their own.
What is kept of the map grows, and memory may grow with it and no further. The second part calls verbs by the command
line's entry and by the library, each on a sequence of its own; every tenth fails, each time in another way. Growth is a
robust slope over the last three quarters, times their number. Exit code 1 where anything grows. Linux only.
"""

from __future__ import annotations

import argparse
import contextlib
import errno
import gc
import os
import shutil
import signal
import sys
import tempfile
import time
import weakref
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import torch
from colons import EXACT, SMALL, slam
from process_state import State, changed, reached, slope
from verbs import by_options

import densify.commands.live
import densify.live.play
from densify.config import DensifyConfig
from densify.judging.config import JudgeConfig
from densify.live.densifier import Densifier
from densify.pipeline import densify_submap
from lightdepth.calibration import write_camera
from lightdepth.camera import Pinhole
from lightdepth.checkpoint import load_model
from lightdepth.cli import main as lightdepth
from lightdepth.commands.predict import predict
from lightdepth.datasets import open_sequence, write_folder
from lightdepth.errors import InputError
from lightdepth.frame import Frame
from lightdepth.maps import read_map, write_multimap
from lightdepth.sparse_map import SparseMap, Submap
from lightdepth.tube import render_sequence
from lightdepth.tube.export import write_synthetic

CAMERA = Pinhole(64, 48, 35.0, 35.0, 31.5, 24.5)
AGAIN = 40
"""Frames of the colon that is played again and again."""
EVERY = 10
"""Of so many sequences one fails, and after so many the state of the process is noted."""
DECLINE = ("--checkpoint", "decline")
UNJUDGED = (*DECLINE, "--judge.no-on", "--no-fit-light")
WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT
COUNTED = ("handles", "threads", "children", "shared", "files", "figures", "handlers", "filters")


@dataclass(frozen=True)
class Row:
    """A line of the table: what was measured, at the beginning and the end of the last three quarters, by how much it
    grew in them, and by how much it may."""

    what: str
    first: float
    last: float
    growth: float
    allowed: float

    @property
    def flat(self) -> bool:
        """Whether it did not grow by more than is allowed."""
        return self.growth <= self.allowed

    def __str__(self) -> str:
        numbers = "".join(f"{value:>14,.1f}" for value in (self.first, self.last, self.growth, self.allowed))
        return f"{self.what:<44}{numbers}  {'flat' if self.flat else 'GROWS'}"


HEADER = f"{'':<44}{'first':>14}{'last':>14}{'growth':>14}{'allowed':>14}"


def last_three_quarters(what: str, places: Sequence[float], values: Sequence[float], allowed: float) -> Row:
    """The row of a series of values, measured at `places`."""
    start = len(places) // 4
    places, values = places[start:], values[start:]
    return Row(what, values[0], values[-1], slope(places, values) * (places[-1] - places[0]), allowed)


def counted(part: str, places: Sequence[float], states: Sequence[State]) -> list[Row]:
    """A row for each thing that is counted: none of it may grow, not even by one."""
    start = len(states) // 4
    numbers = {name: [getattr(state, name) for state in states[start:]] for name in COUNTED}
    return [
        Row(f"{part}: {name}", some[0], some[-1], max(some[-1], min(some[-3:])) - some[0], 0)
        for name, some in numbers.items()
    ]


# ---- one long sequence, live


def going_on(count: int) -> tuple[list[Frame], SparseMap]:
    """Frames and a map of a world that goes on: a colon of AGAIN frames, each time at a place of its own."""
    short = render_sequence(0, min(AGAIN, count), CAMERA, 0.7 * min(AGAIN, count), SMALL).frames
    (submap,) = slam(short, config=EXACT).map.submaps
    apart = 3 * np.ptp(submap.points, axis=0).max()
    frames, keyframes, ids, points = [], [], [], []
    for again in range(-(-count // len(short))):
        moved, first = np.eye(4), len(frames)
        moved[:3, 3] = -apart * (again % 20), -apart * (again // 20), 0  # far from the origin digits are lost
        new = submap.point_ids.max() + 1
        for frame, keyframe in zip(short, submap.keyframes, strict=True):
            name = f"{first + keyframe.number:06d}"
            frames.append(replace(frame, name=name, true_distance=None, true_world_from_cam=None, time=None))
            pose, known = keyframe.cam_from_map @ moved, keyframe.point_ids + again * new
            keyframes.append(replace(keyframe, name=name, cam_from_map=pose, point_ids=known))
        ids.append(submap.point_ids + again * new)
        points.append(submap.points - moved[:3, 3])
    whole = Submap(0, tuple(keyframes[:count]), np.concatenate(ids), np.concatenate(points))
    return frames[:count], SparseMap((whole,), "a world that goes on")


class Watched(Densifier):
    """The densifier that a run uses, while it is there."""

    last: weakref.ref[Densifier] | None = None

    def __init__(self, *given: Any, **named: Any) -> None:
        super().__init__(*given, **named)
        Watched.last = weakref.ref(self)


def kept_of(densifier: Densifier) -> int:
    """Bytes of all that a densifier keeps; of its volume, the blocks that hold something."""
    volume = densifier._volume
    if volume is None:
        return reached(densifier.__dict__, without=[densifier._model])
    room = max(len(volume._codes), 1)
    blocks = sum(
        array.nbytes for name, array in vars(volume).items() if isinstance(array, np.ndarray) and len(array) == room
    )
    return reached(densifier.__dict__, without=[densifier._model, volume]) + blocks * len(volume.places) // room


def played_live(count: int, home: Path, samples: int) -> list[Row]:
    """The verb live on `count` keyframes of one submap."""
    frames, sparse_map = going_on(count)
    write_folder(frames, home / "data")
    write_multimap(sparse_map, home / "map")
    argv = ["live", str(home / "data"), "--map", str(home / "map"), *UNJUDGED, "-o", str(home / "run")]
    at, states, kept, played = [], [], [], []
    real, temporary = densify.live.play.play, Path(tempfile.gettempdir())
    before: list[State] = []

    def play(*given: Any) -> Any:
        *others, on_keyframe = given
        del frames[:]
        before.append(State.now(temporary))

        def seen(one: Any) -> None:
            on_keyframe(one)
            played.append(one)
            if len(played) % max(1, count // samples) == 0:
                densifier = Watched.last and Watched.last()
                assert densifier is not None
                at.append(len(played))
                states.append(State.now(temporary))
                kept.append((kept_of(densifier) + reached(played)) / 1024)

        return real(*others, seen)

    with (
        mock.patch.object(densify.commands.live, "play", play),
        mock.patch.object(densify.live.play, "Densifier", Watched),
    ):
        code = lightdepth(argv)
    assert code == 0 and len(played) == count, (code, len(played))
    assert Watched.last is not None and Watched.last() is None, "the densifier outlives the run"
    shutil.rmtree(home / "run")
    memory = [state.memory_kb for state in states]
    grown = last_three_quarters("live: what is kept, kB", at, kept, np.inf)
    beyond = [m - k for m, k in zip(memory, kept, strict=True)]
    rows = [
        grown,
        last_three_quarters("live: memory, kB", at, memory, np.inf),
        # Pieces of the C library's, and the room that arrays grow into by halves, are a share of what is kept.
        last_three_quarters("live: memory beyond what is kept, kB", at, beyond, 0.1 * grown.growth + NOISE_KB),
        Row("live: kept of a keyframe, kB", kept[0] / at[0], kept[-1] / at[-1], 0, 0),
        *counted("live", at, states),
    ]
    return [*rows, Row("live: settings that changed", 0, 0, len(changed(before[0], states[-1])), 0)]


NOISE_KB = 4096
"""Memory that may come and go between two moments, kB."""


# ---- many sequences, one after the other


class Faults:
    """What happens to the process at a write below a folder: `fault` is called at the n-th, and at those after it."""

    def __init__(self) -> None:
        self.folder, self.left, self.fault = "", 0, None  # type: ignore[var-annotated]
        sys.addaudithook(self._heard)

    @contextlib.contextmanager
    def at(self, number: int, folder: Path, fault: Callable[[str], None] | None) -> Iterator[None]:
        self.folder, self.left, self.fault = f"{folder}/", number, fault
        try:
            yield
        finally:
            self.fault = None

    def _heard(self, event: str, given: tuple[Any, ...]) -> None:
        if self.fault is None or event != "open" or not isinstance(given[2], int) or not given[2] & WRITING:
            return
        if isinstance(given[0], str | bytes) and os.fsdecode(given[0]).startswith(self.folder):
            self.left -= 1
            if self.left <= 0:
                self.fault(os.fsdecode(given[0]))


def full(path: str) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), path)


def no_memory(path: str) -> None:
    raise MemoryError


def signalled(number: int) -> Callable[[str], None]:
    def fault(path: str) -> None:
        if FAULTS is not None:
            FAULTS.fault = None  # one is enough
        os.kill(os.getpid(), number)

    return fault


FAULTS: Faults | None = None


@dataclass(frozen=True)
class Failure:
    """A way in which a sequence fails: what is spoilt in its folder, or happens at a write, and how the verb ends."""

    name: str
    code: int
    spoil: Callable[[Path], None] = lambda folder: None
    fault: Callable[[str], None] | None = None
    options: tuple[str, ...] = ()


def _broken(folder: Path) -> None:
    for image in sorted((folder / "frames").iterdir()):
        image.write_bytes(image.read_bytes()[:60])


def _one_broken(folder: Path) -> None:
    image = max((folder / "frames").iterdir())
    image.write_bytes(image.read_bytes()[:60])


def _no_calibration(folder: Path) -> None:
    camera = folder / "camera.json"
    camera.write_text(camera.read_text(encoding="utf-8").replace(str(CAMERA.cy), "NaN"), encoding="utf-8")


def _no_map(folder: Path) -> None:
    shutil.rmtree(folder / "slam")


def _cut_map(folder: Path) -> None:
    for file in (folder / "slam").rglob("*"):
        if file.is_file():
            file.write_bytes(file.read_bytes()[:40])


FAILURES = (
    Failure("a broken frame", 4, _one_broken),
    Failure("a full disk", 5, fault=full),
    Failure("an interrupt", 130, fault=signalled(signal.SIGINT)),
    Failure("no calibration", 3, _no_calibration),
    Failure("no map", 3, _no_map),
    Failure("no memory", 5, fault=no_memory),
    Failure("a wrong option", 2, options=("--voxle", "3")),
    Failure("the scheduler's end", 143, fault=signalled(signal.SIGTERM)),
    Failure("a map that is cut off", 3, _cut_map),
    Failure("frames that are all broken", 3, _broken),
)


def called(argv: Sequence[str]) -> int:
    """The exit code of a command line."""
    try:
        return lightdepth(list(argv))
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else 1


def _densify(data: Path, out: Path) -> int:
    return called(["densify", str(data), "--map", str(data / "slam"), *UNJUDGED, "-o", str(out)])


def _densify_judged(data: Path, out: Path) -> int:
    return called(["densify", str(data), "--map", str(data / "slam"), *DECLINE, "-o", str(out)])


def _densify_and_evaluate(data: Path, out: Path) -> int:
    map_ = ["--map", str(data / "slam"), "--judge.no-on", "--no-fit-light"]
    code = called(["densify", str(data), *map_, "-o", str(out / "dense")])
    return code or called(["evaluate", str(out / "dense"), "--truth", str(data), "-o", str(out / "judged")])


def _live(data: Path, out: Path) -> int:
    return called(["live", str(data), "--map", str(data / "slam"), *UNJUDGED, "-o", str(out)])


def _predict(data: Path, out: Path) -> int:
    return called(["predict", str(data), "-o", str(out)])


def _predict_decline(data: Path, out: Path) -> int:
    return called(["predict", str(data), *DECLINE, "-o", str(out)])


def _predict_by_function(data: Path, out: Path) -> int:
    by_options(predict)(data=data, output=out, checkpoint="decline")
    with contextlib.suppress(InputError):  # it is there
        by_options(predict)(data=data, output=out, checkpoint="decline")
    return 0


def _by_library(data: Path, out: Path) -> int:
    frames, model = open_sequence(data), load_model("decline", details=False)
    config = DensifyConfig(judge=JudgeConfig(on=False))
    for submap in read_map(data / "slam").submaps:
        densify_submap(submap, frames, model, config).dense.write(out / f"{submap.id}", ("ply",))
    return 0


def _measure(data: Path, out: Path) -> int:
    argv = [
        "densify",
        str(data),
        "--map",
        str(data / "slam"),
        *UNJUDGED,
        "-o",
        str(out / "dense"),
        "--mm-per-unit",
        "2",
    ]
    code = called(argv)
    return code or called(["export", str(out / "dense"), "--to", "obj", "-o", str(out / "mesh")])


WORKS = (
    *(_densify, _predict, _live, _densify_and_evaluate, _predict_decline, _by_library, _densify_judged),
    *(_predict_by_function, _measure),
)


def one_sequence(number: int, every: int, bases: Sequence[Path], here: Path) -> str:
    """Works on one sequence; what went otherwise than it is to go, or ""."""
    data, out = here / f"sequence_{number:04d}", here / "out" / f"result_{number:04d}"
    shutil.copytree(bases[number % len(bases)], data)
    write_camera(replace(CAMERA, fx=CAMERA.fx + 0.001 * number), data / "camera.json")  # no two share their tables
    turn = number // every
    failure = FAILURES[turn % len(FAILURES)] if number % every == every - 1 else None
    wrong = ""
    if failure is None:
        work = WORKS[number % every]
        code = work(data, out)
        wrong = f"{work.__name__} ends with {code}" if code else ""
    else:
        failure.spoil(data)
        assert FAULTS is not None
        verb = "live" if turn // len(FAILURES) % 2 else "densify"
        argv = [verb, str(data), "--map", str(data / "slam"), *UNJUDGED, *failure.options, "-o", str(out)]
        with FAULTS.at(2 + turn % 4, out.parent, failure.fault):
            code = called(argv)
        if code != failure.code:
            wrong = f"{verb} with {failure.name} ends with {code}, not {failure.code}"
        elif failure.fault is not None and verb == "densify":
            code = called([*argv, "--resume"])
            wrong = f"{verb} --resume after {failure.name} ends with {code}" if code else ""
    shutil.rmtree(out, ignore_errors=True)
    shutil.rmtree(data)
    left = [path.name for path in sorted((here / "out").iterdir())] + sorted({p.name for p in here.iterdir()} - {"out"})
    for path in (here / "out").iterdir():
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    return wrong or (f"left behind: {', '.join(left)}" if left else "")


def one_after_the_other(
    count: int, home: Path, every: int, noise_kb: float, objects: float
) -> tuple[list[Row], list[str]]:
    """Many sequences, of which the last of `every` fails: the rows, and what went wrong."""
    global FAULTS
    FAULTS = FAULTS or Faults()
    bases = []
    for seed in range(3):
        frames = render_sequence(seed, 4, CAMERA, 4.0, SMALL).frames
        bases.append(home / f"base_{seed}")
        write_synthetic(frames, slam(frames, maps=1 + seed % 2), bases[-1])
    here, temporary = home / "work", Path(tempfile.gettempdir())
    (here / "out").mkdir(parents=True)
    at, states, wrong = [], [], []
    for number in range(count):
        if found := one_sequence(number, every, bases, here):
            wrong.append(f"sequence {number}: {found}")
        if (number + 1) % every == 0:
            at.append(number + 1)
            states.append(State.now(temporary))
    start = len(states) // 4
    settings = changed(states[start], states[-1])
    wrong += [f"the process has another {name} than before" for name in settings]
    return [
        last_three_quarters("sequences: memory, kB", at, [s.memory_kb for s in states], noise_kb),
        last_three_quarters("sequences: objects", at, [s.objects for s in states], objects * (at[-1] - at[start])),
        *counted("sequences", at, states),
        Row("sequences: settings that changed", 0, 0, len(settings), 0),
    ], wrong


def soaked(
    keyframes: int,
    sequences: int,
    every: int = EVERY,
    samples: int = 20,
    noise_kb: float = 8192,
    objects: float = 2,
) -> tuple[list[Row], list[str]]:
    """Both parts, in a folder that is gone afterwards: the table, and what went wrong. The state of the process is
    noted at `samples` keyframes, and when `every` sequences are done; `noise_kb` is the memory that all sequences
    together may seem to leave, `objects` how many each may."""
    with tempfile.TemporaryDirectory(prefix="soak-") as place:
        home = Path(place)
        (home / "temporary").mkdir()
        with mock.patch.object(tempfile, "tempdir", str(home / "temporary")), quiet(), frozen():
            rows = played_live(keyframes, home / "live", samples) if keyframes else []
            more, wrong = one_after_the_other(sequences, home, every, noise_kb, objects) if sequences else ([], [])
    return [*rows, *more], wrong


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """What verbs say goes nowhere."""
    with (
        open(os.devnull, "w", encoding="utf-8") as nowhere,
        contextlib.redirect_stdout(nowhere),
        contextlib.redirect_stderr(nowhere),
    ):
        yield


@contextlib.contextmanager
def frozen() -> Iterator[None]:
    """What is there now is no garbage, and is not counted: looking through it takes most of a second."""
    gc.collect()
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()


def main() -> int:
    parse = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parse.add_argument("--keyframes", type=int, default=2000, help="to play live; 0 plays none")
    parse.add_argument("--sequences", type=int, default=200, help="one after the other; 0 for none")
    asked = parse.parse_args()
    torch.set_num_threads(1)
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background ignores it
    began, processor = time.monotonic(), time.process_time()
    rows, wrong = soaked(asked.keyframes, asked.sequences)
    print(HEADER)
    for row in rows:
        print(row)
    for found in wrong:
        print(found)
    taken = f"{time.monotonic() - began:.0f} s, {time.process_time() - processor:.0f} s of processor time"
    failed = bool(wrong) or not all(row.flat for row in rows)
    print(f"{'it grows, or went wrong' if failed else 'flat'}; {taken}")
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
