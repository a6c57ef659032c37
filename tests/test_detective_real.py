"""The detective on real maps: none is accused, and each wrong frame rate is refused. Skipped where they are absent."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import msgpack
import pytest
from test_realdata import SINUS, read_once

from lightdepth.datasets import FrameSequence, open_sequence
from lightdepth.detective import investigate
from lightdepth.frame import Frame
from lightdepth.maps import read_map
from lightdepth.maps.checks import OTHER_READINGS, seen_by_projection
from lightdepth.sparse_map import SparseMap

KINDS = ("good", "unix_clock", "drifting")


@cache
def stella_frames(stella: Path) -> FrameSequence:
    """Kept in memory. Each keyframe of the three maps, and one frame before and after."""
    on_disk = open_sequence(stella / "frames", camera=stella / "camera.json", mask=stella / "mask.png")

    @cache
    def load(i: int) -> Frame:
        return on_disk[i]

    return FrameSequence(on_disk.names, load, on_disk.source)


def stella_map(stella: Path, kind: str, fps: float, folder: Path) -> SparseMap:
    """The map as the SLAM wrote it, its times counted from the first frame by `fps`."""
    content = msgpack.unpackb((stella / kind / "map.msg").read_bytes(), strict_map_key=False)
    start = json.loads((stella / "maps.json").read_text())[kind]["first_stamp"]
    for keyframe in content["keyframes"].values():
        keyframe["ts"] -= start
    (folder / "map.msg").write_bytes(msgpack.packb(content))
    (folder / "densify_map.json").write_text(json.dumps({"fps": fps}))
    return read_map(folder)


@pytest.mark.parametrize("kind", KINDS)
def test_maps_of_a_real_slam_agree_with_their_frames(realdata, tmp_path, kind):
    """Seen: NCC .89, .88 and .85."""
    verdict = investigate(stella_map(realdata / "stella", kind, 30, tmp_path), stella_frames(realdata / "stella"))
    assert verdict.judgement == "agrees", verdict.sentence
    assert verdict.at_hand is not None and verdict.at_hand.likeness > 0.8


@pytest.mark.parametrize("fps", [25, 29, 31])
@pytest.mark.parametrize("kind", KINDS)
def test_each_wrong_frame_rate_is_refused_and_the_right_one_named(realdata, tmp_path, kind, fps):
    """Seen: NCC .22 to .77, and .79 to .89 at the rate that is named. Rates are named to 5 %: keyframes fall on whole
    frames, and of most frames between keyframes there is no image."""
    verdict = investigate(stella_map(realdata / "stella", kind, fps, tmp_path), stella_frames(realdata / "stella"))
    assert verdict.judgement == "wrong", verdict.sentence
    times = float(verdict.cure.split(" beside the map, by ")[1].split(" ")[0])
    assert times == pytest.approx(30 / fps, rel=0.05)


def test_the_sinus_agrees_and_without_its_keypoints_other_poses_are_named(realdata):
    map_folder = realdata / "sinus" / "derived_colmap" / "sparse_txt" / "0"
    frames, sparse_map = read_once(realdata / "sinus" / SINUS, map_folder), read_map(map_folder)
    (submap,) = sparse_map.submaps
    assert investigate(sparse_map, frames).judgement == "agrees"
    named = {}
    for start in (
        "with the inverse poses. ",
        "with the places of its keyframes 0.1 times",
        "with the camera's y and z",
    ):
        (change,) = (c for what, c in OTHER_READINGS.items() if what.startswith(start))
        turned = seen_by_projection(replace(change(submap), id=0), hide=True)
        verdict = investigate(SparseMap((turned,), "a trajectory"), frames)
        assert verdict.judgement == "wrong", verdict.sentence
        named[start] = verdict.sentence
    for sentence, what in zip(named.values(), ("inverse", "10 times as far", "OpenGL"), strict=True):
        assert what in sentence
