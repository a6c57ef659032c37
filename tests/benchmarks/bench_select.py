"""Precision and recall of the kept frames on colons with bad stretches, beside keeping all. Run by `make bench`.

SIFT_NODES was calibrated on seeds 100 to 107 (`python tests/benchmarks/bench_select.py` prints that table anew); the
seeds judged here calibrated nothing.
"""

import sys
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1]))
from bad_stretches import Stretches, bad_stretches

from lightdepth.tube import lens
from train.selecting.covisibility import SIFT_NODES, NodeRules, select_by_matching
from train.selecting.matching import OrientationDescriptor, SiftMatcher

# seed, lens, size, frames, mm a frame
CALIBRATION = [
    (100, "c3vd", (320, 256), 120, 1.5),
    (101, "fisheye", (320, 256), 120, 1.5),
    (102, "pinhole", (320, 256), 120, 1.5),
    (103, "c3vd", (320, 256), 120, 3.0),
    (104, "fisheye", (320, 256), 120, 3.0),
    (105, "pinhole", (320, 256), 150, 0.3),
    (106, "c3vd", (320, 256), 150, 0.3),
    (107, "fisheye", (480, 384), 120, 2.0),
]
JUDGED = [
    (220, "c3vd", (320, 256), 100, 1.5),
    (221, "fisheye", (320, 256), 100, 2.0),
    (222, "pinhole", (320, 256), 100, 2.5),
    (223, "c3vd", (320, 256), 120, 0.3),
    (224, "fisheye", (320, 256), 100, 3.0),
    (225, "pinhole", (400, 320), 100, 1.0),
]
TRIED: dict[str, tuple[float, ...]] = {
    "min_matches": (5, 10, 15, 20, 30, 40, 60),
    "min_spread": (0.0, 0.1, 0.2, 0.3),
    "similarity": (0.8, 0.9, 0.93, 0.96, 0.98),
    "blur": (0.0, 0.2, 0.3, 0.4, 0.5, 0.6),
    "max_skipped": (0, 1, 2, 4, 7),
    "max_views": (9, 29),
    "min_views": (2, 3, 5),
    "min_frames": (1, 2, 4),
}


class Remembered:
    """Descriptor and matcher that look at each frame, and at each pair of frames, once for all rules."""

    def __init__(self, stretches: Stretches):
        self.matcher, describe = SiftMatcher(), OrientationDescriptor()
        self._described = {frame.name: describe(frame) for frame in stretches.frames}
        self._kept = {frame.name: self.matcher.keep(frame) for frame in stretches.frames}
        self._pairs: dict = {}

    def describe(self, frame):
        return self._described[frame.name]

    def keep(self, frame):
        return self._kept[frame.name]

    def count(self, kept):
        return self.matcher.count(kept)

    def agree(self, one, other):
        key = id(one), id(other)
        if key not in self._pairs:
            self._pairs[key] = self.matcher.agree(one, other)
        return self._pairs[key]


def precision_and_recall(stretches: Stretches, matcher, describe, rules: NodeRules) -> tuple[float, float]:
    names = [frame.name for frame in stretches.frames]
    verdicts = select_by_matching(stretches.frames, names, describe, matcher, rules)
    kept, good = np.array([v.kept for v in verdicts]), stretches.good
    both = (kept & good).sum()
    return both / max(1, kept.sum()), both / good.sum()


@pytest.mark.parametrize("seed, kind, size, count, speed", JUDGED)
def test_kept_frames_are_the_good_ones(seed, kind, size, count, speed):
    cv2.setNumThreads(1)
    stretches = bad_stretches(seed, lens(kind, *size), count, speed)
    start = time.process_time()
    precision, recall = precision_and_recall(stretches, SiftMatcher(), OrientationDescriptor(), SIFT_NODES)
    rate = count / (time.process_time() - start)
    print(
        f"\nseed {seed}, {kind}, {size[0]}x{size[1]}, {speed} mm a frame: precision {precision:.3f} "
        f"(all kept: {stretches.good.mean():.3f}), recall {recall:.3f}, {rate:.0f} frames a second on one core"
    )
    assert precision >= 0.9 and recall >= 0.9


def calibrate() -> None:
    """What each setting does to the calibration sequences, the others at their defaults: mean and least."""
    cv2.setNumThreads(1)
    remembered = []
    for seed, kind, size, count, speed in CALIBRATION:
        stretches = bad_stretches(seed, lens(kind, *size), count, speed)
        remembered.append((stretches, Remembered(stretches)))
    print("| setting | precision, mean | least | recall, mean | least |\n|---|---|---|---|---|")
    for name, values in TRIED.items():
        for value in values:
            rules = replace(SIFT_NODES, **{name: value})
            rows = np.array([precision_and_recall(s, r, r.describe, rules) for s, r in remembered])
            mean, least = rows.mean(0), rows.min(0)
            print(f"| {name} {value} | {mean[0]:.3f} | {least[0]:.3f} | {mean[1]:.3f} | {least[1]:.3f} |")


if __name__ == "__main__":
    calibrate()
