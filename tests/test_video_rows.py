"""Videos as people really hold them, through the command line: rate, depth, fields, turns and doubled frames."""

from __future__ import annotations

import csv
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from raising import warned
from test_picture_rows import predicted, refusal
from test_video import turned_by_flag
from videos import CAMERA, OCTAGON, picture, uneven_times, write_video

from lightdepth.calibration import write_camera
from lightdepth.cli import main
from lightdepth.datasets import VideoFile, open_sequence
from lightdepth.datasets.clip_checks import check_clip
from lightdepth.image_quality import doubles, repeats
from lightdepth.which_frame import Clock, Stamps

COUNT = 16


def filmed(folder: Path, images: list[np.ndarray], name: str = "a.mkv", codec: str = "ffv1", pixels: str = "bgr0", **o):
    """A video at 25 frames a second, or at `times`, with its camera beside it."""
    folder.mkdir(exist_ok=True)
    write_camera(CAMERA, folder / "camera.json")
    times = o.pop("times", np.arange(len(images)) / 25)
    return write_video(folder / name, images, times, codec, pixels, **o)


def run(verb: str, *words: str | Path) -> int:
    return main([verb, *map(str, words)])


def imported(video: Path, out: Path, *words: str) -> Path:
    """What `lightdepth import` makes of all frames; text is not looked for."""
    assert run("import", video, "-o", out, "--blur", "0", "--find_text", "false", *words) == 0
    return out


def findings(folder: Path) -> str:
    return " ".join(f"{f['found']} {f['do']}" for f in json.loads((folder / "run.json").read_text())["findings"])


def fates(folder: Path) -> list[str]:
    with (folder / "frames.csv").open() as file:
        return [row["fate"] for row in csv.DictReader(file)]


def woven(i: int) -> np.ndarray:
    """Two fields, half a frame apart, in one picture."""
    both = picture(i).copy()
    both[1::2] = picture(i + 0.5)[1::2]
    return both


# ---- rate


def test_frames_of_a_varying_rate_keep_their_own_times_and_it_is_said(tmp_path):
    times = uneven_times(COUNT, seed=5)
    video = filmed(tmp_path / "in", [picture(i) for i in range(COUNT)], times=times)
    with warned("frame rate varies", " ms"):
        frames = open_sequence(video)
    assert [f.time for f in frames] == pytest.approx(times, abs=1e-3)
    imported(video, tmp_path / "out", "--every", "2")
    assert "The frame rate varies" in findings(tmp_path / "out")
    assert [f.time for f in open_sequence(tmp_path / "out")] == pytest.approx(times[::2], abs=1e-3)


def test_a_map_s_times_meet_frames_of_a_varying_rate_by_stamp_though_a_rate_is_given():
    times = uneven_times(COUNT, seed=5)
    clock = Clock(fps=25.0, frames=Stamps(lambda: (np.arange(COUNT), times)))
    with warned("stamps", "varies"):
        assert clock.names(times[2:], "map") == [f"{i:06d}.png" for i in range(2, COUNT)]
    assert clock.names(np.array([3, 9, 14]) / 25, "map") == ["000003.png", "000009.png", "000014.png"]  # counted


# ---- depth


@pytest.mark.parametrize(("name", "codec"), [("a.mkv", "ffv1"), ("a.mp4", "libx264"), ("b.mkv", "libx265")])
def test_ten_bits_have_the_depth_and_the_valid_share_of_eight(tmp_path, name, codec):
    lossless = {
        "libx264": {"qp": "0"},
        "libx265": {"x265-params": "lossless=1:log-level=none:bframes=0:frame-threads=1:pools=none"},
    }.get(codec, {})
    images = [picture(i) for i in range(2)]
    eight = filmed(tmp_path / "8", images, name, codec, "yuv420p", **lossless)
    ten = filmed(tmp_path / "10", images, name, codec, "yuv420p10le", **lossless)
    assert VideoFile(ten).bits == 10 and VideoFile(ten).read(1).dtype == np.uint16
    a, b = (predicted(video, tmp_path / f"out{i}") for i, video in enumerate((eight, ten)))
    assert list(a) == list(b)
    for frame in a:
        valid, other = np.isfinite(a[frame]), np.isfinite(b[frame])
        assert valid.mean() == pytest.approx(other.mean(), abs=2e-3) and valid.mean() > 0.5
        assert np.median(np.abs(a[frame] - b[frame])[valid & other]) < 0.01
    image = open_sequence(imported(ten, tmp_path / "imported", "--every", "1"))[0].image
    assert np.abs(image - open_sequence(ten)[0].image)[OCTAGON].max() < 1e-4


