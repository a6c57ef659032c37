"""Depth frame by frame on the judge's twelve colons (lightdepth.judge_colons), beside the blurred closed form.

Errors are those of lightdepth.metrics after the median scale of each frame, in the mean over a colon's frames; a row's
figures are the mean over its colons, and how many of these are below the closed form and below the bars that networks
are held to. Intervals that a model states for its distance are judged by the share of pixels inside.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import numpy as np

from densify.evaluation.errors import compare_depth
from densify.evaluation.tables import Table
from lightdepth.datasets import FrameSequence, read_folder, write_folder
from lightdepth.errors import InputError
from lightdepth.files.images import to_bgr8, write_image
from lightdepth.files.schema import read_json
from lightdepth.frame import Frame
from lightdepth.judge_colons import JudgeColon, judge_frames
from lightdepth.judge_colons.colons import STRONG, VERSION
from lightdepth.models import DepthModel
from lightdepth.uncertainty import LEVELS, Doubted, coverage, doubted

ERRORS = {"abs_rel": "AbsRel", "rmse_mm": "RMSE mm", "medae_mm": "median error mm"}
BARS = {"abs_rel": 0.8, "rmse_mm": 0.9, "medae_mm": 0.8}
"""Shares of the closed form's errors that a network is to stay below where light bounces strongly."""
BASELINE = "decline"
MAX_DEPTH_MM = 100.0
UNIT = "mm, abs_rel and shares of 1; depth along the axis, times the median of true over predicted in each frame"
ABOUT = "colon.json"
_SHOWN = 6  # frames of a colon in the picture


@dataclass(frozen=True)
class ColonFigures:
    """One model on one colon, means over its frames."""

    colon: str
    model: str
    strong: bool
    errors: Mapping[str, float]
    share_of_truth: float
    """share of the true depth below MAX_DEPTH_MM that was judged"""
    coverage: tuple[float, ...] | None
    """share of pixels inside the intervals of LEVELS; None where the model states none"""


def write_colon(colon: JudgeColon, folder: Path, progress: Callable[[], None]) -> list[Path]:
    """Makes a colon's frames as a sequence with truth, and what the file says besides: the wall's reflectance, as
    pictures of 16 bits (65535 reflects all), and colon.json. Gives the files."""
    made = judge_frames(colon, progress)
    write_folder([one.frame for one in made], folder)
    (folder / "truth" / "reflectance").mkdir()
    for one in made:
        picture = np.rint(65535 * one.reflectance[..., ::-1]).astype(np.uint16)
        write_image(folder / "truth" / "reflectance" / f"{one.frame.name}.png", picture)
    (folder / ABOUT).write_text(json.dumps(about(colon), indent=1) + "\n", encoding="utf-8")
    return sorted(path for path in folder.rglob("*") if path.is_file())


def about(colon: JudgeColon) -> dict[str, object]:
    """What colon.json says."""
    return {"kind": "judge colon", "version": VERSION, **asdict(colon), "size": list(colon.size)}


def read_colon(colon: JudgeColon, folder: Path) -> FrameSequence:
    """The frames that `write_colon` made. Raises InputError where the folder holds another colon, or of another
    version."""
    if read_json(folder / ABOUT) != about(colon):
        raise InputError(
            folder / ABOUT, f"it is not {colon.name} of version {VERSION}", "leave out --colons: they are made anew"
        )
    return read_folder(folder)


def judged(colon: JudgeColon, frames: Sequence[Frame], models: Sequence[DepthModel]) -> list[ColonFigures]:
    """Each model's figures on a colon."""
    rows = []
    for model in models:
        errors, shares, doubts = [], [], []
        for frame in frames:
            prediction = model(frame)
            compared = compare_depth(prediction, frame, MAX_DEPTH_MM)
            found = compared.errors(["median"])
            errors.append([found[f"{name}_median"] for name in ERRORS])
            shares.append(compared.share_of_truth)
            if prediction.uncertainty is not None and frame.true_distance is not None:
                one = doubted(prediction.distance, prediction.uncertainty, frame.true_distance, compared.valid)
                doubts += [] if one is None else [one]
        rows.append(_row(colon, model.name, errors, shares, doubts))
    return rows


def _row(
    colon: JudgeColon, model: str, errors: list[list[float]], shares: list[float], doubts: list[Doubted]
) -> ColonFigures:
    means = dict(zip(ERRORS, np.mean(errors, 0).tolist(), strict=True))
    inside = tuple(map(float, coverage(doubts))) if doubts else None
    return ColonFigures(colon.name, model, colon.strong, means, float(np.mean(shares)), inside)


