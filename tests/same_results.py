"""Whether two revisions make the same: every verb on the same input, byte for byte.

    python tests/same_results.py BASE [HEAD] [--only demo,predict] [--tolerance 1e-6] [--cache DIR] [--plant]

BASE and HEAD are revisions, or `.` for the working tree (HEAD when it is left out). Each is run from its own checkout,
through its own command line, on one thread, and what it made is kept in the cache by revision. Times, dates, versions
and revisions are left out; so are the options that a run was given (they may have been renamed), and pages, which show
times. Everything else has to be the same bytes; where the bytes differ, the largest relative difference of the numbers
is printed, and counts against --tolerance. Exit code 1 when anything differs.

`--plant` gives HEAD one setting that is off by 1 % and expects a difference: a check of this check.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
REALDATA = Path(os.environ.get("LIGHTDEPTH_REALDATA") or ROOT.parent / "shared" / "realdata")
CLIP = REALDATA / "sinus/example_training_data_root/bag_1/_start_004259_end_004629_stride_25_segment_13"
SINUS_MAP = REALDATA / "sinus" / "derived_colmap" / "sparse_txt" / "0"
SMALL = ["--size", "[160, 128]"]

RUN = """
import sys, tomllib
from importlib import metadata
tree, *argv = sys.argv[1:]
sys.path.insert(0, tree)
verbs = tomllib.load(open(tree + "/pyproject.toml", "rb"))["project"]["entry-points"]["lightdepth.commands"]
found = metadata.EntryPoints(metadata.EntryPoint(n, v, "lightdepth.commands") for n, v in verbs.items())
others = metadata.entry_points
# Those of the checkout, whatever is installed.
metadata.entry_points = lambda **of: found if of.get("group") == "lightdepth.commands" else others(**of)
import torch
torch.set_num_threads(1)
from lightdepth.cli import main
sys.argv = ["lightdepth", *argv]
code = main(argv)
for name in ("lightdepth", "densify", "train"):
    module = sys.modules.get(name)
    assert module is None or module.__file__.startswith(tree + "/"), (name, module.__file__)
sys.exit(code)
"""

TRAIN = """
data: {sequences: [synth], size: [80, 64], batch_size: 2, tube: {scenes: 0, val_scenes: 0}}
trainer: {max_steps: 10, accelerator: cpu, log_every_n_steps: 5}
"""

ITEMS: dict[str, list[str]] = {
    "synth": ["synth", "-o", "synth", "--frames", "16", *SMALL, "--seed", "3", "--lens", "fisheye"],
    "c3vd": ["synth", "-o", "c3vd", "--frames", "12", *SMALL, "--layout", "c3vd", "--family", "realistic"],
    "demo": ["demo", "-o", "demo", "--frames", "16", *SMALL],
    "bench": ["bench", "-o", "bench", "--checkpoints", "[decline]", "--image-size", "[96, 80]"],
    "sinus": ["densify", str(CLIP), "-o", "sinus", "--map", str(SINUS_MAP)],
    "sinus_paper": ["densify", str(CLIP), "-o", "sinus_paper", "--map", str(SINUS_MAP), "--recipe", "paper"],
    # What follows reads what synth made.
    "predict": ["predict", "synth", "-o", "predict", "--checkpoint", "lightdepth-synthetic"],
    "predict_self": ["predict", "synth", "-o", "predict_self", "--checkpoint", "lightdepth-self", "--refine", "2"],
    "densify": ["densify", "synth", "-o", "densify", "--map", "synth/slam", "--mm-per-unit", "1.5"],
    "live": ["live", "synth", "-o", "live", "--map", "synth/slam", "--checkpoint", "decline"],
    "train": ["train", "--config", "train.yaml", "-o", "train"],
    "adapt": [
        "adapt",
        "synth",
        "-o",
        "adapt",
        "--map",
        "synth/slam",
        "--steps",
        "4",
        "--anchor",
        "1",
        "--keep-worse",
    ],
    "sparse": ["sparse", "synth", "-o", "sparse"],
    "select": ["select", "synth", "-o", "select/list.txt"],
    "calibrate": ["calibrate-light", "synth", "-o", "calibrate/light.json", "--map", "synth/slam"],
    "convert": ["convert-camera", "synth/camera.json", "-o", "convert/camera.xml"],
    "import": ["import", "synth", "-o", "import", "--every", "2"],
    "evaluate": ["evaluate", "synth/slam", "--truth", "synth", "-o", "evaluate", "--checkpoint", "decline"],
    "evaluate_depth": ["evaluate", "predict", "--truth", "synth", "-o", "evaluate_depth"],
}
BEFORE = {"evaluate_depth": "predict"}
"""Items that read what another made; the others after `synth` read that."""
FIRST = ("synth", "c3vd", "demo", "bench", "sinus", "sinus_paper")
PLANTED = {"demo": None, "densify": ["--fusion.far", "2.02"], "live": ["--fusion.far", "2.02"]}
"""Settings off by 1 %; items without any are left out of --plant."""

LEFT_OUT = {"seconds", "started", "command", "versions", "revision", "peak_memory_mb", "arguments", "timings", "inputs"}
"""Keys of JSON: times, the machine, and how the run was asked for."""
PASSED_OVER = ("config.yaml", "log.txt", "timings.csv", "timings.png", ".html", "tensorboard", ".ckpt", "model.md")
UNORDERED = ("sinus_paper",)
"""Open3D gives the vertices of its volume in another order from run to run: they are compared in an order of ours."""
COUNTED_ONLY = ("sparse",)
"""pycolmap's mapping is not the same from run to run: cameras are compared, and counts of points to one in twenty."""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("base")
    parser.add_argument("head", nargs="?", default=".")
    parser.add_argument("--only", default="", help="items, comma between them")
    parser.add_argument("--tolerance", type=float, default=0.0, help="largest relative difference; 0 is the same bytes")
    parser.add_argument("--cache", type=Path, default=Path(tempfile.gettempdir()) / "lightdepth-same")
    parser.add_argument("--plant", action="store_true", help="give HEAD a setting off by 1 %%, and expect a difference")
    given = parser.parse_args()
    wanted = [name for name in given.only.split(",") if name] or list(ITEMS)
    wanted = [name for name in wanted if not name.startswith("sinus") or _there(CLIP)]
    if given.plant:
        wanted = [name for name in wanted if PLANTED.get(name)]
    base = made_by(given.base, wanted, given.cache)
    head = made_by(given.head, wanted, given.cache, given.plant)
    differences = [line for name in wanted for line in compared(base, head, name, given.tolerance)]
    print("\n".join(differences) or f"the same: {', '.join(wanted)}")
    if given.plant:
        print("planted change found" if differences else "PLANTED CHANGE NOT FOUND")
        return 0 if differences else 1
    return 1 if differences else 0


