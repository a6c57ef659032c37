"""One door for pictures: whatever their format, depth and tags, every verb sees the pixels of the plain 8-bit PNGs."""

from __future__ import annotations

import json
import os
import random
import sys
import time
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from colons import colon
from picture_files import Combination, all_combinations
from verbs import by_options

from lightdepth.calibration import write_camera, write_light
from lightdepth.commands.calibrate_light import calibrate_light
from lightdepth.commands.import_frames import import_frames
from lightdepth.commands.predict import predict
from lightdepth.errors import InputError
from train.commands.train import train

CHEAP = {"predict": 16, "import": 1, "calibrate-light": 1}
ALL = {**CHEAP, "train": 1}
COUNT = {"predict": 2, "import": 2, "calibrate-light": 4, "train": 3}


@cache
def scene() -> list[np.ndarray]:
    """8-bit pictures of a colon, with highlights at white, as real ones have, and so bright that 10 bits tell them."""
    frames = colon(0, 4, 6.0).frames
    pictures = []
    for i, frame in enumerate(frames):
        pixels = np.rint(255 * frame.image**0.6).astype(np.uint8)
        pixels[38:40, 40 + i : 43 + i] = 255
        pictures.append(pixels)
    return pictures


def write(folder: Path, combination: Combination | None, plain_of: Combination | None = None, count: int = 4) -> Path:
    """A sequence of the scene's pictures, with camera, light and mask, and truth where there are so many that a verb
    needs it: plain PNGs, or a combination's files."""
    frames = colon(0, 4, 6.0).frames
    (folder / "frames").mkdir(parents=True)
    if count == COUNT["calibrate-light"]:
        (folder / "truth" / "distance").mkdir(parents=True)
    write_camera(frames[0].camera, folder / "camera.json")
    write_light(frames[0].light, folder / "light.json")
    cv2.imwrite(str(folder / "mask.png"), 255 * frames[0].mask.astype(np.uint8))
    for i, pixels in enumerate(scene()[:count]):
        if combination is not None:
            combination.write(folder / "frames" / f"{i:06d}", pixels)
        else:
            shown = pixels if plain_of is None else plain_of.plain(pixels)
            cv2.imwrite(str(folder / "frames" / f"{i:06d}.png"), shown[..., ::-1])
        if count == COUNT["calibrate-light"]:
            cv2.imwrite(str(folder / "truth" / "distance" / f"{i:06d}.tiff"), frames[i].true_distance)
    return folder


def run(verb: str, data: Path, out: Path) -> dict[str, np.ndarray]:
    """What a verb makes of a sequence, as arrays by name."""
    if verb == "predict":
        by_options(predict)(data, out, checkpoint="decline", previews=False)
        found = {}
        for file in sorted(out.glob("*.npz")):
            with np.load(file) as saved:
                found[file.stem] = np.where(saved["valid"], np.log(saved["distance"]), np.nan)
        return found
    if verb == "import":
        by_options(import_frames)(data, out, find_text=False)
        return {
            f.name: cv2.imread(str(f), cv2.IMREAD_UNCHANGED) for f in [*(out / "frames").iterdir(), out / "mask.png"]
        }
    if verb == "calibrate-light":
        by_options(calibrate_light)(data, out.with_suffix(".json"))
        light = json.loads(out.with_suffix(".json").read_text())
        return {name: np.array(light[name], float) for name in ("gamma", "mu")}
    argv = ["--data.sequences", f"[{data}]", "--data.size", "[24,20]", "--trainer.max_steps", "1", "-o", str(out)]
    train([*argv, "--data.tube.val_scenes", "0"])
    from safetensors.numpy import load_file

    return load_file(out / "model.safetensors")


def difference(combination: Combination, verb: str, folder: Path, oracles: dict) -> str:
    """How what a verb makes of a combination differs from what it makes of the plain PNGs; nothing where it does not,
    or where the refusal that is due was said."""
    key = (verb, combination.ending if combination.plain(scene()[0]) is not scene()[0] else "")
    if key not in oracles:
        plain = write(folder / f"plain {verb}{key[1]}", None, combination, COUNT[verb])
        oracles[key] = run(verb, plain, folder / f"oracle {verb}{key[1]}")
    data = write(folder / "data", combination, count=COUNT[verb])
    try:
        found = run(verb, data, folder / "out")
    except InputError as error:
        if combination.refused and combination.refused in str(error):
            return ""
        return f"refused: {error}"
    if combination.refused:
        return f"it was not refused with {combination.refused!r}"
    expected = oracles[key]
    if set(found) != set(expected):
        return f"{sorted(found)} for {sorted(expected)}"
    for name, values in expected.items():
        mine, theirs = np.asarray(found[name], float), np.asarray(values, float)
        if mine.shape != theirs.shape or not np.array_equal(np.isnan(mine), np.isnan(theirs)):
            return f"{name}: another shape, or other pixels are valid"
        off = float(np.nanmax(np.abs(mine - theirs)))
        allowed = {"predict": 1e-3, "calibrate-light": 5e-3, "train": 5e-3}.get(verb, 0) if combination.reduced else 0
        if off > allowed:
            return f"{name}: off by {off:.2g}"
    return ""


def drawn(count: int, verbs: dict[str, int], seed: int, folder: Path) -> list[str]:
    """The differences of so many combinations with verbs, drawn by the seed."""
    rng = random.Random(seed)
    known = all_combinations()
    oracles: dict = {}
    found = []
    for i in range(count):
        combination = rng.choice(known)
        verb = rng.choices(list(verbs), list(verbs.values()))[0]
        (folder / str(i)).mkdir()
        wrong = difference(combination, verb, folder / str(i), oracles)
        if wrong:
            found.append(f"{verb} of {combination}: {wrong}")
    return found


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_sixty_drawn_kinds_of_files_are_to_a_verb_what_plain_pngs_are_or_are_refused_by_name(tmp_path):
    seed = int(os.environ.get("LIGHTDEPTH_SEED", "16"))
    print(f"seed {seed}")
    assert drawn(60, CHEAP, seed, tmp_path) == [], f"seed {seed}"


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_three_hundred_drawn_kinds_of_files_are_to_a_verb_what_plain_pngs_are_or_are_refused_by_name(tmp_path):
    seed = int(os.environ.get("LIGHTDEPTH_SEED", str(time.time_ns() % 1_000_000)))
    sys.stdout.write(f"seed {seed}\n")
    assert drawn(300, ALL, seed, tmp_path) == [], f"seed {seed}"