def record(rows: Sequence[ColonFigures]) -> dict[str, object]:
    """What per-frame.json says."""
    return {
        "kind": "bench per-frame",
        "colons_version": VERSION,
        "unit": UNIT,
        "max_depth_mm": MAX_DEPTH_MM,
        "levels": LEVELS,
        "bars": BARS,
        "rows": [asdict(row) for row in rows],
    }


def tables(rows: Sequence[ColonFigures]) -> list[Table]:
    """Means by bounce, each colon's ratio to the closed form, and the coverage of stated intervals."""
    models = [name for name in dict.fromkeys(row.model for row in rows) if name != BASELINE]
    return [
        *(_means(rows, strong) for strong in (True, False) if _of(rows, BASELINE, strong)),
        _ratios(rows, models),
        *_intervals(rows, models),
    ]


def _of(rows: Sequence[ColonFigures], model: str, strong: bool | None = None) -> list[ColonFigures]:
    return [row for row in rows if row.model == model and strong in (None, row.strong)]


def _means(rows: Sequence[ColonFigures], strong: bool) -> Table:
    base, found = _of(rows, BASELINE, strong), []
    for model in dict.fromkeys(row.model for row in rows):
        mine = _of(rows, model, strong)
        cells: list[object] = [model]
        for name in ERRORS:
            values, plain = (np.array([row.errors[name] for row in of]) for of in (mine, base))
            cells += [float(values.mean()), float(values.mean() / plain.mean())]
            ratios = values / plain
            cells.append(f"{int((ratios < 1).sum())}, {int((ratios <= BARS[name]).sum())} of {len(ratios)}")
        found.append([*cells, float(np.mean([row.share_of_truth for row in mine]))])
    titles = [heading for title in ERRORS.values() for heading in (title, "ratio", "below 1, bar")]
    bounce = f"strong bounce (reflectance above {STRONG:g})" if strong else f"weak bounce (up to {STRONG:g})"
    bars = ", ".join(f"{title} {BARS[name]:g}" for name, title in ERRORS.items())
    return Table(
        f"{bounce}: {len(base)} colons, mean over colons; {UNIT}. Ratios are of the means, to the closed form's; then "
        f"on how many colons the ratio is below 1, and at most the bar ({bars})",
        ["model", *titles, "judged share"],
        found,
    )


def _ratios(rows: Sequence[ColonFigures], models: Sequence[str]) -> Table:
    found: list[list[object]] = []
    for base in _of(rows, BASELINE):
        cells: list[object] = [base.colon, "strong" if base.strong else "weak"]
        cells += [" / ".join(f"{base.errors[name]:.3f}" for name in ERRORS)]
        for model in models:
            (mine,) = (row for row in _of(rows, model) if row.colon == base.colon)
            cells.append(" / ".join(f"{mine.errors[name] / base.errors[name]:.2f}" for name in ERRORS))
        found.append(cells)
    what = " / ".join(ERRORS.values())
    return Table(
        f"each colon: {what} of the closed form, and ratios to them", ["colon", "bounce", BASELINE, *models], found
    )


def _intervals(rows: Sequence[ColonFigures], models: Sequence[str]) -> list[Table]:
    found = []
    for model in models:
        for strong, bounce in ((True, "strong"), (False, "weak"), (None, "all")):
            stated = [row.coverage for row in _of(rows, model, strong) if row.coverage is not None]
            if stated:
                found.append([model, bounce, *(f"{100 * share:.0f} %" for share in np.mean(stated, 0))])
    headers = ["model", "bounce", *(f"{100 * level:.0f} %" for level in LEVELS)]
    title = "share of pixels inside the stated intervals: mean over colons, each frame's median scale taken out"
    return [Table(title, headers, found)] if found else []


def contact_sheet(sequences: Sequence[FrameSequence]) -> np.ndarray:
    """Frames of each colon in a row, 8-bit BGR, below them the true distance up to 100 mm."""
    rows = []
    for sequence in sequences:
        shown = []
        for i in np.linspace(0, len(sequence) - 1, _SHOWN).round().astype(int).tolist():
            frame = sequence[i]
            far = np.clip(frame.true_distance / MAX_DEPTH_MM, 0, 1) if frame.true_distance is not None else 0
            coloured = cv2.applyColorMap(np.rint(255 * np.asarray(far)).astype(np.uint8), cv2.COLORMAP_TURBO)
            both = (to_bgr8(frame.image), coloured)
            shown.append(np.concatenate([cv2.resize(p, (160, 128), interpolation=cv2.INTER_AREA) for p in both]))
        rows.append(np.concatenate(shown, 1))
    return np.concatenate(rows)
