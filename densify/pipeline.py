"""densify(): the paper's method section as code. Predict, observe, align, rectify, fuse; submap by submap."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

from densify.aligned import (
    AlignedKeyframe,
    align_alone,
    align_together,
    uncontradicted_keyframes,
    undoubted,
    unread,
)
from densify.config import DensifyConfig
from densify.coverage import Coverage, coverage, seen_share
from densify.dense_map import DenseMap
from densify.fusers import fuser_for
from densify.judgement import Judge
from densify.judging.verdict import Judgement, Verdict
from densify.predictions import Clock, Predictions, Predictor, SeenKeyframe
from lightdepth.brief import Brief
from lightdepth.datasets import FrameSequence
from lightdepth.errors import InputError
from lightdepth.sparse_map import SparseMap, Submap, covisibility


@dataclass(frozen=True, repr=False)
class SubmapResult(Brief):
    """The dense map of one submap, and what is known of it without truth."""

    dense: DenseMap
    """the surface, and the alignments that it rests on"""
    judgement: Judgement | None = None
    """how well it agrees with what it was not made from, and the verdict; None where nothing was judged"""
    seen_share: float = 0.0
    """share of the masked pixels of the aligned keyframes that look at the surface"""
    seconds: dict[str, float] = field(default_factory=dict)
    """seconds by step, summed over the keyframes"""
    unread: dict[str, str] = field(default_factory=dict)
    """keyframes whose image is missing or unreadable, with the reason"""
    coverage: Coverage | None = None
    """what of the wall was seen; None under the paper's recipe, whose fusion cannot tell"""
    doubts: dict[str, str] = field(default_factory=dict)
    """keyframes whose depth is doubted for want of light's contrast, with the reason; left out or not"""

    @property
    def verdict(self) -> Verdict | None:
        """Whether the surface can be trusted, and what of the wall it shows well; None where nothing was judged."""
        if self.judgement is None:
            return None
        seen_well = None if self.coverage is None else self.coverage.well_share
        return replace(self.judgement.verdict, seen_well=seen_well)


OnKeyframe = Callable[[Submap, AlignedKeyframe, SeenKeyframe], None]
"""Is shown every keyframe as it is done: its submap, its alignment and what that rests on, its image and prediction."""


def densify(
    frames: FrameSequence,
    sparse_map: SparseMap,
    model: Predictor,
    config: DensifyConfig = DensifyConfig(),
    on_keyframe: OnKeyframe | None = None,
) -> list[SubmapResult]:
    """The dense map of every submap. Each keeps its own scale and frame of reference.

    `on_keyframe` is shown every keyframe as it is done (progress, pictures). A submap that cannot be densified has an
    empty surface, and the reason with every keyframe; the others go on.
    """
    return [densify_or_empty(submap, frames, model, config, on_keyframe) for submap in sparse_map.submaps]


def densify_or_empty(
    submap: Submap,
    frames: FrameSequence,
    model: Predictor,
    config: DensifyConfig = DensifyConfig(),
    on_keyframe: OnKeyframe | None = None,
) -> SubmapResult:
    """The dense map of one submap; where there can be none, an empty one with the reason."""
    try:
        return densify_submap(submap, frames, model, config, on_keyframe)
    except InputError as error:
        return SubmapResult(DenseMap.empty(submap, str(error)))


def densify_submap(
    submap: Submap,
    frames: FrameSequence,
    model: Predictor,
    config: DensifyConfig = DensifyConfig(),
    on_keyframe: OnKeyframe | None = None,
) -> SubmapResult:
    """The dense map of one submap, in the order of the paper's method section.

    Each keyframe's distance is predicted and aligned by itself, to the map points that it observed; those that the gate
    for depth doubts may be left out; then all are aligned together, bends that make things worse are undone, and what
    nearer keyframes contradict is left out. What remains is fused into one surface, and judged. Raises InputError where
    no keyframe observes a point.
    """
    clock, fuser = Clock(), fuser_for(submap, config, model)
    judge, shared = Judge(submap, config), covisibility(submap)
    predictions = Predictions(frames, model, config.keep_mb, clock)
    keyframes, doubts = [], {}
    for keyframe in submap.keyframes:
        seen = predictions.of(keyframe)
        if doubt := config.gate.doubt(seen.frame):
            doubts[keyframe.name] = doubt
        with clock("align"):
            keyframes.append(align_alone(keyframe, submap, seen, config.alignment))
        with clock("judge"):
            judge.see(keyframes[-1], seen)
    if config.recipe == "full":
        keyframes = undoubted(keyframes, doubts, config.gate)
        with clock("agree"):
            keyframes = align_together(keyframes, shared, config)
        with clock("judge"):
            keyframes = judge.braked(judge.refined(keyframes, shared))
        with clock("agree"):
            keyframes = uncontradicted_keyframes(keyframes, shared, config.contradiction)
    for i, each in enumerate(keyframes):
        seen = predictions.of(each.keyframe)
        keyframes[i] = each = each if seen.prediction else each.unread(seen.reason)
        if each.alignment.ok:
            with clock("integrate"):
                fuser.add(each, seen)
        if on_keyframe is not None:
            on_keyframe(submap, each, seen)
    with clock("extract"):
        dense = fuser.dense_map(submap, tuple(each.alignment for each in keyframes), judge.told)
    with clock("cover"):
        covered = None if dense.weights is None else coverage(dense, config.coverage)
    with clock("judge"):
        judgement, share = judge.judgement(dense, keyframes), seen_share(dense, frames)
    return SubmapResult(dense, judgement, share, dict(clock), unread(keyframes), covered, doubts)
