"""Light that is not white and steady is said by every verb that reads frames, and honest clips are not accused.

The limits were chosen on other colons than those here.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from colons import CAMERA, SMALL, colon, sequence, slam

from lightdepth.cli import main
from lightdepth.colour import ColourMeter, Colours
from lightdepth.datasets import write_folder
from lightdepth.datasets.coloured import colours_of
from lightdepth.frame import Frame
from lightdepth.maps import write_multimap
from lightdepth.photometry import PhotometricCalibration
from lightdepth.tube import render_sequence
from lightdepth.tube.scene import realistic

ANOTHER, GAIN, BALANCE = "in another colour than", "the gain jumps", "the white balance jumps"
Linear = Callable[[np.ndarray, int], np.ndarray]


def narrow_band(linear: np.ndarray) -> np.ndarray:
    """Green light is shown as red, blue as green and blue, as bright as before."""
    shown = linear[..., (1, 2, 2)] * np.float32([0.4, 1, 0.9])
    return shown * np.quantile(linear.max(-1), 0.9) / np.quantile(shown.max(-1), 0.9)


def gains(red: float, green: float, blue: float) -> Callable[[np.ndarray], np.ndarray]:
    return lambda linear: linear * np.float32([red, green, blue])


def now_and_then(change: Callable[[np.ndarray], np.ndarray]) -> Linear:
    often = np.random.default_rng(5).random(100) < 0.4
    return lambda linear, i: change(linear) if often[i] else linear


KINDS: dict[str, tuple[Linear, str, str]] = {
    "narrow band": (lambda linear, i: narrow_band(linear), ANOTHER, "in_another_colour"),
    "a third in narrow band": (
        lambda linear, i: narrow_band(linear) if i < 6 else linear,
        ANOTHER,
        "in_another_colour",
    ),
    "channels swapped": (lambda linear, i: linear[..., ::-1], ANOTHER, "in_another_colour"),
    "darker at times": (now_and_then(gains(0.15, 0.15, 0.15)), GAIN, "gain_jumps"),
    "overexposed at times": (now_and_then(gains(3, 3, 3)), GAIN, "gain_jumps"),
    "less red at times": (now_and_then(gains(0.4, 1, 1)), BALANCE, "white_balance_jumps"),
    "more red at times": (now_and_then(gains(1, 0.4, 0.4)), BALANCE, "white_balance_jumps"),
}


def clip(seed: int, count: int = 18) -> list[Frame]:
    return [replace(f, true_distance=None) for f in colon(seed, count, 9.0).frames]


def changed(frames: list[Frame], change: Linear) -> list[Frame]:
    """The frames with their linear light changed, (H, W, 3) and number in the clip, and exposed again."""
    images = [np.clip(change(f.image**f.light.gamma, i), 0, 1) ** (1 / f.light.gamma) for i, f in enumerate(frames)]
    return [replace(f, image=np.rint(255 * x).astype(np.float32) / 255) for f, x in zip(frames, images, strict=True)]


def lightdepth(*argv: object) -> int:
    return main([str(a) for a in argv])


def predicted(frames: list[Frame], folder: Path) -> dict:
    """The record of `predict` by the closed form."""
    write_folder(frames, folder / "data")
    assert (
        lightdepth("predict", folder / "data", "-o", folder / "out", "--checkpoint", "decline", "--previews=false") == 0
    )
    return json.loads((folder / "out" / "run.json").read_text())


def colours(frames: list[Frame]) -> Colours:
    meter = ColourMeter()
    for frame in frames:
        meter.add(frame.image, frame.valid)
    return meter.result()


@pytest.mark.parametrize("kind", KINDS)
def test_predict_says_what_the_light_was_with_its_share(kind, tmp_path, capsys):
    change, said, counted = KINDS[kind]
    run = predicted(changed(clip(51), change), tmp_path)
    (doubt,) = [w for w in run["warnings"] if said in w]
    assert doubt in run["colour"]["doubts"] and f"warning: {doubt}" in capsys.readouterr().out
    of = run["colour"]["frames"] if said == ANOTHER else run["colour"]["neighbours"]
    assert f"{run['colour'][counted] / of:.0%} of the frames" in doubt and "read as if" in doubt


@pytest.mark.parametrize("kind", KINDS)
def test_the_light_of_another_colon_is_found_too(kind):
    change, said, _ = KINDS[kind]
    assert any(said in doubt for doubt in colours(changed(clip(52), change)).doubts)


def test_a_third_in_narrow_band_is_counted_exactly_and_the_whole_clip_too(tmp_path):
    third = colours(changed(clip(53), KINDS["a third in narrow band"][0]))
    assert third.odd.tolist() == [True] * 6 + [False] * 12 and "33% of the frames" in third.doubts[0]
    assert "than the rest (narrow-band light?)" in third.doubts[0]
    whole = colours(changed(clip(53), KINDS["narrow band"][0]))
    assert whole.odd.all() and "100% of the frames are in another colour than tissue under white" in whole.doubts[0]


def honest() -> dict[str, list[Frame]]:
    steep = PhotometricCalibration(gamma=1.8, mu=6.0)
    return {
        **{f"plain {seed}": clip(seed) for seed in (43, 44)},
        **{f"realistic {seed}": render_sequence(seed, 8, CAMERA, 6.0, realistic()).frames for seed in (45, 46)},
        "steep light": render_sequence(47, 12, CAMERA, 10.0, SMALL, steep).frames,
        "far apart": render_sequence(48, 10, CAMERA, 60.0, SMALL).frames,
    }


def test_honest_clips_are_not_accused():
    for name, frames in honest().items():
        found = colours(frames)
        assert len(found.of_frames) == len(frames) and not found.doubts, (name, found.doubts)


@pytest.mark.parametrize(
    "change",
    [
        lambda linear, i: linear * 0.03 ** (i / 17),  # auto exposure, slowly, over a factor of 30
        lambda linear, i: linear * 0.6 ** (i % 2),  # and by less than the models mind
        lambda linear, i: linear.mean(-1, keepdims=True).repeat(3, -1),  # a grey clip has no colour
        lambda linear, i: linear * np.float32([1, 1.1, 0.3]) if i < 4 else linear,  # bile
        lambda linear, i: linear * np.float32([1, 0.4, 0.4]),  # red all along
    ],
)
def test_what_does_no_harm_is_not_accused(change):
    assert not colours(changed(clip(43), change)).doubts


def test_predict_says_nothing_of_an_honest_clip(tmp_path):
    run = predicted(clip(54), tmp_path)
    assert run["colour"]["doubts"] == [] and run["warnings"] == [] and run["colour"]["frames"] == 18


def test_what_cannot_be_seen_has_no_colour():
    frames = clip(43, 4)
    black = [replace(f, image=np.zeros_like(f.image)) for f in frames]
    white = [replace(f, image=np.ones_like(f.image)) for f in frames]
    for each in (black, white):
        assert len(colours(each).of_frames) == 0 and not colours(each).doubts


def test_of_a_long_sequence_some_frames_are_looked_at_each_with_its_neighbour():
    frames = clip(53)
    long = [replace(frames[i // 20], name=f"{i:04d}") for i in range(360)]
    read: list[int] = []
    seen = sequence(long)
    seen._load = lambda i: read.append(i) or long[i]
    assert len(colours_of(seen).of_frames) == len(read) == len(set(read)) < 65
    assert len(colours_of(seen).steps) >= 31
    assert len(colours_of(seen, [7, 9]).of_frames) == 4, "keyframes, and what follows them"


@pytest.fixture(scope="module")
def mapped(tmp_path_factory) -> dict[str, Path]:
    """A clip as it is, and with a third of its frames in narrow band; with its map."""
    root = tmp_path_factory.mktemp("mapped")
    frames = clip(52, 12)
    write_multimap(slam(colon(52, 12, 9.0).frames, keyframe_every=2).map, root / "map")
    write_folder(frames, root / "white")
    write_folder(changed(frames, lambda linear, i: narrow_band(linear) if i < 4 else linear), root / "third")
    return {name: root / name for name in ("map", "white", "third")}


VERDICTS = [
    ("densify", "white", ""),
    ("densify", "third", "33% of the frames are in another colour than the rest"),
    ("live", "third", "33% of the frames are in another colour than the rest"),
]


@pytest.mark.parametrize(("verb", "name", "said"), VERDICTS)
def test_the_verdict_on_such_light_is_amber_and_gives_the_reason(verb, name, said, mapped, tmp_path):
    argv = [verb, mapped[name], "--map", mapped["map"], "--checkpoint", "decline", "--fit-light=false"]
    assert lightdepth(*argv, "--fusion.voxel", 0.3, "-o", tmp_path / "run") == 0
    run = json.loads((tmp_path / "run" / "run.json").read_text())
    verdict = run["verdict"]
    if said:
        assert verdict["colour"] == "amber" and said in verdict["sentence"]
        assert any(said in w for w in run["warnings"]) and said in (tmp_path / "run" / "report.html").read_text()
    else:
        assert verdict["colour"] == "green" and not run["colour"]["doubts"] and run["colour"]["frames"] == 12


def test_train_and_adapt_and_select_say_it_too(mapped, tmp_path, recwarn):
    third = mapped["third"]
    train = ["train", "--preset", "tube_smoke", "--data.sequences", f"[{third}]", "-o", tmp_path / "run"]
    train += ["--data.tube.scenes", 0, "--data.tube.val_scenes", 0, "--data.size", "[40,32]", "--data.batch_size", 2]
    assert lightdepth(*train, "--trainer.max_steps", 1, "--trainer.logger", "false") == 0
    run = json.loads((tmp_path / "run" / "run.json").read_text())
    (doubt,) = run["warnings"]
    assert doubt.startswith("sequences-") and "33% of the frames are in another colour" in doubt
    assert [colours["in_another_colour"] for colours in run["colour"].values()].count(4) == 1
    assert f"warning: {doubt}" in (tmp_path / "run" / "log.txt").read_text()

    adapt = ["adapt", third, "--checkpoint", tmp_path / "run" / "model.safetensors", "--judge", "none"]
    adapt += [
        "--steps",
        1,
        "--replay",
        0,
        "--batch-size",
        2,
        "--size",
        "[40,32]",
        "--keep-worse",
        "-o",
        tmp_path / "on",
    ]
    lightdepth(*adapt)
    assert any(
        doubt.partition(": ")[2] in w for w in json.loads((tmp_path / "on" / "run.json").read_text())["warnings"]
    )

    lightdepth("select", third, "--map", mapped["map"], "-o", tmp_path / "list.txt")
    assert any("33% of the frames are in another colour" in str(w.message) for w in recwarn)


def test_real_frames_are_not_accused(realdata):
    folders = {
        "sinus/example_training_data_root/bag_1/*/0000*.jpg": None,
        "stella/frames/*.jpg": "stella/mask.png",
        "c3vd_frame/color.png": None,
    }
    for pattern, mask in folders.items():
        meter = ColourMeter()
        for file in sorted(realdata.glob(pattern))[:12]:
            image = cv2.imread(str(file))[..., ::-1].astype(np.float32) / 255
            valid = np.ones(image.shape[:2], bool) if mask is None else cv2.imread(str(realdata / mask), 0) > 127
            meter.add(image, valid)
        found = meter.result()
        assert len(found.of_frames) and not found.doubts, (pattern, found.doubts)
