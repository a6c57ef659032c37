"""What users get wrong with their data, and what the program says: what was found, where, and what would be right.

Every mistake is made on data that is read without a word before, and is met through a public entrance. The words are
parts that the message must hold. `python tests/test_mistakes.py` prints the table: the mistake, and what is said.
"""

from __future__ import annotations

import os
import shutil
import sys
import tempfile
import warnings
from pathlib import Path

import cv2
import mistakes_with_frames  # noqa: F401 - adds its mistakes
import mistakes_with_maps  # noqa: F401 - adds its mistakes
import numpy as np
import pytest
from mistakes import KINDS, MISTAKES, Mistake, made, opened
from raising import refused

from lightdepth.cli import main
from lightdepth.datasets import open_sequence
from lightdepth.errors import InputError

# ---- the tests


@pytest.fixture(scope="session")
def originals(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("originals")
    made(folder)
    return folder


def said(case: Mistake, originals: Path, at: Path) -> tuple[str, bool]:
    """What the program says, and whether it refused."""
    path = at / case.data
    shutil.copytree(originals / case.data, path)
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        try:
            other = case.make(path)
            if callable(other):
                other()
            else:
                opened(case.data, path if other is None else other)
        except InputError as error:
            return str(error), True
    return "\n".join(str(w.message) for w in warned), False


@pytest.mark.parametrize("kind", KINDS)
def test_the_same_data_without_a_mistake_are_read_without_a_word(originals, kind):
    with warnings.catch_warnings():
        if kind != "tum":  # which never says what a keyframe saw
            warnings.simplefilter("error")
            warnings.filterwarnings("ignore", ".*black border")  # SimCol3D has none: it is said of one that has
        assert opened(kind, originals / kind)


@pytest.mark.parametrize("case", MISTAKES, ids=lambda case: case.make.__name__)
def test_a_mistake_is_named_with_where_it_is_and_what_would_be_right(originals, tmp_path, capfd, case):
    message, refused = said(case, originals, tmp_path)
    assert refused == case.refused, message or "nothing was said"
    for words in case.words:
        assert words in message


def test_there_are_many_mistakes_and_each_is_of_its_own():
    assert len(MISTAKES) >= 30
    assert len({case.did for case in MISTAKES}) == len({case.make.__name__ for case in MISTAKES}) == len(MISTAKES)


VERBS = {
    "predict in a folder one level too high": (["predict", "HERE"], "It holds folders of frames"),
    "predict without a calibration": (["predict", "HERE/bare"], "no camera.json; give --camera FILE"),
    "predict as another format": (["predict", "HERE/c3vd", "--format", "hamlyn"], "it looks like --format c3vd"),
    "predict with a mask of another size": (["predict", "HERE/frames", "--mask", "HERE/mask.png"], "the mask is 10x10"),
    "predict with a mistyped light": (["predict", "HERE/frames", "--light", "gama=2"], "is gamma meant?"),
    "densify with a map of other frames": (["densify", "HERE/late", "--map", "HERE/colmap"], "and none in common"),
    "densify with a map that is none": (["densify", "HERE/frames", "--map", "HERE/frames"], "no map in it"),
    "train and validate on one sequence": (
        ["train", "--data.sequences", "[HERE/frames]", "--data.val_sequences", "[HERE/frames]"],
        "is validated on, but also trained on",
    ),
    "train on a split that is not downloaded": (
        ["train", "--data.split", "HERE/split/split.yaml", "--data.root", "HERE/colmap"],
        "1 of the sequences of",
    ),
}


@pytest.mark.parametrize("what", VERBS)
def test_a_verb_says_it_without_a_traceback_exits_with_3_and_leaves_nothing(originals, tmp_path, capfd, what):
    argv, words = VERBS[what]
    here = tmp_path / "here"
    shutil.copytree(originals, here)
    shutil.copytree(here / "frames" / "frames", here / "bare")
    shutil.copytree(here / "frames", here / "late")
    for image in sorted((here / "late" / "frames").iterdir()):
        image.rename(image.with_name(f"{int(image.stem) + 900:06d}.png"))
    shutil.rmtree(here / "late" / "truth")
    cv2.imwrite(str(here / "mask.png"), np.full((10, 10), 255, np.uint8))
    extra = ["--checkpoint", "decline"] if argv[0] != "train" else []
    assert main([a.replace("HERE", str(here)) for a in argv] + extra + ["-o", str(tmp_path / "out")]) == 3
    err = capfd.readouterr().err
    assert words in err and "Traceback" not in err
    assert sorted(os.listdir(tmp_path)) == ["here"]


def test_one_broken_image_does_not_keep_the_others_from_being_read(originals, tmp_path, capfd):
    shutil.copytree(originals / "frames", tmp_path / "frames")
    (tmp_path / "frames" / "frames" / "000000.png").write_bytes(b"")
    read = open_sequence(tmp_path / "frames")
    assert read[1].number == 1 and read[2].number == 2
    with refused(found="0 bytes"):
        read[0]


def table() -> str:
    """Markdown: every mistake and what is said to it, without the folders it was made in."""
    lines = ["| the user | refused | what the program says |", "|---|---|---|"]
    with tempfile.TemporaryDirectory() as folder:
        made(Path(folder) / "originals")
        for case in MISTAKES:
            at = Path(folder) / case.make.__name__
            message, refused = said(case, Path(folder) / "originals", at)
            message = message.replace(f"{at}/", "").replace(str(at), ".").replace("|", "\\|").replace("\n", "<br>")
            lines.append(f"| {case.did} | {'yes' if refused else 'warned'} | {message} |")
    return "\n".join(lines)


if __name__ == "__main__":
    sys.stdout.write(table() + "\n")
