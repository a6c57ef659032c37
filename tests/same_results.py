"""Whether two revisions make the same: every verb on the same input, byte for byte.

    python tests/same_results.py BASE [HEAD] [--only demo,predict] [--tolerance 1e-6] [--cache DIR] [--again] [--plant]

BASE and HEAD are revisions, or `.` for the working tree (HEAD when it is left out). Each is run from its own checkout,
through its own command line, each item on one core, and what it made is kept in the cache under the hash of its code: a
commit that touches tests or pages alone is not run again. Times, dates, versions and revisions are left out; so are the
options that a run was given (they may have been renamed), and the words of pages, which show times. Everything else has
to be the same bytes; where the bytes differ, the largest relative difference of the numbers is printed, and counts
against --tolerance. Exit code 1 when anything differs.

Two checks of this check: `--again` makes HEAD's results anew beside those in the cache, so that a revision can be held
against itself; `--plant` holds BASE against itself with one setting of each item off by 1 %, and fails where that goes
unnoticed (HEAD is then not looked at: what differs in it would pass for the plant).
"""

from __future__ import annotations

import argparse
import base64
import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
REALDATA = Path(os.environ.get("LIGHTDEPTH_REALDATA") or ROOT.parent / "shared" / "realdata")
CLIP = REALDATA / "sinus/example_training_data_root/bag_1/_start_004259_end_004629_stride_25_segment_13"
SINUS_MAP = REALDATA / "sinus" / "derived_colmap" / "sparse_txt" / "0"
CODE = ("lightdepth", "densify", "train", "configs", "pyproject.toml")
"""What a run depends on, as far as it lies in the repository."""
SMALL = ["--size", "[160, 128]"]

CORES: SimpleQueue[str] = SimpleQueue()
"""Those that are free, of the two that are used; "" where a process cannot be bound to one."""
_cores = [str(core) for core in sorted(os.sched_getaffinity(0))[:2]] if hasattr(os, "sched_getaffinity") else ["", ""]
for _core in (_cores * 2)[:2]:
    CORES.put(_core)

