"""From folders to tables: what `lightdepth evaluate` reads, computes and writes.

metrics.json holds everything; metrics.md and metrics.csv hold the rows laid out as in the densification paper (points,
RMS accuracy, median accuracy), with the units and the alignment in the names.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from densify.dense_map import DenseMapFiles, read_dense_map
from densify.evaluation import Similarity, evaluate_depth, evaluate_map, surface_gap, true_cloud
from lightdepth.calibration import read_json
from lightdepth.datasets import FrameSequence
from lightdepth.errors import InputError
from lightdepth.prediction import read_prediction
from lightdepth.report import number
from lightdepth.run import plain
from lightdepth.sparse_map import check_rigid

_NO_DEPTH = ("no true depth", "the true depth is invalid everywhere")


def judge_depth(folder: Path, truth: FrameSequence, max_depth_mm: float = 100.0) -> dict[str, Any]:
    """Depth errors of a predictions folder: per frame and their mean, median-aligned."""
    rows, skipped = {}, {}
    for file in sorted(folder.glob("*.npz")):
        prediction = read_prediction(file)
        frame = truth.by_number(truth_number(prediction.name, truth))
        assert frame is not None
        try:
            rows[prediction.name] = evaluate_depth(prediction, frame, max_depth_mm)
        except InputError as error:
            if not any(reason in str(error) for reason in _NO_DEPTH):
                raise
            skipped[prediction.name] = str(error)
    if not rows:
        raise InputError(f"{truth.source}: no frame has valid true depth; the first: {next(iter(skipped.values()))}")
    mean = {key: float(np.mean([row[key] for row in rows.values()])) for key in next(iter(rows.values()))}
    mask = f"frame mask, 0 < depth < {max_depth_mm:g} mm, prediction valid"
    return {
        "kind": "depth",
        "alignment": "median per frame",
        "mask": mask,
        "mean": mean,
        "frames": rows,
        "skipped": skipped,
    }


def truth_number(name: str, truth: FrameSequence) -> int:
    """The number of the true frame for a prediction. Raises InputError when there is none."""
    from lightdepth.frame import frame_number

    value = frame_number(name)
    if value not in truth.numbers:
        raise InputError(f"{truth.source}: no frame number {value} for {name}; it has {_span(truth.numbers)}")
    return value


def read_run(folder: Path) -> list[DenseMapFiles]:
    """The dense maps of a densify run. Raises InputError when there are none."""
    maps = [read_dense_map(f) for f in sorted(folder.glob("map_*")) if f.is_dir()]
    if not maps:
        raise InputError(f"{folder}: neither map_* folders (a densify run) nor .npz files (predictions)")
    return maps


def judge_maps(maps: Sequence[DenseMapFiles], truth: FrameSequence) -> dict[str, Any]:
    """Errors of every map against truth; a map that cannot be judged says why."""
    frames = [truth[i] for i in range(len(truth))]
    tree = cKDTree(true_cloud(frames))
    poses = {f.number: f.true_world_from_cam for f in frames if f.true_world_from_cam is not None}
    rows: list[dict[str, Any]] = []
    for m in maps:
        known = np.array([n in poses for n in m.numbers])
        clouds = {"sparse": m.sparse, "sparse_inliers": m.sparse[m.sparse_inlier], "dense": m.vertices}
        try:
            if not known.any():
                raise InputError(
                    f"no keyframe has a true pose; truth has {_span(list(poses))}, the map {_span(m.numbers)}"
                )
            true_centers = np.stack([poses[n][:3, 3] for n in m.numbers[known]])
            rows.append({"map": m.id, **evaluate_map(m.map_from_cam[known, :3, 3], true_centers, clouds, tree)})
        except InputError as error:
            rows.append({"map": m.id, "error": str(error)})
    if all("error" in row for row in rows):
        raise InputError(f"no map could be evaluated; map {rows[0]['map']}: {rows[0]['error']}")
    truth_text = f"{len(tree.data)} points, every second pixel of {len(frames)} frames at true poses"
    return {"kind": "surface", "alignment": "Sim(3) of the trajectories, per map", "truth": truth_text, "maps": rows}


def judge_gap(maps: Sequence[DenseMapFiles], join: Path) -> dict[str, Any]:
    """The gap between two maps of a run brought together by a Sim(3) file:
    {"first": 0, "second": 1, "scale": s, "rotation": 3x3 or [axis-angle vector, rad], "translation": [3]}, second = s R
    first + t.
    """
    from scipy.spatial.transform import Rotation

    data = read_json(join)
    try:
        given = np.asarray(data["rotation"], float)
        rotation = Rotation.from_rotvec(given).as_matrix() if given.shape == (3,) else given.reshape(3, 3)
        sim = Similarity(float(data["scale"]), rotation, np.asarray(data["translation"], float).reshape(3))
        first, second = int(data["first"]), int(data["second"])
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{join}: expected first, second, scale, rotation, translation ({error!r})") from error
    if not (np.isfinite(sim.scale) and sim.scale > 0):
        raise InputError(f"{join}: scale {sim.scale}; expected a positive number")
    check_rigid(np.vstack([np.column_stack([sim.rotation, sim.translation]), [0, 0, 0, 1]]), f"{join}: rotation")
    by_id = {m.id: m for m in maps}
    missing = [i for i in (first, second) if i not in by_id]
    if missing:
        raise InputError(f"{join}: map {missing[0]} is not in the run, which has {sorted(by_id)}")
    gap = surface_gap(by_id[first], by_id[second], sim)
    return {"first": first, "second": second, "unit": "share of the distance to the camera", **plain(gap)}


def write_metrics(result: dict[str, Any], folder: Path) -> str:
    """metrics.json, .md and .csv; the text of the table."""
    (folder / "metrics.json").write_text(json.dumps(plain(result), indent=1) + "\n")
    headers, rows = table(result)
    with (folder / "metrics.csv").open("w", newline="") as file:
        csv.writer(file).writerows([headers, *rows])
    cells = [[c if isinstance(c, str) else number(c) for c in row] for row in rows]
    lines = [f"| {' | '.join(row)} |" for row in [headers, ["---"] * len(headers), *cells]]
    text = "\n".join(lines) + "\n"
    (folder / "metrics.md").write_text(text)
    return text


def table(result: dict[str, Any]) -> tuple[list[str], list[list[Any]]]:
    """Headers and rows of a result for people."""
    if result["kind"] == "depth":
        headers = ["frame", *next(iter(result["frames"].values()))]
        rows = [[name, *row.values()] for name, row in result["frames"].items()]
        return headers, [*rows, ["mean", *result["mean"].values()]]
    headers = ["map", "model", "points", "RMS accuracy mm", "median accuracy mm", "RMS ATE mm"]
    rows = []
    for entry in result.get("maps", []):
        if "error" in entry:
            rows.append([str(entry["map"]), entry["error"], None, None, None, None])
            continue
        for key, name in (("sparse", "sparse"), ("sparse_inliers", "sparse inliers"), ("dense", "dense")):
            e = entry[key]
            values = [e["points"], e["rms_mm"], e["median_mm"]] if e else [0, None, None]
            rows.append([str(entry["map"]), name, *values, entry["rms_ate_mm"]])
    if "gap" in result:
        g = result["gap"]
        rows.append(
            [
                f"{g['first']}-{g['second']}",
                f"gap: median {g['median']:.2%}, 90th percentile {g['p90']:.2%}",
                g["rays"],
                None,
                None,
                None,
            ]
        )
    return headers, rows


def _span(numbers: Sequence[int] | np.ndarray) -> str:
    values = sorted(int(n) for n in numbers)
    return f"frames {values[0]} to {values[-1]}" if values else "none"