def test_ten_bits_stored_as_they_are_in_sixteen_are_named_and_read_when_they_are_told(tmp_path, capsys):
    images = [picture(i) for i in range(3)]
    grey = [np.rint(image.mean(-1) / 255 * 1023).astype(np.uint16) for image in images]
    write_camera(CAMERA, tmp_path / "camera.json")
    video = write_video(tmp_path / "a.mkv", grey, [0, 0.04, 0.08], "ffv1", "gray16le")
    said = refusal(capsys, "predict", video, "-o", tmp_path / "out", "--checkpoint", "decline")
    assert "a video of 16 bits whose highest value is" in said and "--bit-depth 10" in said
    found = predicted(video, tmp_path / "out", "--bit-depth", "10")
    whole = [np.rint(g / 1023 * 65535).astype(np.uint16) for g in grey]
    full = write_video(tmp_path / "b.mkv", whole, [0, 0.04, 0.08], "ffv1", "gray16le")
    expected = predicted(full, tmp_path / "full")
    assert all(np.isfinite(found[n]).mean() == np.isfinite(expected[n]).mean() > 0.5 for n in expected)
    assert "times as bright as white" in refusal(capsys, "predict", video, "-o", tmp_path / "c", "--bit-depth", "8")
    assert "--bit-depth" in refusal(capsys, "predict", video, "-o", tmp_path / "c", "--bit-depth", "17")


# ---- fields


@pytest.mark.parametrize("flagged", [True, False])
def test_interlaced_video_is_named_with_its_share_and_one_field_is_kept_on_demand(tmp_path, flagged):
    make = {"codec": "libx264", "pixels": "yuv420p", "flags": "+ilme+ildct", "crf": "18"} if flagged else {}
    video = filmed(tmp_path / "in", [woven(i) for i in range(COUNT)], **make)
    assert VideoFile(video).interlaced == flagged
    with warned("interlaced", "% of ", "--deinterlace"):
        frames = open_sequence(video)
    np.testing.assert_array_equal(frames[3].image, np.float32(VideoFile(video).read(3)) / np.float32(255))  # untouched
    imported(video, tmp_path / "kept", "--every", "1", "--deinterlace")
    assert "are interlaced" not in findings(tmp_path / "kept")
    even = open_sequence(tmp_path / "kept")[5].image
    off, woven_off = (np.abs(image - picture(5) / 255)[OCTAGON].mean() for image in (even, frames[5].image))
    assert off < 0.5 * woven_off


def test_progressive_video_that_is_flagged_as_interlaced_is_said_to_be_whole(tmp_path):
    video = filmed(tmp_path, [picture(i) for i in range(COUNT)], codec="libx264", pixels="yuv420p", flags="+ilme+ildct")
    with warned("interlaced", "none of "):
        open_sequence(video)
    said = findings(imported(video, tmp_path / "out"))
    assert "those that move are whole" in said and "are interlaced:" not in said


# ---- turned pictures


def test_a_flag_that_turns_pictures_is_left_aside_and_said(tmp_path, capsys):
    plain = filmed(tmp_path / "in", [picture(i) for i in range(3)], "a.mp4", "libx264", "yuv420p")
    shutil.copytree(tmp_path / "in", tmp_path / "turned")
    turned = turned_by_flag(plain, tmp_path / "turned" / "a.mp4")
    expected, found = predicted(plain, tmp_path / "a"), predicted(turned, tmp_path / "b")
    assert all(np.array_equal(found[name], expected[name], equal_nan=True) for name in expected)
    assert any("it is ignored" in said for said in json.loads((tmp_path / "b" / "run.json").read_text())["warnings"])
    imported(turned, tmp_path / "imported")
    assert "frames are as stored" in findings(tmp_path / "imported")
    assert open_sequence(tmp_path / "imported").image_size() == (256, 208)
    write_camera(CAMERA.cropped(0, 0, 208, 208).resized(208, 256), tmp_path / "turned" / "camera.json")
    assert "turn the pixels for good" in refusal(capsys, "predict", turned, "-o", tmp_path / "c")


