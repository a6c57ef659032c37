"""Depth errors of a folder of predictions against a sequence with true depth, frame by frame.

Units, alignment and mask are in the answer. Frames are taken by their number: their order on disk changes nothing.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from densify.evaluation.depth_files import DepthReading
from densify.evaluation.errors import compare_depth, true_depth
from densify.evaluation.records import EDGES_MM, DepthFigures, DepthJudged, Evaluation
from densify.evaluation.truth import shared_frames
from lightdepth.datasets import FrameSequence
from lightdepth.errors import InputError
from lightdepth.frame import Frame
from lightdepth.reporting.progress import counted_through


def judge_depth(
    folder: Path,
    truth: FrameSequence,
    max_depth_mm: float = 100.0,
    common: bool = False,
    reading: DepthReading = DepthReading(),
) -> Evaluation[DepthJudged]:
    """Depth errors of a predictions folder: per frame and their mean, under every alignment. `reading` says what its
    files are, where another program made them.

    Predictions of frames that the truth has not are refused, with the frames that match, unless only the `common` ones
    are wanted. Frames without true depth are skipped, and named.
    """
    from lightdepth.metrics import ALIGNMENTS  # brings torchmetrics, which takes seconds to import

    files = reading.files(folder)
    numbers = shared_frames(files, truth.numbers, "predictions", truth.source, common)
    rows: dict[str, DepthFigures] = {}
    skipped: dict[str, str] = {}
    within: dict[str, list[np.ndarray]] = {name: [] for name in ALIGNMENTS}
    units = set()
    for number in counted_through(numbers, "Judging depth"):
        frame = truth.by_number(number)
        assert frame is not None
        prediction = reading.read(files[number], frame.camera)
        reason = _no_depth(frame, max_depth_mm)
        if reason:
            skipped[prediction.name] = reason
            continue
        found = compare_depth(prediction, frame, max_depth_mm)
        rows[prediction.name] = DepthFigures(
            found.errors(ALIGNMENTS), int(found.valid.sum()), found.share_of_image, found.share_of_truth
        )
        for alignment, curves in within.items():
            curves.append(found.within(EDGES_MM, alignment))
        units.add(prediction.unit)
    if not rows:
        raise InputError(
            truth.source, "no frame has valid true depth", f"the first reason: {next(iter(skipped.values()))}"
        )
    judged = DepthJudged(
        predicted_unit=", ".join(sorted(units)),
        alignment=ALIGNMENTS,
        max_depth_mm=max_depth_mm,
        frames_of_truth=len(truth),
        frames_predicted=len(files),
        mean=DepthFigures.mean(list(rows.values())),
        frames=rows,
        skipped=skipped,
    )
    return Evaluation(judged, {name: np.mean(curves, 0) for name, curves in within.items()})


def _no_depth(frame: Frame, max_depth_mm: float) -> str:
    """Why a frame has no depth to judge by; empty where it has."""
    if frame.true_distance is None:
        return f"{frame.name}: no true depth"
    if not true_depth(frame, max_depth_mm)[1].any():
        return f"{frame.name}: the true depth is invalid everywhere (0, or at least {max_depth_mm:g} mm)"
    return ""
