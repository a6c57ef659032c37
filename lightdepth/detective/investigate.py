"""Do frames and the keyframes of a map belong together as they are read? The images vote.

Keyframes and frames meet by number alone. Where they meet rightly, the patches around a map point look alike in any two
keyframes that saw it; the reading at hand is held against others that occur in practice (frames counted otherwise,
images mirrored or undistorted, poses the other way round), on the same points. A reading is wrong where another
fits clearly better, or where the patches are no more alike than those around different points. Where points have
colours, these vote besides (lightdepth.detective.colours). Nothing is compared with
an absolute bar that a dim or noisy film would miss.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np

from lightdepth.camera import CameraModel
from lightdepth.datasets.counting import BY_NUMBER, Counting
from lightdepth.datasets.sequence import FrameSequence
from lightdepth.detective.cameras import other_camera
from lightdepth.detective.colours import Colours, colour_sightings
from lightdepth.detective.evidence import LEAST_POINTS, Fit, by_keyframe, compared, compared_apart, told_from_chance
from lightdepth.detective.geometry import geometry_of
from lightdepth.detective.judging import Findings, judged
from lightdepth.detective.patches import Pictures
from lightdepth.detective.readings import (
    AS_GIVEN,
    Reading,
    elsewhere,
    other_images,
    other_poses,
    other_rates,
    shifted,
)
from lightdepth.detective.verdict import WORSE, Verdict
from lightdepth.detective.witnesses import Witnesses, chosen_witnesses
from lightdepth.errors import InputError
from lightdepth.maps.checks import seen_by_projection
from lightdepth.sparse_map import SparseMap, Submap

_PLACES = 4  # in a submap at which keyframes are compared
_SUBMAPS = 6  # looked at, of those with most keyframes
_FARTHEST = 8  # frames, that a shift is followed while it gets better
_SURE = 0.8  # NCC, from which frames counted at another rate are not looked for if a frame more or less is worse
_UNLIKE, _HARDLY_LESS = 0.7, 0.05  # NCC of a keyframe that may not belong, and what others lose at least elsewhere
_WITHOUT = 0.1  # of the keyframes, without a frame, from which they are looked for all the same


def investigate(sparse_map: SparseMap, frames: FrameSequence, given: CameraModel | None = None) -> Verdict:
    """The verdict on a map and its frames: of several submaps, the worst. `given` is the camera that the user gave in
    place of the map's. Reads some 50 frames of each submap."""
    pictures = Pictures(frames, any(s.colors is not None for s in sparse_map.submaps))
    chosen = sorted(sparse_map.submaps, key=lambda s: -len(s.keyframes))[:_SUBMAPS]
    places = _PLACES if len(chosen) == 1 else _PLACES - 1
    verdicts = [judged(_findings(submap, pictures, given, places)) for submap in chosen]
    return max(verdicts, key=lambda verdict: WORSE.index(verdict.judgement))


def _findings(submap: Submap, pictures: Pictures, given: CameraModel | None, places: int) -> Findings:
    geometry = geometry_of(submap, given)
    beside = other_camera(submap, _camera_of(pictures) if given is None else given, given is not None)
    seen = _with_sightings(submap)
    witnesses = None if seen is None else _witnesses(seen, pictures, BY_NUMBER, places)
    colours = None if seen is None else _colours(seen, pictures, witnesses)
    if seen is None or witnesses is None:
        unseen = tuple(_other_maps(submap, pictures, places, None)) if submap.weak_visibility else ()
        return Findings(submap.id, geometry, tried=unseen, colours=colours, other_camera=beside)
    at_hand = witnesses.votes(pictures, BY_NUMBER)
    # A map without keypoints has its points where its poses put them, not on corners.
    corners = None if submap.weak_visibility else witnesses.corners(pictures, BY_NUMBER)
    tried: list[tuple[Reading, Fit]] = []

    def hold_against(reading: Reading) -> Fit | None:
        votes = witnesses.votes(pictures, reading.counting, reading.moved)
        fit = compared(reading.name, witnesses, votes, at_hand)
        if fit is not None and corners is not None:
            sharper = witnesses.corners(pictures, reading.counting, reading.moved)
            fit = replace(fit, corners=compared(reading.name, witnesses, sharper, corners))
        if fit is not None:
            tried.append((reading, fit))
        return fit

    near = [hold_against(shifted(step)) for step in (-1, 1)]
    for step, fit in zip((-1, 1), near, strict=True):
        _follow(step, fit, hold_against)
    own = submap.keyframes[0].camera
    for reading in other_images(own, _camera_of(pictures)):
        hold_against(reading)
    median = float(np.nanmedian(at_hand)) if np.isfinite(at_hand).any() else 0.0
    numbers, there = [k.number for k in submap.keyframes], set(pictures.frames.numbers)
    missing = np.mean([number not in there for number in numbers])
    if median < _SURE or missing > _WITHOUT or not all(fit is None or fit.loses for fit in near):
        for reading in other_rates(max(numbers)):
            hold_against(reading)
    keyframes = by_keyframe(witnesses, at_hand)
    controls: list[Fit] = []
    strange: tuple[str, ...] = ()
    if median < _SURE or np.mean([value < _UNLIKE for value in keyframes.values()]) > _WITHOUT:
        away = [(reading, witnesses.votes(pictures, reading.counting)) for reading in elsewhere(numbers)]
        fits = [compared(reading.name, witnesses, votes, at_hand) for reading, votes in away]
        controls = [fit for fit in fits if fit is not None]
        strange = _strange(witnesses, at_hand, [votes for _, votes in away])
    if submap.weak_visibility:
        tried += _other_maps(submap, pictures, places, (witnesses, at_hand))
    return Findings(
        submap.id,
        geometry,
        Fit(AS_GIVEN.name, median, len(keyframes)),
        int(np.isfinite(at_hand).sum()),
        told_from_chance(at_hand, witnesses.chance(pictures, BY_NUMBER)),
        strange,
        tuple(tried),
        tuple(controls),
        colours,
        beside,
    )


