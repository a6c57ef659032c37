"""Depth of spoilt frames (lightdepth.judge_colons.corruption), and which of them two gates keep.

Every third frame of a colon is spoilt alone, among its neighbours as they were: the gate of lightdepth.importing, made
for matching, sees it as it would a bad frame of a clip. That of lightdepth.depth_gate, for depth from light, sees it
alone. The error is AbsRel after the median scale; its ratio is to the same frames clean.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from densify.bench.per_frame import MAX_DEPTH_MM
from densify.evaluation.errors import compare_depth
from densify.evaluation.tables import Table
from lightdepth.depth_gate import DepthGate
from lightdepth.errors import InputError
from lightdepth.files.images import to_bgr8
from lightdepth.frame import Frame
from lightdepth.image_quality import Measures, Meter
from lightdepth.importing.selection import KEPT, Choice, selected
from lightdepth.judge_colons import JudgeColon
from lightdepth.judge_colons.colons import VERSION
from lightdepth.judge_colons.corruption import CORRUPTIONS, SEVERITIES, corrupted
from lightdepth.models import DepthModel

EVERY = 3
WORSE = 1.5
"""Times the clean error, from which a frame is better refused."""

NOTHING = 10.0
"""AbsRel of a frame of which a model says nothing."""


@dataclass(frozen=True)
class SpoiltFrame:
    """One spoilt frame: whether `import` keeps it, whether its depth is doubted, and its AbsRel as it was (`clean`) and
    spoilt (NOTHING where nothing of it can be judged)."""

    colon: str
    model: str
    corruption: str
    severity: int
    kept: bool
    doubted: bool
    clean: float
    error: float


def spoilt_frames(colon: JudgeColon, frames: Sequence[Frame], models: Sequence[DepthModel]) -> list[SpoiltFrame]:
    """What each model says of a colon's spoilt frames."""
    every = list(frames)
    gate = Gate(every)
    found = []
    for i in range(0, len(every), EVERY):
        clean = {model.name: _error(model, every[i]) for model in models}
        for kind, corruption in enumerate(CORRUPTIONS):
            for severity in SEVERITIES:
                rng = np.random.default_rng([VERSION, colon.seed, every[i].number, kind, severity])
                bad = corrupted(every[i], corruption, severity, rng)
                kept, doubted = gate.keeps(i, bad), bool(DepthGate().doubt(bad))
                for model in models:
                    errors = clean[model.name], _error(model, bad)
                    found.append(SpoiltFrame(colon.name, model.name, corruption, severity, kept, doubted, *errors))
    return found


def _error(model: DepthModel, frame: Frame) -> float:
    try:
        return compare_depth(model(frame), frame, MAX_DEPTH_MM).errors(["median"])["abs_rel_median"]
    except InputError:  # it is black, or white, all over
        return NOTHING


class Gate:
    """What `import` makes of one frame of a clip that is not as it was."""

    def __init__(self, frames: Sequence[Frame]) -> None:
        self._frames = frames
        self._times = np.array([frame.time or 0.0 for frame in frames])
        self._clean = _measured(frames)

    def keeps(self, row: int, frame: Frame) -> bool:
        """Whether the frame in the place of this row would be kept."""
        beside = _measured([*self._frames[max(row - 1, 0) : row], frame])
        rows = {
            name: np.where(np.arange(len(values)) == row, getattr(beside, name)[-1], values)
            for name, values in vars(self._clean).items()
        }
        return bool(selected(self._times, Measures(**rows), Choice())[row] == KEPT)


def _measured(frames: Sequence[Frame]) -> Measures:
    meter = Meter(frames[0].valid)
    for frame in frames:
        meter.add(np.ascontiguousarray(to_bgr8(frame.image)[..., ::-1]))
    return meter.result()


def spoilt_tables(rows: Sequence[SpoiltFrame]) -> list[Table]:
    """By model and gate, corruptions by severity: ratio on the frames kept, share kept, share of the refused that err
    more."""
    found = []
    for model in dict.fromkeys(row.model for row in rows):
        for gate, kept in _GATES.items():
            lines: list[list[object]] = []
            for corruption in CORRUPTIONS:
                of = [row for row in rows if (row.model, row.corruption) == (model, corruption)]
                cells = [_cell([row for row in of if row.severity == severity], kept) for severity in SEVERITIES]
                lines.append([corruption, *cells])
            title = (
                f"{model}, {gate}: error on the frames kept over the same frames' clean, share kept, share of the "
                f"refused whose error is more than {WORSE:g} times their clean one"
            )
            found.append(Table(title, ["corruption", *(f"severity {s}" for s in SEVERITIES)], lines))
    return found


_GATES: dict[str, Callable[[SpoiltFrame], bool]] = {
    "import's gate (for matching)": lambda row: row.kept,
    "the gate for depth": lambda row: not row.doubted,
}


def _cell(rows: Sequence[SpoiltFrame], keeps: Callable[[SpoiltFrame], bool]) -> str:
    kept, refused = ([row for row in rows if keeps(row) is wanted] for wanted in (True, False))
    ratio = f"{np.mean([r.error for r in kept]) / np.mean([r.clean for r in kept]):.2f}" if kept else "–"
    worse = f"{np.mean([r.error > WORSE * r.clean for r in refused]):.0%}" if refused else "–"
    return f"{ratio}, {len(kept) / len(rows):.0%}, {worse}"
