"""What the verb export makes of checkpoints and predictions, into its run folder."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from lightdepth.counting import counted
from lightdepth.errors import InputError
from lightdepth.exporting.checkpoints import GRAPH_FILES, GraphKind, write_graph, write_pretrained
from lightdepth.exporting.depth import checked_step, depth_of, fitting_step, write_png16
from lightdepth.files.exr import write_exr
from lightdepth.models import NetworkModel
from lightdepth.prediction import read_prediction
from lightdepth.reporting.progress import Progress
from lightdepth.reporting.run import Run

DEPTH_KINDS = Literal["png", "exr"]
MODEL_KINDS = Literal["onnx", "torch", "safetensors"]


def export_model(run: Run, model: NetworkModel, to: str, size: tuple[int, int] | None, half: bool) -> None:
    """The checkpoint as a graph or as a folder for `from_pretrained`."""
    run.record["checkpoint"] = model.name
    if to == "safetensors":
        write_pretrained(model, run.folder, half)
        run.log("model.safetensors, config.json: lightdepth.from_pretrained reads this folder")
        return
    kind: GraphKind = "onnx" if to == "onnx" else "torch"
    off = write_graph(model, run.folder, kind, size)
    run.record["difference"] = off
    free = "any size" if size is None else f"{size[0]}x{size[1]} alone"
    run.log(f"{GRAPH_FILES[to]}: images of {free}; it differs from the network by at most {off:.2g}")


def export_depth(run: Run, folder: Path, to: str, step: float | None) -> None:
    """Depth along the axis of every prediction of a folder, as 16-bit PNG or EXR."""
    files = sorted(folder.glob("*.npz"))
    if step is not None and to != "png":
        raise InputError("--step", f"given with --to {to}", "leave it out: only png has it")
    unit, largest = "", 0.0
    for file in files:
        prediction = read_prediction(file)
        unit, largest = prediction.unit, max(largest, float(depth_of(prediction).max()))
    chosen = fitting_step(largest, unit) if step is None else checked_step(step, largest, unit)
    with Progress("Exporting depth", len(files)) as bar:
        for file in files:
            depth = depth_of(read_prediction(file))
            if to == "png":
                write_png16(run.folder / f"{file.stem}.png", depth, chosen)
            else:
                write_exr(run.folder / f"{file.stem}.exr", depth)
            bar.advance()
    run.record.update({"kind": "depth along the axis", "unit": unit, "step": chosen if to == "png" else None})
    scale = f" --depth-scale {chosen:g}" if unit == "mm" else ""
    scale = scale if to == "png" or unit != "mm" else " --depth-scale 1"
    codes = f"{f'; one code is {chosen:g}' if to == 'png' else ''} (evaluate --depth-kind depth{scale})"
    run.log(f"{counted(len(files), f'.{to} file')} of depth along the axis, {unit}, 0 where unknown{codes}")