# ---- doubled frames

PATTERNS = {
    "25 saved at 50": [i // 2 for i in range(40)],
    "24 saved at 60": [k for i in range(16) for k in [i] * (2 + i % 2)],
    "24 saved at 30": [k for i in range(32) for k in [i] * (2 if i % 4 == 3 else 1)],
    "none": list(range(30)),
}


@pytest.mark.parametrize("pattern", PATTERNS)
def test_doubled_frames_are_said_with_their_share_and_left_out_with_true_times(tmp_path, pattern, recwarn):
    shown = PATTERNS[pattern]
    again = np.array([i > 0 and shown[i] == shown[i - 1] for i in range(len(shown))])
    times = np.arange(len(shown)) / 50
    video = filmed(
        tmp_path / "in", [picture(i) for i in shown], "a.mp4", "libx264", "yuv420p", times=times, crf="23", bf="2"
    )
    recwarn.clear()
    open_sequence(video)
    said = [str(w.message) for w in recwarn if "repeat the one before" in str(w.message)]
    assert len(said) == (pattern != "none")
    if said:
        share = int(said[0].split("%")[0].split()[-1]) / 100
        assert share == pytest.approx(again.mean(), abs=0.08)
    imported(video, tmp_path / "out", "--every", "1")
    assert [fate == "double" for fate in fates(tmp_path / "out")] == again.tolist()
    assert ("are doubles" in findings(tmp_path / "out")) == again.any()
    frames = open_sequence(tmp_path / "out")
    assert frames.numbers == np.flatnonzero(~again).tolist()
    assert [f.time for f in frames] == pytest.approx(times[~again], abs=1e-3)


def test_a_camera_that_slows_down_or_stands_repeats_nothing_but_what_is_the_same():
    slowing = np.array([np.inf, 8, 6, 4, 2, 1, 0.5, 0.3, 0.3, 0.3, 0.5, 1, 2, 4])
    assert not repeats(slowing).any()
    frozen = np.array([np.inf, 5, 5, *[0.02] * 9, 5, 5])
    assert repeats(frozen).sum() == 9 and not doubles(frozen).any()
    assert doubles(np.array([np.inf, 5, 0.6, 5, 0.6, 5, 0.6])).tolist() == [False, False, True] + [False, True] * 2


def test_select_takes_no_double_for_a_keyframe(tmp_path):
    shown = PATTERNS["25 saved at 50"]
    video = filmed(tmp_path / "in", [picture(i) for i in shown], "a.mp4", "libx264", "yuv420p", crf="20")
    assert run("select", video, "-o", tmp_path / "list.txt", "--no_frames") == 0
    kept = [int(n) for n in (tmp_path / "list.txt").read_text().splitlines() if not n.startswith("#")]
    assert kept and all(n % 2 == 0 for n in kept)
    with (tmp_path / "list.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert sum(row["reason"] == "double" for row in rows) == 20


def test_a_video_too_short_for_stretches_and_one_with_another_mask_are_looked_at_without_harm(tmp_path):
    video = VideoFile(filmed(tmp_path, [picture(0)]))
    check_clip(video, OCTAGON)
    check_clip(video, np.ones((5, 5), bool))


@pytest.mark.parametrize("depth", ["0", "99"])
def test_a_bit_depth_that_no_sample_has_is_refused_for_a_video_as_for_pictures(tmp_path, capsys, depth):
    path = filmed(tmp_path / "a", [picture(i) for i in range(2)])
    assert f"--bit-depth: {depth}" in refusal(capsys, "import", path, "-o", tmp_path / "out", "--bit-depth", depth)