def _there(folder: Path) -> bool:
    if not folder.is_dir():
        print(f"left out, no real data at {folder}")
    return folder.is_dir()


def made_by(revision: str, wanted: list[str], cache: Path, plant: bool = False) -> Path:
    """The folder with what a revision made of all wanted items; what is in the cache is not made again."""
    if revision == ".":
        tree, folder = ROOT, cache / "working-tree"
        shutil.rmtree(folder, ignore_errors=True)
    else:
        call = ["git", "rev-parse", "--verify", f"{revision}^{{commit}}"]
        commit = subprocess.run(call, cwd=ROOT, capture_output=True, text=True, check=True).stdout.strip()
        tree, folder = cache / commit / "tree", cache / commit / ("planted" if plant else "made")
        if not tree.is_dir():
            tree.mkdir(parents=True)
            archive = subprocess.run(["git", "archive", commit], cwd=ROOT, capture_output=True, check=True).stdout
            subprocess.run(["tar", "-x", "-C", str(tree)], input=archive, check=True)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "train.yaml").write_text(TRAIN)
    needed = [name for name in wanted if name not in FIRST]
    first = [name for name in FIRST if name in wanted or (name == "synth" and needed)]
    then = [name for name in ITEMS if name in {*needed, *(BEFORE[n] for n in needed if n in BEFORE)}]
    last = [name for name in then if name in BEFORE]
    with ThreadPoolExecutor(2) as pool:  # the machine has two cores
        for wave in (first, [name for name in then if name not in last], last):
            for name, said in zip(wave, pool.map(lambda n: _make(n, tree, folder, plant), wave), strict=True):
                print(f"{revision}: {name}: {said}", flush=True)
    return folder


def _make(name: str, tree: Path, folder: Path, plant: bool) -> str:
    done = folder / f"{name}.done"
    if done.is_file():
        return "in the cache"
    shutil.rmtree(folder / name, ignore_errors=True)
    (folder / name).parent.mkdir(exist_ok=True)
    argv = ITEMS[name] + ((PLANTED.get(name) or []) if plant else [])
    threads = {f"{library}_NUM_THREADS": "1" for library in ("OMP", "MKL", "OPENBLAS", "NUMBA")}
    env = {**os.environ, **threads, "PYTHONPATH": "", "PYTHONHASHSEED": "0"}
    call = [sys.executable, "-c", RUN, str(tree), *argv]
    result = subprocess.run(call, cwd=folder, env=env, capture_output=True, text=True)
    if result.returncode not in (0, 4):
        sys.exit(f"{tree}: {name} ended with {result.returncode}:\n{result.stderr[-3000:]}")
    done.write_text(str(result.returncode))
    return "made"


def compared(base: Path, head: Path, name: str, tolerance: float) -> Iterator[str]:
    """A line for each thing that differs."""
    if (base / f"{name}.done").read_text() != (head / f"{name}.done").read_text():
        yield f"{name}: the exit codes differ"
    before, after = _files(base / name), _files(head / name)
    for only, where in ((before - after, "BASE"), (after - before, "HEAD")):
        yield from (f"{name}/{path}: only in {where}" for path in sorted(map(str, only)))
    if name in COUNTED_ONLY:
        yield from _counted(base / name, head / name, name)
        return
    for path in sorted(before & after):
        said = _difference(base / name / path, head / name / path, tolerance, name in UNORDERED)
        if said:
            yield f"{name}/{path}: {said}"


