"""One colour and one sentence: whether a surface can be trusted, as far as anything but truth can tell."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np

from densify.judging.columns import Columns
from densify.judging.doubts import Doubts
from densify.judging.withheld import Withheld

Colour = Literal["green", "amber", "red"]
COLOURS: tuple[Colour, ...] = get_args(Colour)
"""From the best to the worst."""
Asked = Literal["", "images", "map"]
"""Who a verdict's number is from: the images' parallax, or the map's own points where the images are silent."""

GREEN, RED = 0.07, 0.125
"""Disagreement, as a share of the distance, up to which a surface is green and from which it is red."""
_MISSES = 0.4
_LEAST = 60
_LEAST_SHARE = 0.04
_NO_MERIT = 0.95
_AGAINST = 1.15


@dataclass(frozen=True)
class Judgement:
    """What is known of a submap's surface without truth."""

    blocks: Columns
    """agreement with the map: points of blocks of wall that were hidden from the alignment in turn"""
    drawn: Columns
    """the same with points drawn one by one, which lie beside points that were used: the flattering number"""
    images: Columns
    """agreement with the images: distances by parallax, which nothing was fitted to"""
    hidden: Withheld | None = None
    """the points of `blocks` by what a keyframe was delivered with, its bend but for the finer grid, or one scale"""
    hidden_constant: Withheld | None = None
    """the same points by a constant distance, bent"""
    surface: Withheld | None = None
    """the delivered surface against distances by parallax; None where the images are silent"""
    keyframes: int = 0
    aligned: int = 0
    undone: int = 0
    """keyframes whose bend was undone"""
    lessened: int = 0
    """keyframes that keep a part of their bend"""
    bends: float = 0.0
    """median size of the bends in deviations of their prior; 1 is usual"""
    doubts: Doubts | None = None
    """hidden points with the uncertainty that was predicted of them; None where the model predicts none"""
    asked: bool = True
    """whether the images were asked at all"""

    @property
    def number(self) -> float:
        """The program's own estimate of the surface's error, as a share of the distance: what the images say, or the
        map where they are silent. Not an error: that takes truth."""
        if self.judge == "images" and self.surface is not None:
            met = self.surface.median_met
            return float("inf") if met is None else met
        return self.hidden.median if self.hidden is not None else float("inf")

    @property
    def judge(self) -> Asked:
        """Whose word the number is."""
        return "images" if spoke(self.surface) else "map"

    @property
    def verdict(self) -> Verdict:
        return _verdict(self)

    @property
    def summary(self) -> str:
        """How far the depth of single keyframes, before it is fused, is from hidden blocks of the map, as `evaluate`
        has it, and from the images; with the constant distance's under the same help."""
        mapped = [float("inf") if w is None else w.median for w in (self.hidden, self.hidden_constant)]
        told = f"the depth of single keyframes differs by {_beside(*mapped)} from hidden blocks of the map"
        if self.images.count:
            told += f" and by {_beside(self.images.best, self.images.constant)} from the images"
        return told

    def record(self) -> dict[str, object]:
        """For run.json."""
        told = None if self.surface is None else self.surface.record()
        return {
            "blocks": self.blocks.record(),
            "drawn": self.drawn.record(),
            "images": self.images.record(),
            "hidden": None if self.hidden is None else self.hidden.record(),
            "hidden_constant": None if self.hidden_constant is None else self.hidden_constant.record(),
            "surface": told,
            "number": self.number if np.isfinite(self.number) else None,
            "bends_undone": self.undone,
            "bends_lessened": self.lessened,
            "bend_size": self.bends,
            "uncertainty": None if self.doubts is None else self.doubts.calibration.record(),
        }


@dataclass(frozen=True)
class Verdict:
    """A colour, and the sentence that gives its reasons with figures."""

    colour: Colour
    sentence: str
    number: float = float("inf")
    """share of the distance by which the judge puts the wall from the surface, in the median; infinite where none can
    say"""
    judge: Asked = ""
    """whose word the number is; empty where nobody could be asked"""
    seen_well: float | None = None
    """share of the wall that was seen well (densify.coverage), to which a colour says nothing; None where nothing told
    it"""

    def __str__(self) -> str:
        return self.headline()

    def headline(self, whose: str = "") -> str:
        """The colour, what of the wall was seen well, and the reasons; `whose` names the map where there are
        several."""
        head = f"{self.colour} ({whose})" if whose else self.colour
        if self.seen_well is not None:
            head += f", {self.seen_well:.0%} of {'its' if whose else 'the'} wall seen well"
        return f"{head}: {self.sentence}"


def proposal(j: Judgement) -> str:
    """What could make the map of a surface better, in one sentence; empty where the images do not speak against it.

    That the map's error and not the light's is what they see, they cannot tell: it may help, and is soon tried.
    """
    if not spoke(j.surface):
        return ""
    if j.images.count >= _LEAST and j.images.bent > _AGAINST * j.images.one_scale:
        seen = "its points bend the depth against the images"
    elif j.number > GREEN:
        seen = f"the images put the wall {_share(j.number)} from the surface"
    else:
        return ""
    return f"the map may be at fault ({seen}): --repair-map makes it anew from the images of its keyframes"


def worst(verdicts: Sequence[Verdict]) -> Verdict | None:
    """The verdict on a run: the worst of its submaps', of equal colours the one with the larger number."""
    return max(verdicts, key=lambda v: (COLOURS.index(v.colour), v.number), default=None)


