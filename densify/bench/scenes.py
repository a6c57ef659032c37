"""The benchmark's colons: eight short sequences and a screening, shaped like C3VD's in the densification paper.

A scene is as the paper's table 1 has its sequences: so many frames, keyframes and submaps. Only the keyframes are
rendered: the SLAM is simulated, and nothing else is looked at. The travel is not in the paper ("short, with slow
motion"; a screening is a whole withdrawal). Lengths in mm.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from densify.evaluation.truth import Truth, read_truth
from lightdepth.datasets import FrameSequence
from lightdepth.sparse_map import SparseMap
from lightdepth.tube import ShapeConfig, Tube, TubeConfig, TubeSequence, lens, realistic, render_sequence
from lightdepth.tube.breathing import Breathing, BreathingConfig
from lightdepth.tube.map_errors import MapErrors, with_errors
from lightdepth.tube.slam import SimulatedSlam, SlamConfig, simulate_slam
from lightdepth.tube.variant import VariantTube

SUITE_VERSION = 1
"""Runs of another version are not comparable: to be raised with every change that makes other scenes of a seed."""
Size = Literal["small", "full"]


@dataclass(frozen=True)
class Scene:
    """One sequence. `frames` of it were seen by the SLAM, in `maps` submaps, and `keyframes` were kept; `wall` is how
    the colon is made (of another make than any that a checkpoint was trained on: "other"), `mu` how the light fades
    to the side (the wider, the smaller), `reflectance` how much of it the walls reflect onto each other."""

    name: str
    seed: int
    frames: int
    keyframes: int
    maps: int = 1
    travel_mm: float = 20.0
    lens: str = "c3vd"
    wall: Literal["plain", "realistic", "other"] = "plain"
    mu: tuple[float, float] = (2.2, 3.4)
    reflectance: tuple[float, float] = (0.0, 0.7)

    @property
    def colon(self) -> TubeConfig:
        made = realistic() if self.wall == "realistic" else TubeConfig()
        length = max(made.shape.length, self.travel_mm + 120)
        shape = replace(made.shape, length=length) if self.wall != "other" else ShapeConfig()
        sensor = replace(made.sensor, mu=self.mu, reflectance=self.reflectance)
        # A long colon in larger patches: they light each other pairwise.
        patch = made.patch * max(1.0, np.sqrt(length / 200))
        return replace(made, shape=shape, sensor=sensor, patch=float(patch))


_POINTS = 2000
"""Of the sparse map of a short sequence, as in the paper's table 2."""
_TRACKED = 500
"""Points that a keyframe of a SLAM like a real one observes at most."""
_FPS = 50
_WIDE, _STRONG, _WEAK = (0.0, 1.0), (0.5, 0.7), (0.0, 0.2)
_SHORT = (  # frames and keyframes are t2a's to s3a's of the paper
    Scene("short1", 0, 194, 16, travel_mm=20, reflectance=_WEAK),
    Scene("short2", 1, 250, 7, travel_mm=12, wall="other", reflectance=_WEAK),
    Scene("short3", 2, 382, 14, travel_mm=20, lens="pinhole", wall="realistic"),
    Scene("short4", 3, 276, 21, travel_mm=25, mu=_WIDE),
    Scene("short5", 4, 370, 24, travel_mm=25, lens="fisheye", wall="realistic"),
    Scene("short6", 5, 730, 15, travel_mm=30, reflectance=_STRONG),
    Scene("short7", 6, 148, 11, travel_mm=15, wall="realistic", mu=_WIDE),
    Scene("short8", 7, 613, 42, travel_mm=40, wall="other", reflectance=_STRONG),
)
_SCREENING = Scene("screening", 8, 5015, 475, maps=19, travel_mm=380, wall="realistic")
_SMALL = (_SHORT[1], _SHORT[6])


def scenes(size: Size, first_seed: int = 400) -> list[Scene]:
    """The suite of a size, its seeds counted from the first."""
    chosen = _SMALL if size == "small" else (*_SHORT, _SCREENING)
    return [replace(scene, seed=first_seed + i) for i, scene in enumerate(chosen)]


@dataclass(frozen=True, eq=False)
class Rendered:
    """A scene's keyframes with truth, the wall that they see (the one at rest, where it moves), and how it moves."""

    scene: Scene
    frames: FrameSequence
    truth: Truth
    breathing: Breathing | None = None

    def tracked(self, wrong_share: float, errors: MapErrors) -> SparseMap:
        """What a SLAM like a real one makes of it, with errors that come together."""
        config = SlamConfig("tracked", 1, self.scene.maps, points_per_keyframe=_TRACKED, spurious=wrong_share)
        found = simulate_slam(list(self.frames), config, self.scene.seed, self.breathing)
        return with_errors(found.map, errors, self.scene.seed)

    def slam(self, wrong_share: float) -> SimulatedSlam:
        """The SLAM's export with a share of wrong points."""
        new = round(_POINTS / min(self.scene.keyframes, 20))
        config = SlamConfig("independent", 1, self.scene.maps, points_per_keyframe=new, spurious=wrong_share)
        return simulate_slam(list(self.frames), config, self.scene.seed)


def render(scene: Scene, image_size: tuple[int, int]) -> Rendered:
    """The keyframes of a scene at (width, height), numbered as among all of its frames; a screening is a withdrawal."""
    sequence = _sequence(scene, _made(scene, image_size, BreathingConfig()))
    truth = read_truth(sequence)
    assert truth.surface is not None
    # The paper's accuracy is to the true cloud. Far points take minutes to find the closest triangle.
    return Rendered(scene, sequence, replace(truth, surface=replace(truth.surface, mesh=None, mesh_source="")))


def render_moving(still: Rendered, config: BreathingConfig) -> Rendered:
    """The same keyframes of the same colon while its wall moves. Poses and the wall that surfaces are judged by stay;
    the frames' truth is their own. The period is the nearest of which the scene has a whole number, so that the mean of
    the wall over the scene is the wall at rest."""
    scene, camera = still.scene, still.frames[0].camera
    assert scene.maps == 1, scene.name
    seconds = (scene.frames - 1) / _FPS
    period = seconds / max(1, round(seconds / config.period))
    made = _made(scene, (camera.width, camera.height), replace(config, period=period))
    return replace(still, frames=_sequence(scene, made), breathing=made.breathing)


def _made(scene: Scene, image_size: tuple[int, int], breathing: BreathingConfig) -> TubeSequence:
    kind = VariantTube if scene.wall == "other" else Tube
    camera, times = lens(scene.lens, *image_size), [n / _FPS for n in _numbers(scene)]
    return render_sequence(
        *(scene.seed, scene.keyframes, camera, scene.travel_mm, scene.colon),
        kind=kind,
        breathing=breathing,
        times=times,
    )


def _sequence(scene: Scene, made: TubeSequence) -> FrameSequence:
    frames = made.frames[::-1] if scene.maps > 1 else made.frames
    named = [replace(f, name=f"{n:06d}", time=n / _FPS) for f, n in zip(frames, _numbers(scene), strict=True)]
    return FrameSequence([f.name for f in named], named.__getitem__, f"{scene.name} (seed {scene.seed})")


def _numbers(scene: Scene) -> list[int]:
    """Of the keyframes among all frames."""
    numbers: list[int] = np.linspace(0, scene.frames - 1, scene.keyframes).round().astype(int).tolist()
    return numbers
