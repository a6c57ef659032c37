"""Per-image optimisation from the closed form, no training: errors over the closed form's, and the time of a frame.

The realistic colons and errors of bench_depth (seeds 7500-7517 and 7520-7537, 160x128; worked on at 64 rows, 100 steps,
as `predict --refine 100` does), and the real C3VD frame, beside the bundled checkpoints. What the refinement's settings
were chosen on are other colons (7300-7337).
"""

import time

import numpy as np
from bench_depth import errors, frames_of

from lightdepth.checkpoint import bundled, load_model
from lightdepth.datasets import read_c3vd
from lightdepth.refine import RefineConfig, RefinedModel

BAR = (0.88, 0.90, 0.88)


def shown(row: np.ndarray, digits: int) -> str:
    return " / ".join(f"{value:.{digits}f}" for value in row)


def test_refined_against_the_closed_form_as_it_is():
    closed = load_model("decline", details=False)
    refined = RefinedModel(closed, RefineConfig())
    ratios = []
    for strength in ("weak", "strong"):
        frames, seconds, found = frames_of("realistic", strength), [], []
        refined(frames[0])
        for frame in frames:
            start = time.perf_counter()
            found.append(errors(refined(frame).distance, frame))
            seconds.append(time.perf_counter() - start)
        before = np.mean([errors(closed(frame).distance, frame) for frame in frames], 0)
        ratios.append(np.mean(found, 0) / before)
        print(
            f"\n{strength} interreflection, {len(frames)} frames: closed form {shown(before, 3)}, refined over that "
            f"{shown(ratios[-1], 3)}; {np.median(seconds):.2f} s a frame"
        )
    both = np.mean(ratios, 0)
    print(f"both: {shown(both, 3)}")
    assert (both < BAR).all()


def test_the_real_frame_of_c3vd(realdata):
    (frame,) = read_c3vd(realdata / "c3vd_frame" / "c3vd_layout_derived")
    closed = load_model("decline", details=False)
    models = {name: load_model(name, details=False) for name in ("constant", "decline", *bundled())}
    models["decline, refined"] = RefinedModel(closed, RefineConfig())
    print()
    for name, model in models.items():
        print(f"  {name:<24}{shown(np.array(errors(model(frame).distance, frame)), 3)}")
