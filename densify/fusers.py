"""Aligned keyframes into one surface, by either recipe; what each of them contributed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Protocol

import numpy as np

from densify.aligned import AlignedKeyframe
from densify.alignment import Alignment
from densify.config import DensifyConfig, MethodConfig
from densify.contradiction import share_at
from densify.coverage import Given, with_contributions
from densify.dense_map import DenseMap
from densify.expected import expected_share
from densify.fusion.chosen import volume_on
from densify.fusion.plain import PlainTsdf, undistorted
from densify.fusion.rectify import SurfaceView, surface_view
from densify.fusion.volume import FusionConfig
from densify.judging.images import Seen
from densify.predictions import Predictor, SeenKeyframe
from lightdepth.models import NetworkModel
from lightdepth.prediction import DepthPrediction
from lightdepth.sparse_map import Submap


class Fuser(Protocol):
    """One surface in the making."""

    def add(self, aligned: AlignedKeyframe, seen: SeenKeyframe) -> None:
        """Fuses a keyframe whose alignment is ok, but for its contradicted pixels."""

    def dense_map(self, submap: Submap, alignments: tuple[Alignment, ...], seen: Mapping[str, Seen]) -> DenseMap:
        """The surface as it is now; `seen` is what the keyframes' images tell of distances, by name."""


def fuser_for(submap: Submap, config: DensifyConfig, model: Predictor) -> Fuser:
    """An empty surface of the recipe, with voxels that suit the submap, on the device that the model runs on."""
    voxel = config.fusion.voxel_for(submap)
    return PaperFuser(voxel, config) if config.recipe == "paper" else FullFuser(voxel, config, device_of(model))


def device_of(model: Predictor) -> str:
    """Where surfaces are fused: where the model's network runs; on the processor without one."""
    return str(model.device) if isinstance(model, NetworkModel) else "cpu"


def view_to_fuse(
    alignment: Alignment,
    prediction: DepthPrediction,
    image: np.ndarray,
    config: MethodConfig,
    stays: np.ndarray | None = None,
) -> SurfaceView:
    """A keyframe's depth in map units, rectified, as far as the fusion reaches and where it is expected to be right.
    `stays` (h, w), coarse, is the share of its weight that a pixel keeps; None is all of it."""
    taken = sure(alignment.applied(prediction), alignment.range_90, image, config.fusion)
    return _rectified(alignment, taken, image, config, stays)


def sure(applied: DepthPrediction, reach: float, image: np.ndarray, config: FusionConfig) -> DepthPrediction:
    """A prediction in map units, less the pixels that are expected to err by more than the fusion takes; `reach` is the
    distance within which 90 % of the keyframe's inliers lie."""
    error = expected_share(applied, reach, image)
    return replace(applied, valid=applied.valid & (100 * error <= config.max_error))


def _rectified(
    alignment: Alignment,
    applied: DepthPrediction,
    image: np.ndarray,
    config: MethodConfig,
    stays: np.ndarray | None,
) -> SurfaceView:
    share = None if stays is None else share_at(stays, applied.valid.shape)
    return surface_view(applied, image, config.rectify, config.fusion.far * alignment.range_90, share)


class FullFuser:
    """Rectified wide-angle views into a weighted volume on a device, as PyTorch names it. `voxel` in map units."""

    def __init__(self, voxel: float, config: DensifyConfig, device: str = "cpu") -> None:
        self._config, self._volume = config, volume_on(device, voxel, config.fusion)
        self._given: dict[str, Given] = {}
        self._unsure: dict[str, float] = {}

    def add(self, aligned: AlignedKeyframe, seen: SeenKeyframe) -> None:
        assert seen.frame is not None and seen.prediction is not None
        prediction, image, name = seen.prediction, seen.frame.image, aligned.keyframe.name
        applied = aligned.alignment.applied(prediction)
        taken = sure(applied, aligned.alignment.range_90, image, self._config.fusion)
        view = _rectified(aligned.alignment, taken, image, self._config, aligned.stays)
        self._volume.integrate(view, aligned.keyframe.cam_from_map)
        self._given[name] = Given.of(view, prediction)
        self._unsure[name] = 1 - int(taken.valid.sum()) / max(int(prediction.valid.sum()), 1)

    def dense_map(self, submap: Submap, alignments: tuple[Alignment, ...], seen: Mapping[str, Seen]) -> DenseMap:
        found = with_contributions(DenseMap.of(self._volume, submap, alignments), self._given, seen)
        return replace(found, unsure_share=float(np.mean(list(self._unsure.values() or [0.0]))))


class PaperFuser:
    """One undistorted pinhole image per keyframe into Open3D's volume. `voxel` in map units."""

    def __init__(self, voxel: float, config: DensifyConfig) -> None:
        self._far, self._voxel = config.fusion.far, voxel
        self._volume = PlainTsdf(voxel, config.fusion.truncation)

    def add(self, aligned: AlignedKeyframe, seen: SeenKeyframe) -> None:
        assert seen.frame is not None and seen.prediction is not None
        alignment = aligned.alignment
        depth = undistorted(alignment.applied(seen.prediction), seen.frame.image, self._far * alignment.range_90)
        self._volume.integrate(*depth, aligned.keyframe.cam_from_map)

    def dense_map(self, submap: Submap, alignments: tuple[Alignment, ...], seen: Mapping[str, Seen]) -> DenseMap:
        return DenseMap(submap, *self._volume.extract_mesh(), alignments, self._voxel)