def _files(folder: Path) -> set[Path]:
    files = (path for path in folder.rglob("*") if path.is_file())
    return {
        path.relative_to(folder)
        for path in files
        if not any(str(path).endswith(ending) or ending in path.parts for ending in PASSED_OVER)
    }


def _difference(base: Path, head: Path, tolerance: float, unordered: bool = False) -> str:
    """What differs between two files of one kind; empty where nothing does."""
    if base.read_bytes() == head.read_bytes():
        return ""
    if base.suffix == ".json":
        return _of_json(json.loads(base.read_text()), json.loads(head.read_text()), tolerance)
    try:
        one, other = _numbers(base), _numbers(head)
    except ValueError:
        return "the bytes differ"
    if unordered and base.suffix == ".ply":
        one, other = (
            [made[0][np.lexsort(made[0].T)]] + [np.array(len(part)) for part in made] for made in (one, other)
        )
    if [a.shape for a in one] != [a.shape for a in other]:
        return f"{[a.shape for a in one]} became {[a.shape for a in other]}"
    largest = max((_relative(a, b) for a, b in zip(one, other, strict=True)), default=0.0)
    if base.suffix in (".npz", ".safetensors") and not largest:
        return ""  # the same arrays: the bytes around them hold names of versions
    if unordered and not largest:
        return ""
    return "" if 0 < largest <= tolerance else f"the bytes differ; largest relative difference {largest:.3g}"


def _numbers(path: Path) -> list[np.ndarray]:
    """All the numbers of a file, array by array. Raises ValueError for a kind that has none."""
    if path.suffix == ".npz":
        with np.load(path) as data:
            return [data[key] for key in sorted(data.files) if data[key].dtype.kind in "fiub"]
    if path.suffix == ".safetensors":
        from safetensors.numpy import load_file

        return [array for _, array in sorted(load_file(path).items())]
    if path.suffix == ".ply":
        import trimesh

        made: Any = trimesh.load(path, process=False)
        faces = [np.asarray(made.faces)] if hasattr(made, "faces") else []
        return [np.asarray(made.vertices), *faces]
    if path.suffix in (".csv", ".tum", ".txt"):
        words = path.read_text().replace(",", " ").split()
        return [np.array([float(word) for word in words if _is_number(word)])]
    raise ValueError(path)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _relative(a: np.ndarray, b: np.ndarray) -> float:
    a, b = a.astype(np.float64), b.astype(np.float64)
    different = ~((a == b) | (np.isnan(a) & np.isnan(b)))
    if not different.any():
        return 0.0
    return float((np.abs(a - b)[different] / np.maximum(np.abs(a), np.abs(b))[different].clip(1e-300)).max())


def _of_json(one: Any, other: Any, tolerance: float, where: str = "") -> str:
    """The first place where two records differ."""
    if isinstance(one, dict) and isinstance(other, dict):
        keys = [key for key in {**one, **other} if key not in LEFT_OUT]
        lost = [key for key in keys if (key in one) != (key in other)]
        if lost:
            return f"{where}{lost[0]}: only in {'BASE' if lost[0] in one else 'HEAD'}"
        return next(filter(None, (_of_json(one[k], other[k], tolerance, f"{where}{k}.") for k in keys)), "")
    if isinstance(one, list) and isinstance(other, list) and len(one) == len(other):
        pairs = enumerate(zip(one, other, strict=True))
        return next(filter(None, (_of_json(a, b, tolerance, f"{where}{i}.") for i, (a, b) in pairs)), "")
    if isinstance(one, float) and isinstance(other, float):
        off = _relative(np.array([one]), np.array([other]))
        return "" if off <= tolerance else f"{where.rstrip('.')}: {one} became {other} ({off:.2g})"
    return "" if one == other else f"{where.rstrip('.')}: {one} became {other}"


def _counted(base: Path, head: Path, name: str) -> Iterator[str]:
    """Sparse maps by the cameras that have a place, and by how many points they hold."""

    def counts(folder: Path) -> tuple[list[int], int]:
        images = sorted(folder.rglob("images.txt"))
        lines = [[line for line in path.read_text().splitlines() if not line.startswith("#")] for path in images]
        points = [path.read_text().splitlines() for path in folder.rglob("points3D.txt")]
        return sorted(len(each) // 2 for each in lines), sum(map(len, points))

    (cameras, points), (others, found) = counts(base), counts(head)
    if cameras != others:
        yield f"{name}: {cameras} cameras became {others}"
    if not 0.95 < found / max(points, 1) < 1.05:
        yield f"{name}: {points} points became {found}"


if __name__ == "__main__":
    sys.exit(main())
