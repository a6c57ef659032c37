"""The verb predict: one .npz a frame."""

from __future__ import annotations

from pathlib import Path

from lightdepth.checkpoint import DEFAULT_CHECKPOINT, load_model
from lightdepth.command_line.options import Group
from lightdepth.datasets import SequenceSource
from lightdepth.errors import InputError
from lightdepth.refine import RefineConfig, RefinedModel
from lightdepth.reporting.figures import colored_distance, png, side_by_side, thumbnail
from lightdepth.reporting.progress import Progress
from lightdepth.reporting.run import recorded, run_folder


def predict(
    source: Group[SequenceSource],
    output: Path,
    checkpoint: str = DEFAULT_CHECKPOINT,
    refine: int = 0,
    previews: bool = True,
    overwrite: bool = False,
) -> None:
    """Distance, albedo and normals of every frame of a sequence, as one .npz a frame.

    Args:
        output: Folder to make, with one .npz for each frame.
        checkpoint: Depth model: a path, the name of a bundled one, decline (the closed form) or constant.
        refine: Number of steps in which each image's distance is improved by its own light; 0 for none. More follow
            the light further and take longer.
        previews: Also write a PNG with image and distance for every frame.
        overwrite: Replace a folder made before.
    """
    arguments = recorded(source, output=output, checkpoint=checkpoint, refine=refine, previews=previews)
    model = load_model(checkpoint)
    if refine:
        model = RefinedModel(model, RefineConfig(steps=refine))
    frames = source.open()
    with run_folder(output, "predict", arguments, overwrite) as run, Progress("Predicting", len(frames)) as bar:
        run.hash_inputs(data=source.data)
        if previews:
            (run.folder / "previews").mkdir()
        nothing = 0
        for i in range(len(frames)):
            try:
                frame = frames[i]
            except InputError as error:
                run.fail(frames.names[i], str(error))
                continue
            prediction = model(frame)
            nothing += not prediction.valid.any()
            prediction.save(run.folder / f"{frame.name}.npz")
            if previews:
                colors = colored_distance(prediction.distance, prediction.valid)
                picture = side_by_side([thumbnail(frame.image, 480), thumbnail(colors, 480)])
                (run.folder / "previews" / f"{frame.name}.png").write_bytes(png(picture))
            bar.advance()
        if len(run.record["failures"]) == len(frames):
            raise InputError(source.data, "no frame could be read", f"the first: {run.record['failures'][0]['reason']}")
        if nothing:
            run.warn(f"{nothing} of {len(frames)} frames have no valid pixel: they are black, or masked")
        run.record["checkpoint"] = model.name
