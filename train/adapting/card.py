"""Cards in adapting: what is taken from the start's, and what is said in that of the adapted network.

The start's may be of any age, so that what it holds is checked where it is used.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any, get_args

from lightdepth.errors import InputError
from lightdepth.losses import LossConfig
from lightdepth.tube.path import Lens

from ..card import Card
from ..colons import Family, TubeData
from .judging import Verdict

_MAX_FRAMES, _MAX_TRAVEL_MM = 1000, 10_000.0


@dataclass(frozen=True, kw_only=True)
class AdaptedCard(Card):
    """The card of an adapted checkpoint."""

    adapted_from: str
    """name of the checkpoint that it started from"""
    tube: object
    """the colons that the start was trained on, as its card says"""
    replayed: TubeData | None
    """the colons that were replayed, if any"""
    frames: Mapping[str, int]
    """number of frames that it learned from, and that were held out"""
    verdict: Verdict
    """start and adapted network side by side"""

    def text(self, name: str) -> str:
        title, rest = super().text(name).split("\n", 1)
        caution = f"\n{self.verdict.caution}.\n" if self.verdict.caution else ""
        return f"{title}\n\n{self.verdict}.\n{caution}{rest}"

    def record(self) -> dict[str, object]:
        shared = super().record()
        said, errors, version = shared.pop("trained_on"), shared.pop("errors"), shared.pop("version")
        return {
            "trained_on": said,
            "adapted_from": self.adapted_from,
            **shared,
            "tube": self.tube,
            "replayed": None if self.replayed is None else asdict(self.replayed),
            "frames": dict(self.frames),
            "errors": errors,
            "verdict": str(self.verdict),
            "version": version,
        }


def target_loss(card: dict[str, Any], reflectance_known: bool, replayed: bool) -> LossConfig:
    """The loss of a checkpoint's card (the defaults without one), fit for frames without truth: free of gain.

    Terms with truth stay for replayed colons only. Where the card takes each image's calibrated reflectance and the
    target's is not known, it is the default's.
    """
    default = LossConfig()
    try:
        own = LossConfig(**card.get("loss", {}))
    except TypeError as error:
        raise InputError(
            "the checkpoint's card",
            f"it has a loss that is not known here ({error})",
            "was it trained by another version of the program?",
        ) from error
    reflectance = own.reflectance
    if reflectance is None and not reflectance_known:
        reflectance = default.reflectance
    return replace(
        own,
        gain="free",
        reflectance=reflectance,
        photometric=own.photometric or default.photometric,
        self_supervised=own.self_supervised or default.self_supervised,
        supervised=own.supervised if replayed else 0.0,
        uncertainty=0.0,
    )


def source_colons(card: dict[str, Any], scenes: int) -> TubeData:
    """So many colons of the kind that a checkpoint's card says it was trained on; of the default kind without one."""
    own = card.get("tube") or {}
    known: dict[str, Any] = {
        name: tuple(own[name]) if isinstance(own[name], list) else own[name]
        for name in ("frames", "travel", "lenses", "mu", "gamma", "reflectance", "family")
        if isinstance(own, dict) and name in own
    }
    wrong = [name for name, value in known.items() if not _drawable(name, value)]
    if wrong or not isinstance(own, dict):
        raise InputError(
            "the checkpoint's card",
            f"it was trained on colons of a kind that is not known here ({', '.join(wrong) or 'tube'})",
            "--replay 0 does without them",
        )
    return TubeData(scenes=scenes, **known)


def _drawable(name: str, value: object) -> bool:
    """Whether colons can be drawn from what a card says of them: a stranger's may say anything."""
    if name == "frames":
        return isinstance(value, int) and 1 <= value <= _MAX_FRAMES
    if name == "travel":
        return isinstance(value, int | float) and 0 <= value <= _MAX_TRAVEL_MM
    if name == "family":
        return value in get_args(Family)
    if name == "lenses":
        return isinstance(value, tuple) and 0 < len(value) <= 100 and all(one in get_args(Lens) for one in value)
    numbers = value if isinstance(value, tuple) and len(value) == 2 else ()
    return bool(numbers) and all(isinstance(v, int | float) and 0 <= v <= 100 for v in numbers)
