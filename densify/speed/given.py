"""What stages work on: a colon's keyframes on disk with a map, and what each step of densify makes of them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch

from densify.agreement import View, compared_pairs, gap_between, unbent
from densify.aligned import AlignedKeyframe, align_alone, align_together
from densify.bending import Bend
from densify.config import DensifyConfig
from densify.evaluation.errors import TrueSurface
from densify.evaluation.truth import Truth, read_truth
from densify.fusers import sure
from densify.fusion.marching_cubes import BLOCK
from densify.fusion.plain import PlainTsdf, undistorted
from densify.fusion.rectify import SurfaceView, surface_view
from densify.fusion.volume import TsdfVolume
from densify.judging.columns import Method
from densify.page import Gallery, densify_page
from densify.pipeline import SubmapResult, densify_submap
from densify.predictions import SeenKeyframe
from densify.similarity import Similarity, fit_similarity
from lightdepth.blocks import submap_folds
from lightdepth.camera import Pinhole
from lightdepth.datasets import FrameSequence, open_sequence
from lightdepth.datasets.reading import image_files
from lightdepth.frame import Frame, FrameBatch, to_batch
from lightdepth.maps import read_map
from lightdepth.models import DepthModel, NetworkModel, working_size
from lightdepth.observations import ObservedDistances
from lightdepth.parallax import Look, guessed, parallax_neighbours
from lightdepth.prediction import DepthPrediction, shrunk
from lightdepth.sparse_map import Keyframe, SparseMap, Submap, covisibility
from lightdepth.tube import lens, render_sequence
from lightdepth.tube.export import write_synthetic
from lightdepth.tube.slam import SlamConfig, simulate_slam

SEED, WRONG, POINTS = 400, 0.1, 500
"""The colon, the share of its map's points that are wrong, and how many a keyframe observes at the most."""
_TRAVEL_MM = 1.2
_CLOSED_FORM_ROWS, _EVALUATED = 256, 4


def write_colon(folder: Path, size: tuple[int, int], keyframes: int) -> None:
    """A sequence of keyframes alone, with truth, and its map in slam/."""
    frames = render_sequence(SEED, keyframes, lens("pinhole", *size), _TRAVEL_MM * keyframes).frames
    config = SlamConfig("tracked", 1, 1, points_per_keyframe=POINTS, spurious=WRONG)
    write_synthetic(frames, simulate_slam(frames, config, SEED), folder)


