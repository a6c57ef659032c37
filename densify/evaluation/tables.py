"""What `lightdepth evaluate` writes: metrics.json, .md, .tex, .csv, cumulative error curves, error-coloured meshes.

Tables 1 and 2 are laid out as the densification paper's: methods and metrics down, sequences across, their mean last.
A table is headers and rows; the first `words` columns are text.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from densify.evaluation.judge import EDGES_MM, ErrorMesh, Evaluation, with_versions
from densify.evaluation.suite import Suite, alone
from lightdepth.reporting.figures import chart, chart_png, mesh_picture, png, side_by_side
from lightdepth.reporting.report import number

MODELS = {"sparse": "Sparse map", "sparse_inliers": "Sparse inliers", "dense": "Dense"}
_METRICS = {
    "abs_rel": "AbsRel",
    "sq_rel_mm": "SqRel mm",
    "rmse_mm": "RMSE mm",
    "mae_mm": "MAE mm",
    "medae_mm": "MedAE mm",
    "rmse_log": "RMSE log",
    "delta1": "δ < 1.25",
    "delta2": "δ < 1.25²",
    "delta3": "δ < 1.25³",
}
_COLOR_MM = 5.0


@dataclass(frozen=True)
class Table:
    """A title that says what it holds and in which unit, headers, and rows of words and numbers; None is a dash."""

    title: str
    headers: Sequence[str]
    rows: Sequence[Sequence[Any]]

    def markdown(self) -> str:
        cells = [self.headers, ["---"] * len(self.headers), *([cell_text(c) for c in row] for row in self.rows)]
        lines = [f"| {' | '.join(str(c).replace('|', '/') for c in row)} |" for row in cells]
        return f"{self.title}\n\n" + "\n".join(lines) + "\n"

    def latex(self) -> str:
        """A tabular with rules as in the paper; a word above its like is not repeated."""
        lines = [
            r"\begin{table}",
            r"    \centering",
            rf"    \begin{{tabular}}{{|{'c|' * len(self.headers)}}}",
            r"        \hline",
            f"        {' & '.join(_tex(h) for h in self.headers)} \\\\",
            r"        \hline",
        ]
        before: str | None = None
        for row in self.rows:
            repeated = row[0] == before and len(self.headers) > 2 and isinstance(row[1], str)
            if not repeated and before is not None and isinstance(row[1], str):
                lines.append(r"        \hline")
            before = row[0]
            cells = [_tex(cell_text(c)) for c in row]
            lines.append(f"        {' & '.join(['' if repeated else cells[0], *cells[1:]])} \\\\")
        title = _tex(self.title)
        lines += [r"        \hline", r"    \end{tabular}", rf"    \caption{{{title}}}", r"\end{table}"]
        return "\n".join(lines) + "\n"


def cell_text(cell: Any) -> str:
    return cell if isinstance(cell, str) else number(cell)


def _tex(text: str) -> str:
    for sign, code in (
        ("\\", r"\textbackslash "),
        ("&", r"\&"),
        ("%", r"\%"),
        ("_", r"\_"),
        ("#", r"\#"),
        ("δ", r"$\delta$"),
        ("<", "$<$"),
        ("²", "$^2$"),
        ("³", "$^3$"),
        ("×", r"$\times$"),
        ("≤", r"$\le$"),
        ("–", "--"),
        ("∞", r"$\infty$"),
        ("→", r"$\to$"),
    ):
        text = text.replace(sign, code)
    return text


# One or several sequences: results by name, columns as a suite has them.

Results = Mapping[str, Mapping[str, Any]]


def trajectory_table(results: Results, suite: Suite | None = None) -> Table:
    """The paper's table 1, with the shares and the other alignments below it, and published rows below those."""
    suite = suite or alone(list(results))
    lines = {
        "# Frames": "frames",
        "# KF": "keyframes",
        "KF time ms": "ms_per_keyframe",
        "RMS ATE mm, Sim(3)": "rms_ate_mm",
        "RMS ATE mm, SE(3)": "rms_ate_se3_mm",
        "ATE mm, CLiMB": "climb_ate_mm",
        "Frames localised %": "localised_share",
        "# Submaps aligned": "submaps_aligned",
        "# Submaps": "submaps",
    }
    rows = [[title, *_row(results, suite.groups, _trajectory_figure(key))] for title, key in lines.items()]
    rows += [[title, *values] for title, values in suite.trajectory.items()]
    title = "Table 1. Trajectory. ATE in mm, each submap after its own alignment."
    return Table(title, _headers(suite.groups, "Metrics"), rows)


def _trajectory_figure(key: str) -> Callable[[Mapping[str, Any]], Any]:
    def figure(result: Mapping[str, Any]) -> Any:
        value = result["trajectory"].get(key)
        return 100 * value if key == "localised_share" and value is not None else value

    return figure