RUN = """
import os, sys, tomllib
from importlib import metadata
tree, core, *argv = sys.argv[1:]
if core:  # before any library counts the cores: on more than one, Open3D writes the same triangles in another order
    os.sched_setaffinity(0, {int(core)})
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
for name, module in list(sys.modules.items()):
    if name.split(".")[0] in ("lightdepth", "densify", "train") and getattr(module, "__file__", None):
        assert module.__file__.startswith(tree + "/"), (name, module.__file__)
assert "lightdepth" in sys.modules
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
        *("adapt", "synth", "-o", "adapt", "--map", "synth/slam", "--steps", "4", "--batch_size", "4"),
        *("--points", "0.5", "--held-out", "0.5", "--keep-worse"),
    ],
    "sparse": ["sparse", "synth", "-o", "sparse"],
    "select": ["select", "synth", "-o", "select/list.txt"],
    "calibrate": ["calibrate-light", "synth", "-o", "calibrate/light.json", "--map", "synth/slam"],
    "convert": ["convert-camera", "synth/camera.json", "-o", "convert/camera.xml"],
    "import": ["import", "synth", "-o", "import", "--every", "2"],
    "evaluate": ["evaluate", "synth/slam", "--truth", "synth", "-o", "evaluate", "--checkpoint", "decline"],
    "evaluate_depth": ["evaluate", "predict", "--truth", "synth", "-o", "evaluate_depth", "--max-depth-mm", "20"],
}
BEFORE = {"evaluate_depth": "predict"}
"""Items that read what another made; the others after `synth` read that."""
FIRST = ("synth", "c3vd", "demo", "bench", "sinus", "sinus_paper")
PLANTED = {
    "c3vd": ["--travel-mm", "30.3"],
    "demo": ["--spurious", "0.303"],
    "bench": ["--bending.slope_deviation", "0.303"],
    "sinus": ["--agreement.overlap", "0.0303"],
    "sinus_paper": ["--fusion.voxels_per_distance", "52.52"],
    "predict_self": ["--light", "off/light.json"],
    "densify": ["--fusion.truncation", "6.06"],
    "live": ["--bending.slope_deviation", "0.303"],
    "train": ["--model.learning_rate", "0.00202"],
    "adapt": ["--learning-rate", "0.000505"],
    "sparse": ["--sfm.peak_threshold", "0.00303"],
    "select": ["--sift.ratio", "0.808"],
    "calibrate": ["--camera", "off/camera.json"],
    "convert": ["--size", "[162, 129]"],
    "import": ["--camera", "off/camera.json"],
    "evaluate": ["--thresholds-mm", "[1.01, 2, 5]"],
    "evaluate_depth": ["--max-depth-mm", "20.2"],
}
"""Settings off by 1 %; items without any are left out of --plant. `synth` and `predict` have none, as others read what
they make and would differ for that alone; c3vd and predict_self are the same verbs."""

LEFT_OUT = {"seconds", "started", "command", "versions", "revision", "peak_memory_mb", "arguments", "timings", "inputs"}
LEFT_OUT |= {"files", "resumed"}
"""Keys of JSON: times, the machine, how the run was asked for, and sizes of files in which those stand."""
PASSED_OVER = ("config.yaml", "log.txt", "timings.csv", "timings.png", "table.csv", "tensorboard", "model.md")
"""Settings and times once more, what table.json has without times, and the card that model.safetensors holds."""
COUNTED = ("sparse",)
"""Sparse maps are the same bytes from run to run. Under a tolerance they are compared by cameras and by
counts of points, to one in twenty: a last bit decides which points a mapping keeps."""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("base")
    parser.add_argument("head", nargs="?", default=".")
    parser.add_argument("--only", default="", help="items, comma between them")
    parser.add_argument("--tolerance", type=float, default=0.0, help="largest relative difference; 0 is the same bytes")
    parser.add_argument("--cache", type=Path, default=Path(tempfile.gettempdir()) / "lightdepth-same")
    parser.add_argument("--again", action="store_true", help="make HEAD's results anew")
    parser.add_argument("--plant", action="store_true", help="BASE against itself, with settings off by 1 %%")
    given = parser.parse_args()
    wanted = [name for name in given.only.split(",") if name] or list(ITEMS)
    if unknown := set(wanted) - set(ITEMS):
        parser.error(f"--only {', '.join(sorted(unknown))}; expected some of {', '.join(ITEMS)}")
    if any(name.startswith("sinus") for name in wanted) and not CLIP.is_dir():
        print(f"sinus and sinus_paper are left out: no real data at {CLIP}")
        wanted = [name for name in wanted if not name.startswith("sinus")]
    if given.plant:
        wanted = [name for name in wanted if name in PLANTED]
    base = made_by(given.base, wanted, given.cache, "made")
    if given.plant:
        head = made_by(given.base, wanted, given.cache, "planted")
    else:
        head = made_by(given.head, wanted, given.cache, "again" if given.again else "made")
    if base == head:
        print("the code is the same in both")
    found = {name: list(compared(base, head, name, given.tolerance)) for name in wanted}
    for name, lines in found.items():
        print("\n".join(lines) or f"{name}: the same", flush=True)
    if given.plant:
        unseen = [name for name, lines in found.items() if not lines]
        print(f"PLANTED CHANGE NOT FOUND: {', '.join(unseen)}" if unseen else "every planted change was found")
        return 1 if unseen else 0
    differing = [name for name, lines in found.items() if lines]
    print(f"DIFFERENT: {', '.join(differing)}" if differing else f"the same: {', '.join(wanted)}")
    return 1 if differing else 0


def made_by(revision: str, wanted: list[str], cache: Path, kind: str) -> Path:
    """The folder with what a revision made of all wanted items; what is in the cache is not made again, but `again`."""
    commit = _working_tree() if revision == "." else _git("rev-parse", "--verify", f"{revision}^{{tree}}")
    key = hashlib.sha256(_git("ls-tree", commit, *CODE).encode()).hexdigest()[:12]
    tree, folder = cache.resolve() / key / "tree", cache.resolve() / key / kind
    if not tree.is_dir():
        cache.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=cache) as made:  # renamed when it is whole
            archive = subprocess.run(["git", "archive", commit, *CODE], cwd=ROOT, capture_output=True, check=True)
            subprocess.run(["tar", "-x", "-C", made], input=archive.stdout, check=True)
            tree.parent.mkdir(exist_ok=True)
            shutil.copytree(made, tree)
    if kind == "again":
        shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "train.yaml").write_text(TRAIN)
    needed = [name for name in wanted if name not in FIRST]
    first = [name for name in FIRST if name in wanted or (name == "synth" and needed)]
    then = [name for name in ITEMS if name in {*needed, *(BEFORE[n] for n in needed if n in BEFORE)}]
    last = [name for name in then if name in BEFORE]
    with ThreadPoolExecutor(2) as pool:
        for wave in (first, [name for name in then if name not in last], last):
            if kind == "planted" and wave is not first and needed:
                _put_off(folder / "synth", folder / "off")
            for name, said in zip(wave, pool.map(lambda n: _make(n, tree, folder), wave), strict=True):
                print(f"{revision} ({key}/{kind}): {name}: {said}", flush=True)
    return folder


def _working_tree() -> str:
    """The code as it lies there, as a tree of git's; what is staged stays as it is."""
    with tempfile.TemporaryDirectory() as folder:
        index = {"GIT_INDEX_FILE": str(Path(folder) / "index")}
        _git("read-tree", "HEAD", **index)
        _git("add", "--all", "--", *CODE, **index)
        return _git("write-tree", **index)