def headline(verdicts: Mapping[int, Verdict], doubts: Sequence[str] = ()) -> str:
    """The verdict on a run in words, of several maps (by id) with the one that it is on; empty where there is none."""
    found = worst(list(verdicts.values()))
    if found is None:
        return ""
    name = next(name for name, verdict in verdicts.items() if verdict is found)
    whose = f"map {name}, the worst of {len(verdicts)}" if len(verdicts) > 1 else ""
    return doubted(found, doubts).headline(whose)


def spoke(surface: Withheld | None) -> bool:
    """Whether the images say enough of a surface to judge it by."""
    return surface is not None and surface.points >= _LEAST


def _by_images(surface: Withheld) -> tuple[str, list[str], list[str]]:
    """What the images say of a surface, and which of it makes it red, and amber."""
    number = float("inf") if surface.median_met is None else surface.median_met
    said = (
        f"the images put the wall {_share(number)} of its distance from the surface (median of {surface.points} pixels)"
    )
    red, amber = ([said], []) if number > RED else ([], [said] if number > GREEN else [])
    if surface.miss > _MISSES:
        amber.append(f"{surface.miss:.0%} of what they see is not on the surface")
    return said, red, amber


def doubted(verdict: Verdict, doubts: Sequence[str]) -> Verdict:
    """The verdict with sentences on what the surface was made of, with any of which it is not green."""
    if not doubts:
        return verdict
    colour: Colour = "red" if verdict.colour == "red" else "amber"
    return replace(verdict, colour=colour, sentence="; ".join([*doubts, verdict.sentence]))


def _verdict(j: Judgement) -> Verdict:
    number = j.number
    if not j.aligned:
        return Verdict("red", "no keyframe could be aligned")
    if j.surface is not None and spoke(j.surface):
        said, red, amber = _by_images(j.surface)
    else:
        said = "the images have too little texture or parallax to judge by"
        said = said if j.asked else "the images were not used (--judge.parallax.on false)"
        said += f"; hidden blocks of the map's wall are {_share(number)} off"
        red, amber = ([], [said]) if number <= RED else ([said], [])
    amber += _few(j.keyframes, j.aligned)
    remarks = _some(j.keyframes, j.aligned)
    light = j.images if j.images.count >= _LEAST else j.blocks
    if j.images.count >= _LEAST and j.images.bent > _AGAINST * j.images.one_scale:
        remarks.append(
            f"the map's points may err together: they bend the depth against the images ({_share(j.images.bent)} off, "
            f"at one scale {_share(j.images.one_scale)})"
        )
    remarks += _no_merit(light)
    colour: Colour = "red" if red else "amber" if amber else "green"
    return Verdict(colour, "; ".join(dict.fromkeys([said, *red, *amber, *remarks])), number, j.judge)


def ahead_verdict(
    columns: Columns, by_points: float, surface: Withheld | None, keyframes: int, aligned: int
) -> Verdict:
    """On a live surface: by the images, as on densify's; where they say nothing, by points that the map measured after
    it, `by_points` being the median share by which they are off.

    Where the map alone judges nothing is green: points and surface may have drifted together.
    """
    if not aligned:
        return Verdict("red", "no keyframe could be aligned")
    few = _few(keyframes, aligned)
    merit = _no_merit(columns) if columns.count >= _LEAST else []
    if surface is not None and spoke(surface):
        said, red, amber = _by_images(surface)
        colour: Colour = "red" if red else "amber" if amber or few else "green"
        number = float("inf") if surface.median_met is None else surface.median_met
        told = [*dict.fromkeys([said, *red, *amber]), *few]
        if columns.count >= _LEAST:
            told.append(f"new points of the map were {_share(by_points)} from the depth before them")
        return Verdict(colour, "; ".join([*told, *merit]), number, "images")
    if columns.count < _LEAST:
        told = [f"{columns.count} new points are too few to judge by, and the images say nothing", *few]
        return Verdict("amber", "; ".join(told))
    said = (
        f"new points of the map are {_share(by_points)} from the depth that was there before them, in the median "
        f"({columns.count} points; a constant distance {_share(columns.constant)})"
    )
    alone = "only the map judged this, not the images"
    colour = "red" if by_points > RED else "amber"
    return Verdict(colour, "; ".join([said, alone, *few, *merit]), by_points, "map")


def _few(keyframes: int, aligned: int) -> list[str]:
    """A reason for amber where most keyframes have no part in the surface."""
    return [f"only {aligned} of {keyframes} keyframes could be aligned"] if 2 * aligned < keyframes else []


def _some(keyframes: int, aligned: int) -> list[str]:
    """A remark where some keyframes have no part in the surface, but not most."""
    return [f"{aligned} of {keyframes} keyframes aligned"] if keyframes <= 2 * aligned < 2 * keyframes else []


def _no_merit(columns: Columns) -> list[str]:
    """A remark where a constant distance does as well."""
    if columns.best < _NO_MERIT * columns.constant:
        return []
    against = f"({_share(columns.constant)} against {_share(columns.best)})"
    return [f"the light adds nothing here: a constant distance does as well {against}"]


def _beside(value: float, constant: float) -> str:
    return f"{_share(value)} (a constant distance by {_share(constant)})"


def _share(value: float) -> str:
    return f"{value:.1%}" if np.isfinite(value) else "infinitely far"
