"""The verb demo: the whole way on a synthetic colon."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from shlex import quote
from typing import Annotated

from densify.config import DensifyConfig
from densify.demonstration import Planted, closing_lines
from densify.densified import Densified
from densify.evaluation.files import write_evaluations
from densify.evaluation.in_short import in_short
from densify.evaluation.judge import judge_maps
from densify.evaluation.judged_map import dense_models, read_run
from densify.evaluation.truth import read_truth
from densify.page import FILES, densify_page
from lightdepth.checkpoint import ModelSource
from lightdepth.command_line.options import Group
from lightdepth.command_line.outcome import end
from lightdepth.datasets import open_sequence
from lightdepth.errors import InputError
from lightdepth.maps import read_map
from lightdepth.ranges import BELOW_ONE, COUNT, SEED, Range, at_least
from lightdepth.reporting.progress import Progress
from lightdepth.reporting.run import recorded, run_folder
from lightdepth.tube import Lens, render_sequence
from lightdepth.tube import lens as tube_lens
from lightdepth.tube.export import write_synthetic
from lightdepth.tube.slam import SlamConfig, least_frames, simulate_slam


def demo(
    output: Path = Path("runs/demo"),
    predicting: Group[ModelSource] = ModelSource(),
    frames: Annotated[int, COUNT] = 40,
    seed: Annotated[int, SEED] = 7,
    size: Annotated[tuple[int, int], at_least(8, up_to=10_000)] = (320, 256),
    lens: Lens = "c3vd",
    spurious: Annotated[float, BELOW_ONE] = 0.3,
    wrong_side: Annotated[float, Range(0.1, 10)] = 1.22,
    overwrite: bool = False,
) -> None:
    """The whole way on a synthetic colon: render, sparse map, densify, evaluate; a good surface and a bad one.

    Args:
        output: Run folder to make, with the data, the surfaces and the report.
        frames: Number of frames to render, 0.7 mm apart. More make a longer path and take longer.
        seed: Number that draws the colon, its light, the path and the map's errors; bundled checkpoints were trained on
            no number below 1000. Another one draws another colon.
        size: Width and height of the images, pixels. A larger one shows finer detail and takes longer.
        lens: Lens of the endoscope: pinhole (90 degrees across), telescope (70), fisheye (136) or c3vd (that of the
            data set C3VD).
        spurious: Share of the map points, in [0, 1), that are wrong. A larger one makes the map harder to densify.
        wrong_side: Factor, from 0.1 to 10, by which points on one side of the first submap are too far away, so that
            the demo also shows a bad surface; 1 leaves them right. A larger one makes it worse.
        overwrite: Replace a run made before.
    """
    arguments = recorded(
        predicting,
        output=output,
        frames=frames,
        seed=seed,
        size=size,
        lens=lens,
        spurious=spurious,
        wrong_side=wrong_side,
    )
    config = SlamConfig("independent", spurious=spurious)
    model = predicting.load(details=False)
    with run_folder(output, "demo", arguments, overwrite) as run:
        if frames < (least := least_frames(config, seed)):
            found = f"{frames}, too few for {config.maps} submaps of two keyframes each"
            raise InputError("--frames", found, f"expected at least {least}")
        with Progress("Rendering", frames) as bar:
            sequence = render_sequence(
                seed, frames, tube_lens(lens, *size), 0.7 * frames, progress=lambda *_: bar.advance()
            )
        slam = simulate_slam(sequence.frames, config, seed)
        planted = Planted.of(slam.map, wrong_side, seed)
        write_synthetic(sequence.frames, replace(slam, map=planted.map), run.folder / "data", moved=planted.moved)
        data = open_sequence(run.folder / "data")
        sparse_map = read_map(run.folder / "data" / "slam")
        work = Densified.make(data, sparse_map, model, DensifyConfig())
        work.write(run, ("ply",), None)
        evaluation = judge_maps(dense_models(read_run(run.folder)), read_truth(data))
        write_evaluations({"demo": evaluation}, run.folder)
        run.log(in_short({"demo": evaluation}))
        run.record["evaluation"] = [found.record() for found in evaluation.judged.maps]
        run.record["planted"] = planted.record()
        verdicts = {result.dense.submap.id: result.verdict for result in work.results}
        run.record["in_short"] = closing_lines(planted, verdicts, evaluation.judged.maps)
        notes = [
            *run.record["in_short"],
            f"A synthetic colon (seed {seed}), {frames} frames, a simulated SLAM export of {len(sparse_map.submaps)} "
            f"submaps with {spurious:.0%} wrong points; depth by {work.model}. The truth is "
            "exact, so the errors are true ones.",
        ]
        page = densify_page(
            "Demo: from frames to a dense surface",
            work.results,
            work.gallery,
            notes,
            evaluation.judged.maps,
            errors=evaluation.meshes,
        )
        page.files(run.folder, FILES)
        page.write(run.folder / "report.html")
        for line in run.record["in_short"]:
            run.log(line)
    end(output, then=f"lightdepth view {quote(str(output))}", page=output / "report.html")