def surface_table(results: Results, suite: Suite | None = None) -> Table:
    """The paper's table 2: model points, RMS and median accuracy; published rows below ours."""
    suite = suite or alone(list(results))
    figures: dict[str, Callable[[Mapping[str, Any]], Any]] = {
        "#MP (×10³)": lambda f: f["points"] / 1000,
        "RMS Acc.": lambda f: f["rms_mm"],
        "MedA Acc.": lambda f: f["median_mm"],
    }
    rows = _model_rows(results, suite, figures)
    rows += [[method, metric, *values] for method, of in suite.surface.items() for metric, values in of.items()]
    title = "Table 2. Maps. Accuracy in mm, each model point to the closest true point."
    return Table(title, _headers(suite.surface_groups, "Method", "Metrics"), rows)


def completeness_table(results: Results, suite: Suite | None = None) -> Table:
    """What the paper's tables leave out: distance to the true mesh, completeness, F-score."""
    suite = suite or alone(list(results))
    figures: dict[str, Callable[[Mapping[str, Any]], Any]] = {}
    for title, name in (("RMS", "rms_mm"), ("Median", "median_mm")):
        figures[f"{title} to true mesh"] = _figure("to_mesh", name)
        figures[f"{title} from truth (completeness)"] = _figure("completeness", name)
    for result in results.values():
        thresholds = [f"{t:g}mm" for t in result["thresholds_mm"]]
    for what, title in (("precision", "Precision"), ("recall", "Recall"), ("f_score", "F-score")):
        for t in thresholds:
            figures[f"{title} {t}"] = _figure(what, t)
    title = "Table 3. Maps. Distances in mm; precision, recall: shares of model and true points within the threshold."
    return Table(title, _headers(suite.surface_groups, "Method", "Metrics"), _model_rows(results, suite, figures))


def _figure(what: str, key: str) -> Callable[[Mapping[str, Any]], Any]:
    return lambda found: found[what] and found[what][key]


def _model_rows(
    results: Results, suite: Suite, figures: Mapping[str, Callable[[Mapping[str, Any]], Any]]
) -> list[list[Any]]:
    rows: list[list[Any]] = []
    for key, name in MODELS.items():
        found = {column: result["all"][key] for column, result in results.items() if result["all"].get(key)}
        if found:
            rows += [[name, title, *_row(found, suite.surface_groups, figure)] for title, figure in figures.items()]
    return rows


def depth_table(results: Results, suite: Suite | None = None) -> Table:
    """Depth errors under every alignment: mean over frames, and over sequences where there are several; published rows
    below."""
    rows: list[list[Any]] = []
    several = len(results) > 1
    for alignment in next(iter(results.values()))["alignment"]:
        scale = {r["predicted_unit"] for r in results.values()} - {"mm"} if alignment == "none" else set()
        label = f"{alignment} ({', '.join(sorted(scale))})" if scale else alignment
        for name, result in results.items():
            rows.append([label, name, *(result["mean"][f"{key}_{alignment}"] for key in _METRICS)])
        if several:
            weights = [result["frames_judged"] for result in results.values()]
            values = [[r["mean"][f"{key}_{alignment}"] for r in results.values()] for key in _METRICS]
            rows.append([label, "mean over sequences", *(float(np.mean(v)) for v in values)])
            rows.append([label, "mean over frames", *(float(np.average(v, weights=weights)) for v in values)])
    for method, published in (suite.depth if suite else {}).items():
        rows.append(["not stated", method, *(published.get(key) for key in _METRICS)])
    return Table("Depth errors. Mean over frames.", ["Alignment", "Sequence", *_METRICS.values()], rows)


def withheld_table(withheld: Sequence[Mapping[str, Any]]) -> Table:
    """The withheld-point error of the maps, without any truth, and the constant distance's."""
    rows = []
    for entry in withheld:
        for name, key in (("this depth", "withheld"), ("constant distance", "withheld_constant")):
            found = entry.get(key)
            if found:  # JSON has no infinity: nothing stands for it
                shares = [float("inf") if found.get(k) is None else found[k] for k in ("median", "p90")]
                where = f"{entry['sequence']}, " if "sequence" in entry else ""
                rows.append([f"{where}map {entry['map']}", name, found["points"], *shares, found["miss"]])
    title = "Withheld points of the sparse map: |surface - point| / point along the ray, no truth needed."
    return Table(title, ["Map", "Depth", "Points", "Median", "90th percentile", "Share that misses"], rows)


def _headers(groups: Sequence[Sequence[str]], *words: str) -> list[str]:
    return [*words, *(name for group in groups for name in [*group, *(["avg"] if len(group) > 1 else [])])]