def _git(*argv: str, **env: str) -> str:
    call = subprocess.run(["git", *argv], cwd=ROOT, env={**os.environ, **env}, capture_output=True, text=True)
    return call.stdout.strip() if not call.returncode else sys.exit(f"git {' '.join(argv)}: {call.stderr.strip()}")


def _make(name: str, tree: Path, folder: Path) -> str:
    argv = ITEMS[name] + (PLANTED.get(name, []) if folder.name == "planted" else [])
    if argv[0] == "synth" and (tree / "lightdepth" / "tube" / "tracked.py").exists():  # before it there was one kind
        argv = [*argv, "--slam.kind", "independent"]
    # What decides whether the cache's are still the ones wanted.
    done, record = folder / f"{name}.done", {"argv": argv, "train": TRAIN if name == "train" else "", "run": RUN}
    if done.is_file() and json.loads(done.read_text()).items() >= record.items():
        return "in the cache"
    shutil.rmtree(folder / name, ignore_errors=True)
    for output in (folder / name, folder / f"{name}.log"):
        output.parent.mkdir(exist_ok=True)
    threads = {f"{library}_NUM_THREADS": "1" for library in ("OMP", "MKL", "OPENBLAS")}
    # Numba with two: `live` fuses views on a second thread where there are two.
    threads |= {"NUMBA_NUM_THREADS": "2", "CUDA_VISIBLE_DEVICES": ""}
    # PYTHONPATH is for processes that a run starts.
    env = {**os.environ, **threads, "PYTHONPATH": str(tree), "PYTHONHASHSEED": "0"}
    start, core = time.perf_counter(), CORES.get()
    call = [sys.executable, "-c", RUN, str(tree), core, *argv]
    with (folder / f"{name}.log").open("w") as log:
        code = subprocess.run(call, cwd=folder, env=env, stdout=log, stderr=subprocess.STDOUT).returncode
    CORES.put(core)
    if code not in (0, 4):
        sys.exit(f"{tree}: {name} ended with {code}:\n{(folder / f'{name}.log').read_text()[-3000:]}")
    done.write_text(json.dumps({**record, "code": code}))
    return f"{time.perf_counter() - start:.0f} s"


def _put_off(synth: Path, folder: Path) -> None:
    """The light with its gamma, and the camera with its focal length, off by 1 %."""
    folder.mkdir(exist_ok=True)
    light, camera = (json.loads((synth / name).read_text()) for name in ("light.json", "camera.json"))
    light["gamma"] *= 1.01
    camera["params"][0] *= 1.01
    (folder / "light.json").write_text(json.dumps(light))
    (folder / "camera.json").write_text(json.dumps(camera))


def compared(base: Path, head: Path, name: str, tolerance: float) -> Iterator[str]:
    """A line for each thing that differs."""
    codes = [json.loads((folder / f"{name}.done").read_text())["code"] for folder in (base, head)]
    if codes[0] != codes[1]:
        yield f"{name}: exit code {codes[0]} became {codes[1]}"
    counted = name in COUNTED and tolerance
    yield from (f"{name}/{line}" for line in differences(base / name, head / name, tolerance, not counted))
    if counted:
        yield from _counted(base / name, head / name, name)


def differences(base: Path, head: Path, tolerance: float = 0.0, contents: bool = True) -> Iterator[str]:
    """A line for each file of two results that only one has, or whose contents differ."""
    before, after = files(base), files(head)
    for only, where in ((before - after, "BASE"), (after - before, "HEAD")):
        yield from (f"{path}: only in {where}" for path in sorted(map(str, only)))
    for path in sorted(before & after) if contents else ():
        said = difference(base / path, head / path, tolerance)
        if said:
            yield f"{path}: {said if len(said) < 300 else f'{said[:140]} ... {said[-140:]}'}"


def files(folder: Path) -> set[Path]:
    files = (path for path in folder.rglob("*") if path.is_file())
    return {
        path.relative_to(folder)
        for path in files
        if not any(str(path).endswith(ending) or ending in path.parts for ending in PASSED_OVER)
    }


def _pictures(page: Path) -> list[str]:
    """The pictures and scenes within a page, but for the picture of the time that everything took."""
    times = page.with_name("timings.png")
    passed_over = base64.b64encode(times.read_bytes()).decode() if times.is_file() else ""
    text = page.read_text()
    found = re.findall(r"data:image/[^\"']+", text) + re.findall(
        r'<script type="application/json">(.*?)</script>', text
    )
    return [picture for picture in found if not passed_over or not picture.endswith(passed_over)]