def _colours(submap: Submap, pictures: Pictures, witnesses: Witnesses | None) -> Colours | None:
    """What the points' colours say, in the keyframes that patches are compared in, or else in some; None where they
    have none, or the frames do not show enough of them."""
    there = set(pictures.frames.numbers)
    usable = np.array([k.number in there for k in submap.keyframes])
    sightings = colour_sightings(submap, usable, [] if witnesses is None else np.unique(witnesses.rows).tolist())
    votes = np.zeros(0) if sightings is None else sightings.votes(pictures, BY_NUMBER)
    if sightings is None or np.isfinite(votes).sum() < LEAST_POINTS:
        return None
    tried: list[tuple[Reading, Fit]] = []

    def hold_against(reading: Reading) -> Fit | None:
        other = sightings.votes(pictures, reading.counting, reading.moved)
        fit = compared(reading.name, sightings, other, votes)
        if fit is not None:
            tried.append((reading, fit))
        return fit

    keyframes = by_keyframe(sightings, votes)
    found = Colours(Fit(AS_GIVEN.name, float(np.nanmedian(votes)), len(keyframes)))
    for step in (-1, 1):
        _follow(step, hold_against(shifted(step)), hold_against)
    for reading in other_images(submap.keyframes[0].camera, _camera_of(pictures)):
        hold_against(reading)
    if not found.alike and not any(found.clear(fit) for _, fit in tried):
        for reading in other_rates(max(k.number for k in submap.keyframes)):
            hold_against(reading)
    return replace(found, tried=tuple(tried))


def _follow(step: int, fit: Fit | None, hold_against: Callable[[Reading], Fit | None]) -> None:
    """Goes on shifting the way that helps, as long as it helps more."""
    last, offset = fit, 2 * step
    while last is not None and last.gain > 0 and abs(offset) <= _FARTHEST:
        found = hold_against(shifted(offset))
        last = found if found is not None and found.gain > last.gain else None
        offset += step


def _strange(witnesses: Witnesses, at_hand: np.ndarray, away: list[np.ndarray]) -> tuple[str, ...]:
    """Names of the keyframes that are unlike the others, and hardly less so in frames far away."""
    votes = np.stack(away)
    known = np.isfinite(votes)
    mean = np.where(known, votes, 0).sum(0) / np.where(known.any(0), known.sum(0), np.nan)
    own, gains = by_keyframe(witnesses, at_hand), by_keyframe(witnesses, mean - at_hand)
    rows = [row for row, value in own.items() if value < _UNLIKE and gains.get(row, -1.0) > -_HARDLY_LESS]
    return tuple(witnesses.keyframes[row].name for row in rows)


def _other_maps(
    submap: Submap, pictures: Pictures, places: int, at_hand: tuple[Witnesses, np.ndarray] | None
) -> Iterable[tuple[Reading, Fit]]:
    """Poses and cameras read otherwise, for a map whose points are where its poses put them; `at_hand` are the
    sightings as it is given, None where there are none."""
    for reading in other_poses():
        assert reading.other_map is not None
        seen = _with_sightings(reading.other_map(submap))
        witnesses = None if seen is None else _witnesses(seen, pictures, BY_NUMBER, places)
        if witnesses is not None:
            votes = witnesses.votes(pictures, BY_NUMBER)
            fit = compared_apart(reading.name, (witnesses, votes), at_hand)
            idle = (
                at_hand is not None and fit is not None and abs(fit.gain) < 1e-6
            )  # as those of keypoints, if none are
            if fit is not None and not idle:
                yield reading, fit


def _with_sightings(submap: Submap) -> Submap | None:
    """The submap with points where they are seen: a map without keypoints has them where its poses put them, but
    hidden ones were not seen."""
    if not submap.weak_visibility:
        return submap
    try:
        return seen_by_projection(submap, hide=True)
    except InputError:
        return None


def _witnesses(submap: Submap, pictures: Pictures, counting: Counting, places: int) -> Witnesses | None:
    there = set(pictures.frames.numbers)
    usable = np.array([counting.number(k) in there for k in submap.keyframes])
    return chosen_witnesses(submap, usable, places)


def _camera_of(pictures: Pictures) -> CameraModel | None:
    try:
        return pictures.frames.first().camera
    except InputError:
        return None
