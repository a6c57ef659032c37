"""Structure from motion on 12 synthetic videos: the share that is mapped and its trajectory error. By `make bench`."""

import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1]))
from sfm_videos import video

from densify.evaluation.errors import rms_ate
from densify.similarity import fit_similarity
from lightdepth.errors import InputError
from lightdepth.sfm.config import SfmConfig
from lightdepth.sfm.reconstruction import SfmMap, sparse_map_from_frames
from lightdepth.sfm.unmapped import summary
from lightdepth.tube import lens

# seed, lens, effect
VIDEOS = [
    (410, "pinhole", ""),
    (411, "fisheye", ""),
    (412, "c3vd", ""),
    (413, "pinhole", "blur"),
    (414, "fisheye", "blur"),
    (415, "pinhole", "specular"),
    (416, "fisheye", "specular"),
    (417, "pinhole", "pause"),
    (418, "fisheye", "pause"),
    (419, "pinhole", "cut"),
    (420, "fisheye", "cut"),
    (421, "pinhole", "dark"),
]


def errors_mm(found: SfmMap, frames) -> list[tuple[int, float]]:
    """Keyframes and RMS ATE [mm] of each submap."""
    true = {f.number: f.true_world_from_cam[:3, 3] for f in frames}
    rows = []
    for submap in found.submaps:
        centers = np.array([k.center for k in submap.keyframes])
        truth = np.array([true[k.number] for k in submap.keyframes])
        rows.append((len(centers), rms_ate(centers, truth, fit_similarity(centers, truth))))
    return rows


@pytest.mark.parametrize("seed, kind, effect", VIDEOS)
def test_a_video_gives_a_map_or_a_reasoned_refusal(seed, kind, effect, config=SfmConfig()):
    frames = video(seed, lens(kind, 320, 256), effect)
    start = time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        try:
            found = sparse_map_from_frames(frames, Path(folder) / "map", config)
        except InputError as error:
            print(f"\n{seed} {kind} {effect or 'plain'}: refused: {error}", flush=True)
            assert effect == "dark"
            return
    share = 1 - len(found.failed) / len(frames)
    parts = ", ".join(f"{n} keyframes ATE {e:.3f} mm" for n, e in errors_mm(found, frames))
    seconds = time.process_time() - start
    print(f"\n{seed} {kind} {effect or 'plain'}: {share:.0%} registered; {parts}; {seconds:.0f} s", end="")
    print(f"; {summary(list(found.failed.values()))}" if found.failed else "", flush=True)
    if effect == "cut":
        assert len(found.submaps) == 2
        assert all(max(k.number for k in s.keyframes) < 12 or s.keyframes[0].number >= 12 for s in found.submaps)
