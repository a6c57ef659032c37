"""The verb predict: one .npz a frame."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from shlex import quote
from typing import Annotated

import numpy as np

from lightdepth.checkpoint import ModelSource
from lightdepth.colour import ColourMeter
from lightdepth.command_line.dry import Step
from lightdepth.command_line.options import Group
from lightdepth.command_line.outcome import end
from lightdepth.counting import counted, full_stop
from lightdepth.datasets import FrameSequence, SequenceSource
from lightdepth.depth_gate import DepthGate, sentence
from lightdepth.errors import InputError
from lightdepth.frame import Frame
from lightdepth.hidden_uncertainty import read_factor
from lightdepth.models import DepthModel
from lightdepth.prediction import DepthPrediction, read_prediction
from lightdepth.ranges import at_least
from lightdepth.refine import RefineConfig, RefinedModel
from lightdepth.reporting.batches import batches
from lightdepth.reporting.figures import colored_distance, png, side_by_side, thumbnail
from lightdepth.reporting.names import names_of
from lightdepth.reporting.plan import seconds_each, times
from lightdepth.reporting.predicted import predicted_page, spread
from lightdepth.reporting.progress import Progress
from lightdepth.reporting.run import recorded, run_folder
from lightdepth.uncalibrated import open_frames


def predict(
    source: Group[SequenceSource],
    output: Path,
    predicting: Group[ModelSource] = ModelSource(),
    refine: Annotated[int, at_least(0, up_to=100_000)] = 0,
    uncertainty: Path | None = None,
    previews: bool = True,
    overwrite: bool = False,
    resume: bool = False,
) -> None:
    """Distance, albedo and normals of every frame of a sequence, as one .npz a frame.

    Args:
        output: Folder to make, with one .npz for each frame: distance (up to scale), albedo and normals.
        refine: Number of steps that change the predicted distance of each image so that a wall at that distance, lit,
            looks more like the image; 0 for none, 100 is usual. More fit the image more closely, which is not always
            nearer to the truth, and take longer.
        uncertainty: Run folder of `densify` on the same endoscope with the same checkpoint, or its uncertainty.json;
            the predicted uncertainty is multiplied by the factor that hidden blocks of that map gave. A larger factor
            makes wider intervals. Left out, uncertainty is written as predicted.
        previews: true: a PNG with the image and its distance is written for every frame as well, into previews/. false:
            none is.
        overwrite: Replace a folder made before. Without it, a folder that is already there is refused.
        resume: Go on with the run that was stopped there, as it was begun; frames that are done are not predicted
            again.
    """
    arguments = recorded(source, predicting, output=output, refine=refine, uncertainty=uncertainty, previews=previews)
    if refine < 0:
        raise InputError("--refine", f"{refine}", "expected a number of steps, 0 for none")
    if refine and uncertainty is not None:
        raise InputError("--uncertainty", "refined distance has no uncertainty", "leave out one of it and --refine")
    model = predicting.load()
    factor = None if uncertainty is None else read_factor(uncertainty, *_names(model, predicting.checkpoint))
    if refine:
        model = RefinedModel(model, RefineConfig(steps=refine))
    with run_folder(output, "predict", arguments, overwrite, resume) as run:
        run.hash_inputs(**source.files, checkpoint=Path(predicting.checkpoint), uncertainty=uncertainty)
        frames = open_frames(source, run).without_truth()
        what = f"{counted(len(frames), 'frame')} of {frames.source} would be predicted by {model.name}"
        run.begins(what, lambda: _steps(frames, model, previews))
        if previews:
            (run.folder / "previews").mkdir(exist_ok=True)
        nothing, meter, gate = 0, ColourMeter(), DepthGate()
        doubts: dict[str, str] = {}
        with Progress("Predicting", len(frames)) as bar:
            for batch in batches(run, "frames", len(frames)):
                if batch.finished:
                    meter.go_on(batch.kept["colours"], batch.arrays())
                    nothing += batch.kept["nothing"]
                    doubts |= batch.kept["doubts"]
                    bar.advance(len(batch))
                    continue
                taken, black, doubted = meter.taken(), 0, {}
                for i in batch:
                    bar.advance()
                    try:
                        frame = frames[i]
                    except InputError as error:
                        run.fail(frames.names[i], str(error))
                        meter.apart()
                        continue
                    meter.add(frame.image, frame.valid)
                    prediction = model(frame)
                    black += not prediction.valid.any()
                    if doubt := gate.doubt(frame):
                        doubted[frame.name] = doubt
                    if factor is not None and prediction.uncertainty is not None:
                        prediction = replace(prediction, uncertainty=prediction.uncertainty * np.float32(factor))
                    batch.files += _written(run.folder, frame, prediction, previews)
                batch.finish({"nothing": black, "doubts": doubted, "colours": meter.since(taken)}, meter.last())
                nothing += black
                doubts |= doubted
        if len(run.record["failures"]) == len(frames):
            raise InputError(source.data, "no frame could be read", f"the first: {run.record['failures'][0]['reason']}")
        if nothing:
            run.warn(f"{nothing} of {len(frames)} frames have no valid pixel: they are black, or masked")
        colours = meter.result()
        for doubt in colours.doubts:
            run.warn(doubt)
        if doubts:
            run.warn(sentence(doubts, len(frames)))
        run.record["doubted"] = doubts
        run.record["colour"] = colours.record()
        run.record["checkpoint"] = model.name
        run.record["uncertainty_factor"] = factor
        made = (
            f"{len(frames) - len(run.record['failures'])} of {counted(len(frames), 'frame')} predicted by {model.name}"
        )
        run.log(made)
        said = [f"{made}.", *(full_stop(f"Warning: {warning}") for warning in run.record["warnings"])]
        page = predicted_page(said, _facts(refine, factor, previews), _shown(run.folder, frames) if previews else [])
        page.files(run.folder, {})
        page.write(run.folder / "report.html")
    end(output, then=f"lightdepth export {quote(str(output))} -o runs/png --to png", page=output / "report.html")


def _facts(refine: int, factor: float | None, previews: bool) -> list[list[str]]:
    found = [
        ["files", "NAME.npz for each frame: distance (up to scale), where it is valid, albedo, normals, uncertainty"]
    ]
    found += [["refined", f"in {counted(refine, 'step')}"]] if refine else []
    found += [["uncertainty", f"multiplied by {factor:.3g}"]] if factor is not None else []
    return [
        *found,
        ["images of the patient", "in this page and in previews/" if previews else "none: --previews is false"],
    ]


def _shown(folder: Path, frames: FrameSequence) -> list[tuple[Frame, DepthPrediction]]:
    """Some frames with what was written of them, as far as they could be read."""
    found = []
    for row in spread(len(frames)):
        with suppress(InputError):
            frame = frames[row]
            found.append((frame, read_prediction(folder / f"{frame.name}.npz")))
    return found


def _steps(frames: FrameSequence, model: DepthModel, previews: bool) -> list[Step]:
    def made(frame: Frame) -> None:
        prediction = model(frame)
        prediction.save(BytesIO())
        if previews:
            _preview(frame, prediction)

    return [Step(f"predicting {counted(len(frames), 'frame')}", times(len(frames), seconds_each(frames, made)))]


def _written(folder: Path, frame: Frame, prediction: DepthPrediction, previews: bool) -> list[Path]:
    """The files of a frame."""
    file, preview = folder / f"{frame.name}.npz", folder / "previews" / f"{frame.name}.png"
    prediction.save(file)
    if not previews:
        return [file]
    preview.write_bytes(_preview(frame, prediction))
    return [file, preview]


def _preview(frame: Frame, prediction: DepthPrediction) -> bytes:
    """The image beside its distance (PNG)."""
    colors = colored_distance(prediction.distance, prediction.valid)
    return png(side_by_side([thumbnail(frame.image, 480), thumbnail(colors, 480)]))


def _names(model: DepthModel, checkpoint: str) -> tuple[str, ...]:
    """What a run may call the checkpoint, whether it keeps names or not."""
    hidden = names_of({"checkpoint": checkpoint}).text(model.name)
    return model.name, hidden, Path(checkpoint).resolve().name, Path(checkpoint).stem