@dataclass(frozen=True, eq=False)
class Given:
    """A colon on disk, of which each step is made when it is first asked for. What is timed is one keyframe in the
    middle of the map."""

    folder: Path
    model: DepthModel
    config: DensifyConfig = field(default_factory=DensifyConfig)

    @cached_property
    def submap(self) -> Submap:
        (submap,) = read_map(self.folder / "slam").submaps
        return submap

    @cached_property
    def frames(self) -> FrameSequence:
        return open_sequence(self.folder)

    @property
    def row(self) -> int:
        """Of the keyframe that is timed."""
        return len(self.submap.keyframes) // 2

    @property
    def keyframe(self) -> Keyframe:
        return self.submap.keyframes[self.row]

    @cached_property
    def file(self) -> Path:
        """The keyframe's image."""
        return self.folder / "frames" / image_files(self.folder)[self.keyframe.number]

    @cached_property
    def seen(self) -> list[SeenKeyframe]:
        """Frames and predictions of all keyframes, as densify keeps them."""
        found = []
        for keyframe in self.submap.keyframes:
            frame = self.frames.of_keyframe(keyframe)
            found.append(SeenKeyframe(frame, replace(self.model(frame), albedo=None, normals=None)))
        return found

    @property
    def frame(self) -> Frame:
        frame = self.seen[self.row].frame
        assert frame is not None
        return frame

    @property
    def prediction(self) -> DepthPrediction:
        prediction = self.seen[self.row].prediction
        assert prediction is not None
        return prediction

    @property
    def pixels(self) -> int:
        return self.frame.camera.width * self.frame.camera.height

    @cached_property
    def batch(self) -> FrameBatch:
        """What the network sees."""
        assert isinstance(self.model, NetworkModel)
        return to_batch(self.frame, working_size(self.frame.camera, self.model.rows)).to(self.model.device)

    @cached_property
    def closed_batch(self) -> FrameBatch:
        """What the closed form sees."""
        rows = min(_CLOSED_FORM_ROWS, self.frame.camera.height)
        batch = to_batch(self.frame, working_size(self.frame.camera, rows))
        return batch.to(self.device)

    @property
    def device(self) -> torch.device:
        return self.model.device if isinstance(self.model, NetworkModel) else torch.device("cpu")

    # ---- alignment

    @cached_property
    def alone(self) -> list[AlignedKeyframe]:
        """Keyframes that are aligned by themselves; those that are not trusted are left out."""
        pairs = zip(self.submap.keyframes, self.seen, strict=True)
        found = [align_alone(keyframe, self.submap, seen, self.config.alignment) for keyframe, seen in pairs]
        return [each for each in found if each.alignment.ok]

    @cached_property
    def shared(self) -> np.ndarray:
        """How many points two keyframes of `alone` share (n, n)."""
        names = {each.keyframe.name for each in self.alone}
        rows = [i for i, keyframe in enumerate(self.submap.keyframes) if keyframe.name in names]
        return covisibility(self.submap)[np.ix_(rows, rows)]

    @cached_property
    def together(self) -> list[AlignedKeyframe]:
        return align_together(self.alone, self.shared, self.config)

    @cached_property
    def aligned(self) -> AlignedKeyframe:
        """The keyframe that is timed, or the next one that is aligned."""
        names = [each.keyframe.name for each in self.together]
        return self.together[names.index(self.keyframe.name) if self.keyframe.name in names else len(names) // 2]

    @property
    def aligned_view(self) -> View:
        assert self.aligned.view is not None
        return self.aligned.view

    @property
    def bend(self) -> Bend:
        assert self.aligned.bend is not None
        return self.aligned.bend

    @property
    def observed(self) -> ObservedDistances:
        assert self.aligned.observed is not None
        return self.aligned.observed

    @property
    def unknowns(self) -> int:
        """Of one keyframe."""
        return len(self.config.bending.precision)

    @cached_property
    def overlaps(self) -> list[int]:
        """Pixels that both keyframes of each pair see, at the scales that a first round begins with."""
        views = [each.view for each in self.alone if each.view is not None]
        bends = [unbent(view, self.config.bending) for view in views]
        counts = []
        for i, j in compared_pairs(self.shared, self.config.agreement.neighbours):
            view, x = views[i], views[i].grid(self.config.agreement.samples)
            rays, _ = view.keyframe.camera.unproject(x * bends[i].image_size)
            log_predicted, _ = view.at(x)
            found = gap_between(view, views[j], bends[j], rays, log_predicted + bends[i].along(x, log_predicted))
            counts.append(int((found.known & (np.abs(found.gap) < self.config.agreement.max_gap)).sum()))
        return counts

    # ---- the judge

    @cached_property
    def method(self) -> Method:
        """How hidden points are judged, in one round."""
        return Method(self.config.alignment, replace(self.config.agreement, rounds=1), self.config.bending)

    @cached_property
    def fold(self) -> np.ndarray:
        """Of each point that the keyframe observes."""
        folds = submap_folds(self.submap, self.config.judge.folds, self.config.judge.seed)
        result: np.ndarray = folds[self.submap.rows_of(self.observed.point_ids)[0]]
        return result

    @cached_property
    def looks(self) -> list[Look]:
        """The keyframe's own, and those that it is compared with."""
        rows = [self.row, *parallax_neighbours(self.submap, self.config.judge.parallax)[self.row]]
        width = self.config.judge.parallax.width
        found = []
        for row in rows:
            frame = self.seen[row].frame
            assert frame is not None
            found.append(Look.of(self.submap.keyframes[row], frame, width))
        return found

    @cached_property
    def guess(self) -> np.ndarray:
        """Distance about each pixel of the keyframe's look."""
        return guessed(self.looks[0].keyframe, self.submap)

    @cached_property
    def small_prediction(self) -> DepthPrediction:
        """The prediction at the size of the look."""
        return shrunk(self.prediction, self.looks[0].keyframe.camera)

    # ---- fusion

    @cached_property
    def applied(self) -> DepthPrediction:
        """The keyframe's depth in map units, where it is expected to be right."""
        alignment = self.aligned.alignment
        return sure(alignment.applied(self.prediction), alignment.range_90, self.frame.image, self.config.fusion)

    @property
    def far(self) -> float:
        return self.config.fusion.far * self.aligned.alignment.range_90

    @cached_property
    def view(self) -> SurfaceView:
        return surface_view(self.applied, self.frame.image, self.config.rectify, self.far)

    @cached_property
    def volume(self) -> TsdfVolume:
        """A volume that holds the keyframe."""
        volume = TsdfVolume(self.config.fusion.voxel_for(self.submap), self.config.fusion)
        volume.integrate(self.view, self.keyframe.cam_from_map)
        return volume

    @property
    def blocks(self) -> int:
        return len(self.volume.places)

    @property
    def voxels(self) -> int:
        return self.blocks * BLOCK**3

    @cached_property
    def plain_depth(self) -> tuple[np.ndarray, np.ndarray, Pinhole]:
        return undistorted(self.applied, self.frame.image, self.far)

    @cached_property
    def plain_volume(self) -> PlainTsdf:
        """Open3D's, with the same voxels, that holds the same keyframe."""
        volume = PlainTsdf(self.volume.voxel, self.config.fusion.truncation)
        volume.integrate(*self.plain_depth, self.keyframe.cam_from_map)
        return volume

    # ---- the whole

    @cached_property
    def gallery(self) -> Gallery:
        return Gallery(SparseMap((self.submap,), "speed"))

    @cached_property
    def result(self) -> SubmapResult:
        """Of the whole map."""
        return densify_submap(self.submap, self.frames, self.model, self.config, self.gallery)

    @cached_property
    def truth(self) -> Truth:
        return read_truth(self.frames)

    @cached_property
    def wall(self) -> TrueSurface:
        """Every so many of the true points, which are enough to judge a surface's speed by."""
        assert self.truth.surface is not None
        return TrueSurface(self.truth.surface.cloud[::_EVALUATED], "of the colon")

    @cached_property
    def true_from_map(self) -> Similarity:
        keyframes = self.submap.keyframes
        return fit_similarity(
            np.stack([k.center for k in keyframes]),
            np.stack([self.truth.poses[k.number][:3, 3] for k in keyframes]),
        )

    @cached_property
    def vertices_mm(self) -> np.ndarray:
        return self.true_from_map.apply(self.result.dense.vertices)

    def page(self, file: Path) -> None:
        """Writes the report of the whole map."""
        densify_page("Speed", [self.result], self.gallery, []).write(file)

    @cached_property
    def page_bytes(self) -> bytes:
        """Of that report."""
        with TemporaryDirectory() as folder:
            self.page(Path(folder) / "report.html")
            return (Path(folder) / "report.html").read_bytes()
