"""The verb synth: a synthetic colon and its SLAM export."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from shlex import quote
from typing import Annotated, Literal

from lightdepth.calibration import read_light
from lightdepth.command_line.options import Group
from lightdepth.command_line.outcome import end
from lightdepth.counting import counted
from lightdepth.datasets.c3vd import C3VD
from lightdepth.errors import InputError
from lightdepth.ranges import BELOW_ONE, COUNT, SEED, at_least, checked
from lightdepth.reporting.progress import Progress
from lightdepth.reporting.run import recorded, run_folder
from lightdepth.tube import Lens, render_sequence
from lightdepth.tube import lens as tube_lens
from lightdepth.tube.breathing import BreathingConfig
from lightdepth.tube.export import write_synthetic
from lightdepth.tube.map_errors import MapErrors, moved_ids, with_errors
from lightdepth.tube.scene import TubeConfig, realistic
from lightdepth.tube.sequence import TubeSequence
from lightdepth.tube.slam import SlamConfig, check_enough_frames, simulate_slam

_SIZE = (320, 256)


@dataclass(frozen=True)
@checked
class ColonConfig:
    """A synthetic colon, the endoscope in it, and the way that it takes."""

    lens: Lens = "c3vd"
    """Lens of the endoscope: pinhole (90 degrees across), telescope (70), fisheye (136) or c3vd (that of the data set
    C3VD)."""
    frames: Annotated[int, COUNT] = 120
    """Number of frames to render, spread evenly over --travel-mm. More lie closer together on the same path, and take
    longer."""
    size: Annotated[tuple[int, int] | None, at_least(8, up_to=10_000)] = None
    """Width and height of the images, pixels; left out, 320 x 256, but 1350 x 1080 with --layout c3vd, as the data set
    has it (25 MB of memory and several seconds a frame). A larger one shows finer detail and takes longer."""
    seed: Annotated[int, SEED] = 0
    """Number that draws the colon, its light, the path and the SLAM's errors. Another one draws others."""
    travel_mm: Annotated[float, at_least(0, up_to=10_000)] = 36.0
    """Length of the path along the colon, mm. A longer one, with as many frames, makes neighbouring frames less
    alike."""
    light: str | None = None
    """Light to use instead of a drawn one: a light.json, or values such as gamma=2.2,mu=0 (gamma: the camera's
    response; mu: how narrow the beam is; at 0 it is equally bright in all directions)."""
    family: Literal["plain", "realistic"] = "plain"
    """Kind of colon: plain (tube, folds, vessels; its ranges are under --scene) or realistic (also polyps, mucus,
    bubbles, blur and other things that real images show; it takes no --scene)."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where frames are rendered: cpu, cuda (a GPU; needs the extra gpu), or auto, the GPU where there is one and that
    extra is installed."""

    def in_layout(self, layout: str) -> ColonConfig:
        """With the size of the layout, where none was given. Raises InputError for what the layout cannot hold."""
        if layout == "endomapper" and self.lens == "c3vd":
            raise InputError("--layout endomapper", "it holds no Scaramuzza lens, as C3VD's is", "add --lens fisheye")
        if layout != "c3vd":
            return replace(self, size=self.size or _SIZE)
        if self.lens != "c3vd":
            raise InputError(
                "--layout c3vd", f"it holds no camera: {self.lens} would be read as C3VD's", "leave out --lens"
            )
        width, height = self.size or (C3VD.width, C3VD.height)
        if abs(width / height / (C3VD.width / C3VD.height) - 1) > 0.01:
            raise InputError(
                "--layout c3vd",
                f"images of {width}x{height}, whose sides are not as those of C3VD's",
                f"leave out --size, or take one as 5 to 4: {C3VD.width}x{C3VD.height} and its reductions",
            )
        return replace(self, size=(width, height))

    def rendered(
        self, scene: TubeConfig, breathing: BreathingConfig, progress: Callable[[int, int], None]
    ) -> TubeSequence:
        """The frames. Raises InputError where `scene` has ranges of its own and the family has others."""
        if self.family == "realistic":
            if scene != TubeConfig():
                raise InputError(
                    "--family realistic", "it has ranges of its own", "leave out --scene, or take --family plain"
                )
            scene = realistic()
        chosen = read_light(self.light) if self.light is not None else None
        camera = tube_lens(self.lens, *(self.size or _SIZE))
        return render_sequence(
            self.seed,
            self.frames,
            camera,
            self.travel_mm,
            scene,
            chosen,
            progress,
            device=self.device,
            breathing=breathing,
        )


def synth(
    output: Path,
    colon: Group[ColonConfig] = ColonConfig(),
    layout: Literal["frames", "c3vd", "endomapper"] = "frames",
    spurious: Annotated[float | None, BELOW_ONE] = None,
    scene: TubeConfig = TubeConfig(),
    slam: SlamConfig = SlamConfig(),
    errors: MapErrors = MapErrors(),
    breathing: BreathingConfig = BreathingConfig(),
    overwrite: bool = False,
) -> None:
    """A synthetic colon sequence with exact truth, and a multi-map SLAM export with known wrong points.

    Args:
        output: Folder to make, with the frames, their truth and the SLAM export.
        layout: How the files of the sequence are laid out: frames (our own folder), c3vd (as C3VD, with normals, flow,
            occlusion and the mesh of what was seen, unless the wall moves; for --lens c3vd), or endomapper (out1.png,
            ... and XML, its truth in truth/sequence; not with --lens c3vd).
        spurious: Share of the map points, in [0, 1), that are wrong; it wins over --slam.spurious, which holds where
            this is left out. A larger one makes the map harder to densify.
        scene: ranges of shape, texture and sensor of plain colons
        slam: quality of the simulated SLAM
        errors: errors that neighbouring points or stretches of the path share, on top of those of the SLAM
        breathing: how the wall moves from frame to frame; each frame's truth is its own
        overwrite: Replace a folder made before.
    """
    arguments = recorded(
        colon,
        output=output,
        layout=layout,
        spurious=spurious,
        scene=scene,
        slam=slam,
        errors=errors,
        breathing=breathing,
    )
    slam = slam if spurious is None else replace(slam, spurious=spurious)
    if slam.spurious is not None and not 0 <= slam.spurious < 1:
        raise InputError("--spurious", f"{slam.spurious}", "expected a share of at least 0 and below 1")
    colon = colon.in_layout(layout)
    with run_folder(output, "synth", arguments, overwrite) as run, Progress("Rendering", colon.frames) as bar:
        check_enough_frames(colon.frames, slam, colon.seed)  # before minutes are spent on rendering them
        sequence = colon.rendered(scene, breathing, lambda *_: bar.advance())
        made = sequence.frames
        if layout == "endomapper":  # which counts frames from 1
            made = [replace(frame, name=f"out{frame.number + 1}") for frame in made]
        right = simulate_slam(made, slam, colon.seed, sequence.breathing)
        export = replace(right, map=with_errors(right.map, errors, colon.seed))
        moved = None if errors == MapErrors() else moved_ids(right.map, export.map)
        wall = None if sequence.breathing is not None else sequence.tube.shape  # no one mesh holds a wall that moves
        write_synthetic(made, export, run.folder, layout, moved, wall)
        run.log(f"{counted(colon.frames, 'frame')}, {counted(len(export.map.submaps), 'submap')}")
    place = output if layout == "frames" else output / "sequence"
    then = f"lightdepth densify {quote(str(place))} --map {quote(str(output / 'slam'))} -o runs/dense"
    end(output, then=then)