def _row(results: Results, groups: Sequence[Sequence[str]], figure: Callable[[Mapping[str, Any]], Any]) -> list[Any]:
    """A figure of each sequence, and the mean of each group of several; one that lacks values says how many it has."""
    row: list[Any] = []
    for group in groups:
        values = [figure(results[name]) if name in results else None for name in group]
        row += values
        known = [v for v in values if v is not None]
        if len(group) < 2:
            continue
        if not known:
            row.append(None)
            continue
        mean: Any = float(np.mean(known))
        mean = round(mean) if all(isinstance(v, int) for v in known) else mean
        row.append(mean if len(known) == len(values) else f"{number(mean)} ({len(known)} of {len(values)})")
    return row


# Files


def write_evaluations(
    found: Mapping[str, Evaluation],
    folder: Path,
    withheld: Sequence[Mapping[str, Any]] = (),
    extra: Mapping[str, Any] | None = None,
    suite: Suite | None = None,
) -> str:
    """Everything, into the folder; the text of the tables. One sequence's figures are metrics.json itself, those of
    several are in it by name."""
    results = {name: e.result for name, e in found.items()}
    record = dict(next(iter(results.values()))) if len(results) == 1 else with_versions({"sequences": results})
    record |= {"withheld": list(withheld)} if withheld else {}
    record |= extra or {}
    (folder / "metrics.json").write_text(json.dumps(record, indent=1, allow_nan=False) + "\n")
    depth = {name: r for name, r in results.items() if r["kind"] == "depth"}
    posed = {name: r for name, r in results.items() if "trajectory" in r}
    tables = [depth_table(depth, suite)] if depth else []
    if posed:
        tables.append(trajectory_table(posed, suite))
    if any(r["all"] for r in posed.values()):
        tables += [surface_table(posed, suite), completeness_table(posed, suite)]
    if withheld:
        tables.append(withheld_table(withheld))
    notes = _notes(results, record.get("gap"))
    text = "\n".join([*(t.markdown() for t in tables), *notes])
    (folder / "metrics.md").write_text(text.rstrip() + "\n")
    comments = "".join(f"% {line}\n" for note in notes for line in note.splitlines() if line)
    (folder / "metrics.tex").write_text("\n".join([comments, *(t.latex() for t in tables)]))
    with (folder / "metrics.csv").open("w", newline="") as file:
        csv.writer(file).writerows(long_rows(results))
    for name, evaluation in found.items():
        prefix = f"{name}_" if len(found) > 1 else ""
        if evaluation.curves:
            (folder / f"{prefix}cumulative_error.png").write_bytes(curve_picture(evaluation))
            with (folder / f"{prefix}cumulative_error.csv").open("w", newline="") as file:
                shares = np.stack(list(evaluation.curves.values()), 1)
                rows = [[f"{v:.6g}" for v in (edge, *row)] for edge, row in zip(EDGES_MM, shares, strict=True)]
                csv.writer(file).writerows([["error_mm", *evaluation.curves], *rows])
        for mesh in evaluation.meshes:
            write_error_mesh(mesh, folder / f"{prefix}{mesh.name}_error.ply")
            (folder / f"{prefix}{mesh.name}_error.png").write_bytes(error_picture(mesh))
    return text


def _notes(results: Mapping[str, Mapping[str, Any]], gap: Mapping[str, Any] | None) -> list[str]:
    """Sentences below the tables: what the numbers mean, and which maps have none."""
    notes = []
    first = next(iter(results.values()), {})
    if first.get("kind") == "depth":
        named = "; ".join(f"{name}: {what}" for name, what in first["alignment"].items())
        notes.append(f"Mask: {first['mask']}.\n\nAlignment of each frame: {named}.\n")
    for name, result in results.items():
        if result["kind"] == "depth":
            share, judged = result["mean"]["share_of_image"], result["frames_judged"]
            notes.append(
                f"{name}: {judged} of {result['frames_predicted']} predicted frames judged (the sequence has "
                f"{result['frames_of_truth']}), on {share:.1%} of the image in the mean, "
                f"{result['mean']['share_of_truth']:.1%} of the valid truth; predictions are "
                f"{result['predicted_unit']}.\n"
            )
        else:
            notes.append(f"{name}: truth {result['truth']['cloud']}; true mesh: {result['truth']['mesh'] or 'none'}.\n")
            spacing = result["truth"]["cloud_spacing_mm"]
            if spacing is not None:
                notes.append(f"Neighbouring true points are {number(spacing)} mm apart (median).\n")
            notes += [f"{name}, map {m['map']}: {m['error']}\n" for m in result["maps"] if "error" in m]
            notes += [f"{name}, map {m['map']}: {m['surface_error']}\n" for m in result["maps"] if "surface_error" in m]
            notes.append(f"Alignment: {result['alignment']}. CLiMB: {result['trajectory']['climb_rule']}.\n")
            if result["trajectory"]["localised_share"] is None:
                notes.append(f"Share of frames localised {result['trajectory']['localised_of']}.\n")
    if gap:
        notes.append(
            f"Maps {gap['first']} and {gap['second']}: gap median {gap['median']:.2%}, 90th percentile "
            f"{gap['p90']:.2%} of the distance to the camera, over {gap['rays']} rays.\n"
        )
    return notes


