"""How dense maps are made: the settings of every step, together."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Annotated, Literal

from densify.agreement import AgreementConfig
from densify.alignment import AlignmentConfig
from densify.bending import BendingConfig
from densify.contradiction import ContradictionConfig
from densify.coverage import CoverageConfig
from densify.fusion.rectify import RectifyConfig
from densify.fusion.volume import FusionConfig
from densify.gating import GateConfig
from densify.judging.ahead import AheadConfig
from densify.judging.config import JudgeConfig
from lightdepth.errors import InputError
from lightdepth.ranges import at_least, checked

Recipe = Literal["full", "paper"]


@dataclass(frozen=True)
class _FullOnly:
    """What the paper's recipe has no use for, as it is left out."""

    agreement: AgreementConfig = field(default_factory=AgreementConfig)
    bending: BendingConfig = field(default_factory=BendingConfig)
    contradiction: ContradictionConfig = field(default_factory=ContradictionConfig)
    rectify: RectifyConfig = field(default_factory=RectifyConfig)


_LEFT_OUT = _FullOnly()

LIVE_FUSION = FusionConfig(voxels_per_distance=35.0)
"""Two thirds as fine as densify's, for two thirds of the time. On six colons the surface's median error is 4 % smaller,
its RMS 1.5 % smaller, and what lies between truth and surface 2.4 % larger than at 52 voxels."""


@dataclass(frozen=True)
class MethodConfig:
    """The steps that every way of densifying has."""

    alignment: AlignmentConfig = field(default_factory=AlignmentConfig)
    """when a keyframe's scale is found and trusted"""
    agreement: AgreementConfig = field(default_factory=AgreementConfig)
    """how keyframes are fitted together, beyond one scale each (--agreement.on false leaves that out)"""
    bending: BendingConfig = field(default_factory=BendingConfig)
    """how depth may bend towards the map's points (--bending.on false switches it off)"""
    rectify: RectifyConfig = field(default_factory=RectifyConfig)
    """which predicted pixels are fused, and how finely"""
    fusion: FusionConfig = field(default_factory=FusionConfig)
    """resolution and reach of the surface"""


@dataclass(frozen=True)
class LiveConfig(MethodConfig):
    """How a live surface is made: each keyframe is bent by its own points alone, and none contradicts another."""

    fusion: FusionConfig = LIVE_FUSION
    """resolution and reach of the surface"""
    coverage: CoverageConfig = field(default_factory=CoverageConfig)
    """when wall counts as seen well"""
    judge: AheadConfig = field(default_factory=AheadConfig)
    """whether points that come later judge the surface (--judge.on false leaves that out)"""


@dataclass(frozen=True)
class OfflineConfig(MethodConfig):
    """The steps of a map that is finished: its keyframes are all there, so that nearer ones can contradict others."""

    contradiction: ContradictionConfig = field(default_factory=ContradictionConfig)
    """which pixels are left out because nearer keyframes contradict them (--contradiction.on false keeps them)"""


@dataclass(frozen=True)
@checked
class DensifyConfig(OfflineConfig):
    """How the dense maps of a finished sparse map are made.

    The recipe "paper" is the paper's: each keyframe's LMedS scale, one undistorted pinhole image, plain TSDF. It has no
    agreement, bending, contradiction or rectification; settings of these raise InputError under it.
    """

    coverage: CoverageConfig = field(default_factory=CoverageConfig)
    """when wall counts as seen well"""
    judge: JudgeConfig = field(default_factory=JudgeConfig)
    """how the result is judged, and bends that make it worse are undone (--judge.on false leaves that out)"""
    gate: GateConfig = field(default_factory=GateConfig)
    """which keyframes are doubted as light says little of their depth (--gate.on true leaves them out)"""
    recipe: Recipe = "full"
    """How dense maps are made: full, with all steps below, or paper, as published: one LMedS scale per keyframe, one
    undistorted pinhole image, a plain TSDF. To what is published, paper adds the gates of alignment, which leave out
    keyframes whose scale is unsure, and fusion.far, beyond which nothing is fused; report and run.json list them, with
    the values that open them. It refuses settings of agreement, bending, contradiction and rectify, which it does not
    have, and ignores coverage, gate.on, fusion.min_views, fusion.front and fusion.max_error."""
    keep_mb: Annotated[float, at_least(0)] = 1000.0
    """Memory, megabytes, for the images and predictions of a submap that are kept from one pass over it to the next;
    what does not fit is read and predicted again. More save time and change nothing else."""

    def __post_init__(self) -> None:
        if self.recipe not in ("full", "paper"):
            raise InputError("recipe", f"{self.recipe!r} is not known", "expected full or paper")
        unused = [name for name, left_out in vars(_LEFT_OUT).items() if getattr(self, name) != left_out]
        if self.recipe == "paper" and unused:
            raise InputError(
                "recipe paper", f"it has no {unused[0]}", "leave out its settings, or take the recipe full"
            )

    def under(self, recipe: Recipe) -> DensifyConfig:
        """The same settings under a recipe, less those that it has no use for."""
        if recipe != "paper":
            return replace(self, recipe=recipe)
        return replace(
            self,
            recipe=recipe,
            agreement=_LEFT_OUT.agreement,
            bending=_LEFT_OUT.bending,
            contradiction=_LEFT_OUT.contradiction,
            rectify=_LEFT_OUT.rectify,
        )

    def rigid(self) -> DensifyConfig:
        """The same with one scale for each keyframe: nothing bends."""
        return self if self.recipe == "paper" else replace(self, agreement=replace(self.agreement, on=False))
