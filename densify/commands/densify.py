"""The verb densify: dense surfaces from frames and a sparse map."""

from __future__ import annotations

from pathlib import Path
from shlex import quote

from densify.config import DensifyConfig
from densify.dense_run import Asked, dense_run
from densify.inputs import MapSource, SurfaceFiles
from densify.joining import MergeConfig
from lightdepth.checkpoint import ModelSource
from lightdepth.command_line.options import Group
from lightdepth.command_line.outcome import end
from lightdepth.datasets import SequenceSource
from lightdepth.sfm.config import SfmConfig


def densify(
    source: Group[SequenceSource],
    output: Path,
    mapped: Group[MapSource] = MapSource(),
    predicting: Group[ModelSource] = ModelSource(),
    config: Group[DensifyConfig] = DensifyConfig(),
    sfm: SfmConfig = SfmConfig(),
    files: Group[SurfaceFiles] = SurfaceFiles(),
    fit_light: bool = True,
    merge: bool = True,
    merging: MergeConfig = MergeConfig(),
    overwrite: bool = False,
    resume: bool = False,
) -> None:
    """Dense surfaces from frames and a sparse map, one per submap, and one for joined submaps.

    Args:
        output: Run folder to make, with the surfaces and the report.
        sfm: how frames are mapped when there is no map
        fit_light: Where neither --light nor the folder gives the light, fit it on the map, and use it if its depth
            fits hidden blocks of wall better; switched off, a usual light is assumed.
        merge: Join submaps that see the same tissue, and write one surface for each group besides the single ones;
            switched off, submaps stay apart.
        merging: when two submaps are one
        overwrite: Replace a run made before.
        resume: Go on with the run that was stopped there, as it was begun; a sparse map, a light and submaps that are
            done are not made again.
    """
    model = predicting.load(details=False)  # before minutes are spent on a sparse map
    asked = Asked(source, mapped, predicting, config, sfm, files, fit_light, merge, merging)
    dense_run(asked, model, output, overwrite, resume)
    end(output, then=f"lightdepth view {quote(str(output))}", page=output / "report.html")