def long_rows(results: Mapping[str, Mapping[str, Any]]) -> list[list[Any]]:
    """Headers and every single figure: sequence, frame or map (or mean, all), model, metric with its unit, value."""
    rows: list[list[Any]] = [["sequence", "part", "model", "metric", "value"]]

    def add(name: str, part: str, model: str, figures: Mapping[str, Any], prefix: str = "") -> None:
        for metric, value in figures.items():
            if isinstance(value, Mapping):
                add(name, part, model, value, f"{prefix}{metric}_")
            elif isinstance(value, (int, float)) and not isinstance(value, bool):
                rows.append([name, part, model, prefix + metric, value])

    for name, result in results.items():
        if result["kind"] == "depth":
            for frame, figures in {**result["frames"], "mean": result["mean"]}.items():
                add(name, frame, "", figures)
            continue
        add(name, "all", "", result["trajectory"])
        for part, models in (("all", result["all"]), *((f"map {m['map']}", m) for m in result["maps"])):
            add(name, part, "", {k: v for k, v in models.items() if k not in MODELS and k != "map"})
            for model in MODELS:
                add(name, part, model, models.get(model) or {})
    return rows


def curve_picture(evaluation: Evaluation) -> bytes:
    """Share of model points (or pixels) within each error, over the error's logarithm."""
    depth = evaluation.result["kind"] == "depth"
    figure, axes = chart((6.4, 3.6))
    for name, share in evaluation.curves.items():
        axes.plot(EDGES_MM, 100 * share, label=name if depth else MODELS[name], linewidth=1.8)
    axes.set_xscale("log")
    axes.set_xlim(EDGES_MM[0], EDGES_MM[-1])
    axes.set_ylim(0, 100)
    axes.set_xticks([0.1, 1, 10, 100], ["0.1", "1", "10", "100"])
    axes.set_xlabel("error of depth [mm]" if depth else "distance to the closest true point [mm]")
    axes.set_ylabel("pixels [%]" if depth else "model points [%]")
    axes.grid(alpha=0.3)
    axes.legend(frameon=False, loc="upper left", title="alignment" if depth else None)
    return chart_png(figure)


def error_colors(distance: np.ndarray) -> np.ndarray:
    """(n, 3) in [0, 1]: from blue (0) over green and yellow to red (5 mm and more)."""
    level = np.rint(255 * (0.08 + 0.87 * np.clip(distance / _COLOR_MM, 0, 1))).astype(np.uint8)
    return cv2.applyColorMap(level.reshape(-1, 1), cv2.COLORMAP_TURBO)[:, 0, ::-1] / 255


def write_error_mesh(mesh: ErrorMesh, path: Path) -> None:
    """A PLY in the true world [mm], coloured, with each vertex's distance as `error_mm`."""
    import trimesh

    colors = np.rint(255 * error_colors(mesh.distance)).astype(np.uint8)
    made = trimesh.Trimesh(mesh.vertices, mesh.triangles, vertex_colors=colors, process=False)
    made.vertex_attributes["error_mm"] = mesh.distance.astype(np.float32)
    made.export(path)


def error_picture(mesh: ErrorMesh) -> bytes:
    """The coloured surface from outside, and what the colours mean."""
    picture = mesh_picture(mesh.vertices, mesh.triangles, error_colors(mesh.distance))
    height, top, bottom = picture.shape[0], 70, 40
    scale = np.full((height, 150, 3), 255, np.uint8)
    steps = np.linspace(_COLOR_MM, 0, height - top - bottom)
    scale[top : height - bottom, 20:44] = np.rint(255 * error_colors(steps))[:, None]
    write = partial(cv2.putText, scale, fontFace=cv2.FONT_HERSHEY_SIMPLEX, color=(60, 60, 60), lineType=cv2.LINE_AA)
    for line, words in enumerate(("distance to the", "closest true point")):
        write(text=words, org=(6, 24 + 18 * line), fontScale=0.42)
    for mm in range(int(_COLOR_MM) + 1):
        row = round(height - bottom - mm / _COLOR_MM * (height - top - bottom))
        write(text=f"{mm:g} mm" + " and more" * (mm == _COLOR_MM), org=(50, row + 5), fontScale=0.42)
    return png(side_by_side([picture, scale]))
