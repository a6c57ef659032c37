"""What is wrong with the data, in plain sentences, each with what to do: before a day of training finds out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lightdepth.counting import counted
from lightdepth.datasets.clip import uneven
from lightdepth.image_quality import BLACK, Measures, combed
from lightdepth.importing.selection import BLURRED, DOUBLE, FROZEN, KEPT, UNREADABLE

LOW_RESOLUTION, SMALL_MASK, BLURRED_SHARE, SATURATED_SHARE = 240, 0.3, 0.3, 0.1
DARK_SHARE, DARK_BRIGHTNESS, JUMP, JUMPS_SHARE, COMBED_SHARE = 0.3, 50.0, 0.15, 0.02, 0.2


@dataclass(frozen=True)
class Finding:
    """What was found, and what to do about it."""

    found: str
    cure: str


def of_frames(measures: Measures, fate: np.ndarray, times: np.ndarray) -> list[Finding]:
    """What the numbers say; `fate` and `times` as of lightdepth.importing.selection."""
    known = measures.readable
    count, kept = int(known.sum()), int((fate == KEPT).sum())
    if not count:
        return [Finding("No frame could be read.", "Copy the data again.")]
    findings = []

    def share(fates: str) -> float:
        return float((fate == fates).sum()) / len(fate)

    if (fate == UNREADABLE).any():
        findings.append(
            Finding(
                f"{int((fate == UNREADABLE).sum())} of {len(fate)} frames could not be read: the file is cut off or "
                "damaged.",
                "Copy it again from where it came from; the frames that can be read were used.",
            )
        )
    if share(BLURRED) > BLURRED_SHARE:
        findings.append(
            Finding(
                f"{share(BLURRED):.0%} of the frames are blurred compared with their neighbours, and were left out.",
                "Fast passages are of little use; choose a calmer part with --start and --end, or lower --blur.",
            )
        )
    if (fate == FROZEN).any():
        findings.append(
            Finding(
                f"{int((fate == FROZEN).sum())} frames ({share(FROZEN):.1%}) repeat the frame before: "
                f"{_runs(fate == FROZEN)}. They were left out.",
                "Nothing, if the picture was frozen for a photograph.",
            )
        )
    if (fate == DOUBLE).any():
        findings.append(
            Finding(
                f"{int((fate == DOUBLE).sum())} frames ({share(DOUBLE):.0%}) are doubles: they repeat the frame "
                "before, one or a few at a time, while the camera moves. They were left out.",
                "Nothing, times stay true. The recorder ran faster than the endoscope: one that counts frames at the "
                "file's rate, such as a SLAM, counts the doubles too.",
            )
        )
    if interlaced(measures):
        teeth, moving = combed(measures)
        findings.append(
            Finding(
                f"The pictures are interlaced: neighbouring rows differ more than rows of the same field in "
                f"{teeth / moving:.0%} of the frames that move (ratio {np.median(measures.combing[known]):.2f}, its "
                f"upper decile {np.quantile(measures.combing[known], 0.9):.2f}).",
                "Give --deinterlace: it keeps one field and interpolates the rows between, the camera stays right.",
            )
        )
    saturated, dark = float(measures.saturated[known].mean()), float(measures.dark[known].mean())
    if saturated > SATURATED_SHARE:
        findings.append(
            Finding(
                f"{saturated:.0%} of the tissue is saturated (white in all channels).",
                "Clipped light says nothing about distance: lower the light source or the gain when recording.",
            )
        )
    if dark > DARK_SHARE or float(np.median(measures.brightness[known])) < DARK_BRIGHTNESS:
        findings.append(
            Finding(
                f"Dark: median brightness {np.median(measures.brightness[known]):.0f} of 255, {dark:.0%} of the tissue "
                f"below {BLACK}.",
                "Little light comes back, so noise and the response dominate: raise the light, or leave this part out.",
            )
        )
    jumps = exposure_jumps(measures)
    if jumps > max(2, JUMPS_SHARE * count):
        findings.append(
            Finding(
                f"Brightness jumps by more than {JUMP:.0%} from one frame to the next {counted(jumps, 'time')}: "
                "automatic exposure or flicker.",
                "Scale per frame is not affected; methods that compare brightness between frames are. Fix the exposure "
                "when recording, if the endoscope lets you.",
            )
        )
    means = np.array([np.median(channel[known]) for channel in (measures.red, measures.green, measures.blue)])
    if np.ptp(means) < 1.5:
        findings.append(
            Finding(
                "The pictures are grey: the three channels are the same.",
                "Albedo cannot be found from colour; expect worse depth than on colour video.",
            )
        )
    elif means[0] < max(means[1:]):
        findings.append(
            Finding(
                f"Tissue is not red (channel medians {means[0]:.0f}, {means[1]:.0f}, {means[2]:.0f}): white balance, "
                "narrow-band imaging, or channels in another order.",
                "Check the colours in a picture; leave narrow-band passages out.",
            )
        )
    if (steps := uneven(times)) is not None:
        findings.append(
            Finding(
                f"The frame rate varies: steps of {1000 * steps[0]:.0f} to {1000 * steps[1]:.0f} ms.",
                "Use the times in times.csv, never number / rate.",
            )
        )
    if not kept:
        findings.append(Finding("No frame was kept.", "Widen --start and --end, or lower --blur."))
    return findings


def interlaced(measures: Measures) -> bool:
    """Whether frames that move are combed. Where nothing moves, interlacing cannot be seen and does no harm."""
    teeth, moving = combed(measures)
    return moving >= 3 and teeth >= COMBED_SHARE * moving


def exposure_jumps(measures: Measures) -> int:
    """Steps from one readable frame to the next whose brightness differs by more than JUMP."""
    brightness = measures.brightness[measures.readable]
    return int((np.abs(np.diff(brightness)) > JUMP * np.maximum(brightness[1:], 1)).sum())


def of_camera(size: tuple[int, int], camera_size: tuple[int, int] | None, why: str) -> list[Finding]:
    """What is wrong with the calibration, for images and a camera of these sizes (width, height)."""
    findings = []
    if camera_size is None:
        reason = f" ({why})" if why else ""
        findings.append(
            Finding(
                f"No calibration{reason}: camera.json was not written.",
                "Calibrate the endoscope and give --camera FILE, or --camera auto to find it from the motion; "
                "without a camera nothing can be predicted or densified.",
            )
        )
    elif camera_size != size:
        sx, sy = size[0] / camera_size[0], size[1] / camera_size[1]
        sizes = f"The images are {size[0]}x{size[1]}, the camera was calibrated at {camera_size[0]}x{camera_size[1]}"
        if abs(sx / sy - 1) < 0.01:
            findings.append(
                Finding(
                    f"{sizes}: it was rescaled by {sx:.4g}.",
                    "Right if the video was only resized; if it was cropped as well, calibrate at this size.",
                )
            )
        else:
            findings.append(
                Finding(
                    f"{sizes}: another shape, so the images were cropped or padded, and camera.json was not written.",
                    "Give the calibration of this image format with --camera FILE.",
                )
            )
    if min(size) < LOW_RESOLUTION:
        findings.append(
            Finding(
                f"Low resolution: {size[0]}x{size[1]}.",
                "Expect few map points; use the recorder's full size, not a preview.",
            )
        )
    return findings


def _runs(which: np.ndarray) -> str:
    """`3 stretches, the longest of 12 frames`."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], which.astype(int), [0]])))
    lengths = edges[1::2] - edges[::2]
    return f"{counted(len(lengths), 'stretch', 'stretches')}, the longest of {counted(int(lengths.max()), 'frame')}"
