"""Kills every verb at drawn events of the file system, and holds what is left against undisturbed runs.

    python tests/kill_matrix.py [--seed 1] [--events 12] [--only predict,train] [--into runs/kill]

Each verb is killed at `--events` events over its whole run, those around a rename into place always among them, by
SIGKILL and by one of SIGTERM and SIGINT, once where no result is there and once where an older one is replaced. What
has been played is in INTO/SEED.jsonl and is not played again. Exit code 1 when something did not hold.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import signal
import sys
import time
from pathlib import Path

for _library in ("OMP", "MKL", "OPENBLAS", "NUMBA"):  # before any of them is imported: bit for bit on one thread
    os.environ[f"{_library}_NUM_THREADS"] = "1"
if hasattr(os, "sched_setaffinity"):  # Open3D counts cores, and writes the same triangles in another order on more
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})

from killing import Case, Stage, Verb, drawn, run  # noqa: E402 - the threads of libraries come first

ON_MAP = ("--map", "synth/slam", "--checkpoint", "decline")
TWO_MAPS = ("--recipes", "[paper]", "--wrong-shares", "[0.1, 0.3]", "--cases", "[]")
"""Of each scene of a bench: the fewest of which some can be finished and others not."""
VERBS = (
    Verb(
        "synth",
        ("synth", "-o", "out", "--frames", "6", "--size", "[48, 40]", "--slam.keyframe-every", "1"),
        "out",
        ("--seed", "9"),
    ),
    Verb("import", ("import", "synth", "-o", "out", "--every", "2"), "out", ("--every", "3"), resumes=True),
    Verb(
        "calibrate-light",
        ("calibrate-light", "synth", "-o", "out/light.json", *ON_MAP[:2]),
        "out",
        ("--seed", "5"),
    ),
    Verb(
        "convert-camera",
        ("convert-camera", "synth/camera.json", "-o", "out/camera.xml"),
        "out",
        ("--size", "[192, 160]"),
    ),
    Verb("select", ("select", "wide", "-o", "out/list.txt"), "out", ("--sift.ratio", "0.7"), resumes=True),
    Verb(
        "train", ("train", "--config", "train.yaml", "-o", "out"), "out", ("--seed", "5"), resumes=True, in_place=True
    ),
    Verb(
        "adapt",
        (
            *("adapt", "synth", "-o", "out", "--map", "synth/slam", "--steps", "2", "--batch-size", "2"),
            *("--points", "0.5", "--held-out", "0.5", "--keep-worse"),
        ),
        "out",
        ("--seed", "5"),
        resumes=True,
    ),
    Verb(
        "ablate",
        ("ablate", "--config", "ablate.yaml", "-o", "out"),
        "out",
        overwrites=False,
        in_place=True,
    ),
    Verb(
        "predict",
        ("predict", "synth", "-o", "out", "--checkpoint", "decline"),
        "out",
        ("--no-previews",),
        resumes=True,
    ),
    Verb("sparse", ("sparse", "wide", "-o", "out"), "out", ("--sfm.peak-threshold", "0.004"), resumes=True),
    Verb("densify", ("densify", "synth", "-o", "out", *ON_MAP), "out", ("--no-merge",), resumes=True),
    Verb(
        "batch",
        ("batch", "many", "-o", "out", "--map", "slam", "--checkpoint", "decline", "--jobs", "0"),
        "out",
        overwrites=False,
        in_place=True,
    ),
    Verb("live", ("live", "synth", "-o", "out", *ON_MAP), "out", ("--mm-per-unit", "2")),
    Verb("evaluate", ("evaluate", "predict", "--truth", "synth", "-o", "out"), "out", ("--max-depth-mm", "20")),
    Verb(
        "bench",
        ("bench", "-o", "out", "--checkpoints", "[decline]", "--image-size", "[64, 48]", *TWO_MAPS),
        "out",
        ("--first-seed", "7"),
        resumes=True,
    ),
    Verb(
        "scale",
        (
            *("scale", "dense", "-o", "out", "--length.map", "0", "--length.mm", "5"),
            *("--length.ends", "[[1.2, -0.4, 3.1], [1.2, -0.4, 2.6]]", "--light", "gamma=2.2,mu=0"),
        ),
        "out",
        ("--length.mm", "6"),
    ),
    Verb(
        "measure",
        (
            "measure",
            "dense",
            "-o",
            "out/lengths.json",
            "--map",
            "0",
            "--frame",
            "2",
            "--pixels",
            "[[30, 30], [55, 45]]",
        ),
        "out",
        ("--pixels", "[[30, 30], [50, 50]]"),
        again=(),
    ),
    Verb("export", ("export", "dense", "-o", "out", "--to", "ply"), "out", ("--to", "obj")),
    Verb("demo", ("demo", "-o", "out", "--frames", "8", "--size", "[96, 80]"), "out", ("--seed", "9")),
)
QUICK = ("import", "convert-camera", "predict")
"""Those of which `make test` kills a few: a single file, and two folders that are made in parts."""
TRAIN = """data: {sequences: [synth], size: [80, 64], batch_size: 2, tube: {scenes: 0, val_scenes: 0}}
trainer: {max_steps: 6, accelerator: cpu, log_every_n_steps: 2, val_check_interval: 2}
"""
ABLATE = """base: train.yaml
rows: [{name: ours, change: nothing}, {name: smooth, change: more smoothness, settings: {model.loss.smoothness: 1.0}}]
judged: [{name: colons, make: realistic, strength: weak, first: 400, count: 1}]
seeds: [0]
"""
SCENE = ("--seed", "3", "--slam.kind", "independent", "--slam.keyframe-every", "1")
MADE = (
    ("synth", ("synth", "-o", "synth", "--frames", "10", "--size", "[96, 80]", *SCENE)),
    ("wide", ("synth", "-o", "wide", "--frames", "16", "--size", "[160, 128]", *SCENE)),
    ("many/a", ("synth", "-o", "many/a", "--frames", "6", "--size", "[96, 80]", *SCENE)),
    ("many/b", ("synth", "-o", "many/b", "--frames", "7", "--size", "[96, 80]", *SCENE)),
    ("predict", ("predict", "synth", "-o", "predict", "--checkpoint", "decline")),
    ("dense", ("densify", "synth", "-o", "dense", *ON_MAP)),
)


def import_all(quick: bool = False) -> None:
    """What a child would import first, which takes longer than its work. No library gets a thread to work in yet."""
    import importlib

    import torch

    torch.set_num_threads(1)
    modules = [f"lightdepth.commands.{name}" for name in ("import_frames", "predict", "synth")] + ["lightdepth.cli"]
    if not quick:
        modules += [f"train.commands.{name}" for name in ("adapt", "train")]
        modules += [f"densify.commands.{name}" for name in ("batch", "bench", "demo", "densify", "live")]
    for name in modules:
        importlib.import_module(name)
    import PIL.Image
    from matplotlib.backends import backend_agg  # noqa: F401 - the import is what is wanted

    PIL.Image.init()
    if not quick:
        from lightdepth import native

        native.pycolmap()
        native.open3d()


def few_inputs(home: Path) -> Path:
    """As `inputs`, for the quick verbs, without anything that takes time to render."""
    from scenes import cylinder

    from lightdepth.camera import Pinhole
    from lightdepth.datasets import write_folder

    scene = cylinder(Pinhole(48, 40, 26.0, 26.0, 23.0, 21.0))
    write_folder([scene.frame(f"{i:04d}") for i in range(8)], home / "inputs" / "synth")
    return home / "inputs"


def inputs(home: Path) -> Path:
    """The folder of inputs that the verbs find, made once."""
    folder = home / "inputs"
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "train.yaml").write_text(TRAIN, encoding="utf-8")
    (folder / "ablate.yaml").write_text(ABLATE, encoding="utf-8")
    for name, argv in MADE:
        if not (folder / name).exists():
            ended, _ = run(list(argv), folder)
            assert ended.code == 0, ended.said
    return folder


def cases(stage: Stage, verb: Verb, seed: int, count: int) -> list[Case]:
    """The cases of a verb that a seed draws."""
    rng, found = random.Random(f"{seed} {verb.name}"), []
    for over in (False, True) if verb.overwrites else (False,):
        events = stage.events(verb, over)
        for at in drawn(verb, events, count, lambda n: rng.sample(range(n), n)):
            found += [
                Case(verb, at, each, over) for each in (signal.SIGKILL, rng.choice([signal.SIGTERM, signal.SIGINT]))
            ]
    return found


def few_cases(stage: Stage, verb: Verb, seed: int) -> list[Case]:
    """Four: at a rename into place and in a file, with an older result and without, by either kind of signal."""
    rng, found = random.Random(f"{seed} {verb.name}"), []
    soft = rng.choice([signal.SIGTERM, signal.SIGINT])
    for over in (False, True):
        events = stage.events(verb, over)
        renames = [i for i, event in enumerate(events) if event.places(verb.output)] or [len(events) - 1]
        others = [i for i, event in enumerate(events) if event.kind == "opened"]
        in_place = [i for i in others if events[i].paths[0].startswith(f"{verb.output}/")]
        others = in_place or others  # the place of the result is where a file that is not whole would be seen
        for at, number in zip(
            (rng.choice(renames), rng.choice(others)),
            (soft, signal.SIGKILL) if over else (signal.SIGKILL, soft),
            strict=True,
        ):
            found.append(Case(verb, at, number, over))
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--events", type=int, default=12, help="of each verb, for each kind of signal")
    parser.add_argument("--only", default="", help="verbs, comma between them")
    parser.add_argument("--into", type=Path, default=Path("runs/kill"))
    parser.add_argument("--quick", action="store_true", help="four cases of three verbs that take little time")
    given = parser.parse_args()
    only = [*QUICK] if given.quick else [name for name in given.only.split(",") if name]
    if unknown := set(only) - {verb.name for verb in VERBS}:
        parser.error(f"--only {', '.join(sorted(unknown))}; expected some of {', '.join(verb.name for verb in VERBS)}")
    import_all(given.quick)
    stage = Stage(given.into, (few_inputs if given.quick else inputs)(given.into.resolve()))
    notes = given.into / f"{given.seed}.jsonl"
    played = {}
    if notes.is_file():
        rows = (json.loads(line) for line in notes.read_text(encoding="utf-8").splitlines())
        played = {row["case"]: row["wrong"] for row in rows}
    print(f"seed {given.seed}, {given.events} events of each verb; {len(played)} cases are in {notes}", flush=True)
    broken = total = 0
    for verb in VERBS:
        if only and verb.name not in only:
            continue
        start = time.monotonic()
        try:
            todo = few_cases(stage, verb, given.seed) if given.quick else cases(stage, verb, given.seed, given.events)
        except AssertionError as error:
            print(f"{verb.name}: cannot be played: {error}", flush=True)
            broken += 1
            continue
        bad = 0
        for case in todo:
            if case.key not in played:
                try:
                    played[case.key] = stage.play(case)
                except TimeoutError as error:
                    played[case.key] = [str(error)]
                with notes.open("a", encoding="utf-8") as file:
                    file.write(json.dumps({"case": case.key, "wrong": played[case.key]}) + "\n")
            if wrong := played[case.key]:
                bad += 1
                event = stage.events(verb, case.over)[case.at]
                print(f"  {case.key} ({event.kind} {' '.join(event.paths)}):", *wrong, sep="\n    ", flush=True)
        print(f"{verb.name}: {len(todo) - bad} of {len(todo)} hold ({time.monotonic() - start:.0f} s)", flush=True)
        broken, total = broken + bad, total + len(todo)
    print(f"{total - broken} of {total} cases hold")
    return 1 if broken else 0


if __name__ == "__main__":
    sys.exit(main())