def difference(base: Path, head: Path, tolerance: float) -> str:
    """What differs between two files of one kind; empty where nothing does."""
    if base.read_bytes() == head.read_bytes():
        return ""
    if base.suffix == ".json":
        return _of_json(json.loads(base.read_text()), json.loads(head.read_text()), tolerance)
    if base.suffix == ".html":
        pictures = [_pictures(path) for path in (base, head)]
        return "" if pictures[0] == pictures[1] else "the pictures differ"
    try:
        one, other = _numbers(base), _numbers(head)
    except ValueError:
        return "the bytes differ"
    if [a.shape for a in one] != [a.shape for a in other]:
        return f"{[a.shape for a in one]} became {[a.shape for a in other]}"
    largest = max((_relative(a, b) for a, b in zip(one, other, strict=True)), default=0.0)
    if base.suffix in (".npz", ".safetensors", ".ckpt") and not largest:
        return ""  # the same arrays: the bytes around them hold names of versions
    return "" if 0 < largest <= tolerance else f"the bytes differ; largest relative difference {largest:.3g}"


def _numbers(path: Path) -> list[np.ndarray]:
    """All the numbers of a file, array by array. Raises ValueError for a kind that has none."""
    if path.suffix == ".npz":
        with np.load(path) as data:
            return [data[key] for key in sorted(data.files) if data[key].dtype.kind in "fiub"]
    if path.suffix == ".safetensors":
        from safetensors.numpy import load_file

        return [array for _, array in sorted(load_file(path).items())]
    if path.suffix == ".ckpt":  # the weights in float32; model.safetensors has them in float16
        import torch

        state = torch.load(path, map_location="cpu", weights_only=True)["state_dict"]
        return [state[key].numpy() for key in sorted(state)]
    if path.suffix == ".ply":
        return _of_ply(path)
    if path.suffix in (".csv", ".tum", ".txt"):
        words = path.read_text().replace(",", " ").split()
        return [np.array([float(word) for word in words if _is_number(word)])]
    raise ValueError(path)


def _of_ply(path: Path) -> list[np.ndarray]:
    """Each property of the vertices, and the triangles, of a binary PLY as ours are."""
    head, _, body = path.read_bytes().partition(b"end_header\n")
    kinds = {"float": "<f4", "double": "<f8", "int": "<i4", "uint": "<u4", "uchar": "u1"}
    elements: dict[str, tuple[int, list[tuple[str, str]]]] = {}
    for word, *words in (line.split() for line in head.decode().splitlines() if line):
        if word == "element":
            elements[words[0]] = (int(words[1]), [])
        elif word == "property" and words[0] == "list":  # triangles, so each list is of three
            list(elements.values())[-1][1].extend(
                ("count", kinds[words[1]]) if not i else (f"corner{i}", kinds[words[2]]) for i in range(4)
            )
        elif word == "property":
            list(elements.values())[-1][1].append((words[1], kinds[words[0]]))
    arrays = []
    for count, properties in elements.values():
        made = np.frombuffer(body, np.dtype(properties), count)
        body = body[made.nbytes :]
        arrays += [made[name] for name, _ in properties]
    return arrays


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


def _of_json(one: Any, other: Any, tolerance: float) -> str:
    """The place where two records differ most, and in how many they do."""
    found = sorted(_places(one, other, tolerance, ""), key=lambda place: -place[0])
    more = f"; {len(found) - 1} more places differ by no more" if found[1:] else ""
    return found[0][1] + more if found else ""


def _places(one: Any, other: Any, tolerance: float, where: str) -> Iterator[tuple[float, str]]:
    """Relative difference (infinite for what is no number) and a sentence for each place where two records differ."""
    if isinstance(one, dict) and isinstance(other, dict):
        for key in {**one, **other}:
            if key in LEFT_OUT:
                continue
            if (key in one) != (key in other):
                yield np.inf, f"{where}{key}: only in {'BASE' if key in one else 'HEAD'}"
            else:
                yield from _places(one[key], other[key], tolerance, f"{where}{key}.")
    elif isinstance(one, list) and isinstance(other, list) and len(one) == len(other):
        for i, (a, b) in enumerate(zip(one, other, strict=True)):
            yield from _places(a, b, tolerance, f"{where}{i}.")
    elif isinstance(one, float) and isinstance(other, float):
        off = _relative(np.array([one]), np.array([other]))
        if off > tolerance:
            yield off, f"{where.rstrip('.')}: {one} became {other} ({off:.2g})"
    elif one != other:
        yield np.inf, f"{where.rstrip('.')}: {one} became {other}"


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
