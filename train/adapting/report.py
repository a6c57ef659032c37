"""The page of an adapted network: start and adapted network side by side, in numbers and in pictures."""

from __future__ import annotations

from collections.abc import Sequence

from lightdepth.frame import Frame, readable
from lightdepth.models import DeclineModel, DepthModel, NetworkModel
from lightdepth.prediction import DepthPrediction
from lightdepth.reporting.figures import colored_distance, jpeg, thumbnail
from lightdepth.reporting.report import Report, Tile

from .judging import Outcome
from .module import Adaptation
from .target import Target, light_text

FILES = {
    "model.safetensors": "the adapted network: --checkpoint takes it",
    "model.md": "its card: what it learned from, and how well it does",
}
"""What the files of a run are, by pattern."""

_SHOWN = 4


class Pictures:
    """Held-out frames spread over time, and what each of several models says of them."""

    def __init__(self, target: Target) -> None:
        held = target.held
        rows = sorted({round(k * (len(held) - 1) / (_SHOWN - 1)) for k in range(_SHOWN)})
        self._frames = list(readable(held, rows))
        self._said: list[list[DepthPrediction]] = [[] for _ in self._frames]
        self.add(DeclineModel(details=False))

    def add(self, model: DepthModel) -> None:
        """Adds what a model says as it is now."""
        for frame, row in zip(self._frames, self._said, strict=True):
            row.append(model(frame))

    def rows(self) -> list[tuple[list[Tile], str]]:
        """Pictures and caption for each frame: closed form, start and adapted network."""
        return [_picture(frame, row) for frame, row in zip(self._frames, self._said, strict=True)]


def _picture(frame: Frame, predictions: Sequence[DepthPrediction]) -> tuple[list[Tile], str]:
    maps = [(p.distance, p.valid) for p in predictions]
    names = ["image", "closed form", "start", "adapted"]
    if frame.true_distance is not None:
        maps.append((frame.true_distance, frame.valid & (frame.true_distance > 0)))
        names.append("truth")
    pictures = [frame.image, *(colored_distance(*m) for m in maps)]
    return [Tile(jpeg(thumbnail(p, 240)), n) for p, n in zip(pictures, names, strict=True)], frame.name


def page(
    target: Target, start: NetworkModel, module: Adaptation, outcome: Outcome, held: int, fitted: str | None
) -> Report:
    """What was adapted and what it came to; `fitted` says what was found where the light was fitted on the map."""
    page = Report(f"{start.name} adapted to {target.source.data}")
    page.text(f"{outcome.verdict}. {outcome.kept(start.name)}.")
    page.text(f"Light of the frames: {light_text(target.light)}." + (f" Light {fitted}." if fitted else ""))
    page.heading(f"Before and after, on {held} frames that were held out")
    headers = ["model"]
    columns: list[list[float | None]] = []
    before, after = outcome.before, outcome.after
    three = (outcome.closed_form, before, after)
    for title, found in (
        ("AbsRel (median-aligned)", [judgement.truth for judgement in three]),
        ("median error at the map's judging points", [judgement.at_wall for judgement in three]),
    ):
        if found[1] is not None:
            headers.append(title)
            columns.append(found)
    for name, title in (("loss", "self-supervised loss"), ("inconsistency", "inconsistency")):
        headers.append(title)
        columns.append([None, before.errors[name], after.errors[name]])
    names = ("closed form", f"start: {start.name}", "adapted")
    page.table(headers, [[name, *row] for name, row in zip(names, zip(*columns, strict=True), strict=True)])
    if outcome.verdict.caution:
        page.text(f"{outcome.verdict.caution}.")
    page.text(
        f"{module.learning} weights learned; anchor {module.anchor:g}, "
        f"{'half of each batch replayed' if module.replay else 'no replay'}; the map "
        f"{_taught_said(module)}. Inconsistency: how much distance changes "
        "in a mirror and in less light. Pictures: the image, and distance by closed form, start and adapted network, "
        "then truth where there is any, each with its own range of colours, near in yellow."
    )
    return page


def _taught_said(module: Adaptation) -> str:
    if module.teacher is None:
        return "taught nothing"
    return "taught with weights " + ", ".join(f"{value:g} ({name})" for name, value in module.map_weights.items())
