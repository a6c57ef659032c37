"""Where a clock began: a map on another clock than the frames' is brought to where the images agree best.

A SLAM that stamps by the time of day tells when its keyframes were, but not when the video began; that its first stamp
is the first frame is a guess, wrong by as many frames as it took to begin.
"""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np

from lightdepth.datasets.counting import Counting
from lightdepth.datasets.sequence import FrameSequence
from lightdepth.detective.patches import Pictures
from lightdepth.detective.witnesses import Witnesses, chosen_witnesses
from lightdepth.sparse_map import SparseMap, Submap

_PLACES = 2  # at which keyframes are compared
_EARLIER, _LATER = 30, 300  # frames that the guess may be wrong by
_TRIED = 60  # offsets at most, before the best is looked at closely
_BETTER = 0.03  # NCC, by which another offset has to fit better than the guess
_SEEN = 0.5  # of the votes that the best seen offset has, which another needs


def by_the_images(sparse_map: SparseMap, frames: FrameSequence) -> SparseMap:
    """The map with the keyframes whose clock was guessed counted from where the images agree best; as it is, where
    nothing was guessed or the guess fits as well as any. What was found is said in a warning."""
    guessed = [s for s in sparse_map.submaps if s.guessed_clock]
    if not guessed:
        return sparse_map
    submap = max(guessed, key=lambda s: len(s.keyframes))
    witnesses = chosen_witnesses(submap, np.ones(len(submap.keyframes), bool), _PLACES)
    if witnesses is None:
        return sparse_map
    fits = _fits(witnesses, submap, frames)
    most = max(count for _, count in fits.values())
    usable = {offset: ncc for offset, (ncc, count) in fits.items() if count >= max(1, _SEEN * most)}
    best = max(usable, key=lambda offset: (usable[offset], -abs(offset)))
    at_hand = usable.get(0)
    if best == 0 or (at_hand is not None and usable[best] < at_hand + _BETTER):
        return sparse_map
    was = "with hardly a frame" if at_hand is None else f"{at_hand:.2f}"
    warnings.warn(
        f"{sparse_map.source}: the images show that tracking began {best} frames after the frame that the "
        f"clock's first stamp was taken for (patches around one map point have an NCC of {usable[best]:.2f} in two "
        f"keyframes, {was} as it was): "
        f"keyframes are counted from there. --frame-offset {best} says so, and --time-offset the clock itself",
        stacklevel=2,
    )
    return replace(sparse_map, submaps=tuple(_later(s, best) if s.guessed_clock else s for s in sparse_map.submaps))


def _fits(witnesses: Witnesses, submap: Submap, frames: FrameSequence) -> dict[int, tuple[float, int]]:
    """Median NCC and number of votes by offset [frames]: all in reach at a coarse step, then around the best."""
    numbers = [k.number for k in submap.keyframes]
    low = max(-_EARLIER, min(frames.numbers) - min(numbers))
    high = min(_LATER, max(frames.numbers) - max(numbers))
    step = max(1, -(-(high - low) // _TRIED))
    found = {offset: _fit(witnesses, frames, offset) for offset in {0, *range(low, high + 1, step)}}
    while step > 1:
        step = -(-step // 2)
        best = max(found, key=lambda offset: found[offset][0])
        for offset in (best - step, best + step):
            found.setdefault(offset, _fit(witnesses, frames, offset))
        step = step if step > 1 else 0
    return found


def _fit(witnesses: Witnesses, frames: FrameSequence, offset: int) -> tuple[float, int]:
    # Pictures of its own: to keep those of all offsets would fill the memory.
    votes = witnesses.votes(Pictures(frames), Counting(offset=offset))
    seen = votes[np.isfinite(votes)]
    return (float(np.median(seen)), len(seen)) if len(seen) else (-1.0, 0)


def _later(submap: Submap, offset: int) -> Submap:
    keyframes = tuple(replace(k, name=f"{k.number + offset:06d}.png") for k in submap.keyframes)
    told = None if submap.localised is None else tuple(n + offset for n in submap.localised)
    return replace(submap, keyframes=keyframes, localised=told, guessed_clock=False)
