"""Pictures, masks and names as people really hold them, through the command line."""

from __future__ import annotations

import ast
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from picture_files import Combination, as_bits, npy, pillow, png, tiff
from test_pictures import scene, write

from lightdepth.cli import main
from lightdepth.datasets import open_sequence
from lightdepth.files.depths import white_of
from lightdepth.files.headers import header_of
from lightdepth.files.images import image_size, read_image
from lightdepth.frame import resized_mask

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")


@pytest.fixture(scope="module")
def plain(tmp_path_factory) -> dict[str, np.ndarray]:
    """What predict makes of the plain PNGs."""
    folder = tmp_path_factory.mktemp("plain")
    return predicted(write(folder / "data", None, count=2), folder / "out")


def predicted(data: Path, out: Path, *options: str) -> dict[str, np.ndarray]:
    """Log distance by frame, NaN where not valid, of `lightdepth predict`."""
    argv = ["predict", str(data), "-o", str(out), "--checkpoint", "decline", "--previews", "false", *options]
    assert main(argv) == 0
    found = {}
    for file in sorted(out.glob("*.npz")):
        with np.load(file) as saved:
            found[file.stem] = np.where(saved["valid"], np.log(saved["distance"]), np.nan)
    return found


def refusal(capsys, *argv: str | Path) -> str:
    """What is said where a verb exits with 3."""
    capsys.readouterr()
    assert main([str(word) for word in argv]) == 3
    said = capsys.readouterr().err
    assert "Traceback" not in said
    return said


def same(found: dict[str, np.ndarray], expected: dict[str, np.ndarray], tolerance: float = 0.0) -> bool:
    return list(found) == list(expected) and all(
        np.allclose(found[name], expected[name], atol=tolerance, rtol=0, equal_nan=True) for name in expected
    )


def rewritten(folder: Path, encoded, ending: str, count: int = 2) -> Path:
    """The plain sequence, its pictures written again by `encoded(pixels)`."""
    data = write(folder, None, count=count)
    for i, pixels in enumerate(scene()[:count]):
        (data / "frames" / f"{i:06d}.png").unlink()
        (data / "frames" / f"{i:06d}{ending}").write_bytes(encoded(pixels))
    return data


# ---- orientation


@pytest.mark.parametrize("turned", [3, 6])
def test_a_jpeg_s_orientation_is_left_aside_and_said_and_import_writes_none(tmp_path, capsys, turned):
    untagged = write(tmp_path / "untagged", Combination(".jpg", "8", "none"), count=2)
    tagged = write(tmp_path / "tagged", Combination(".jpg", "8", f"orientation {turned}"), count=2)
    with pytest.warns(UserWarning, match=f"EXIF orientation {turned} .* pixels are taken as they are stored"):
        found = predicted(tagged, tmp_path / "b")
    assert same(found, predicted(untagged, tmp_path / "a"))
    assert main(["import", str(tagged), "-o", str(tmp_path / "in"), "--find-text", "false"]) == 0
    written = [header_of(file) for file in (tmp_path / "in" / "frames").iterdir()]
    assert {head.orientation for head in written} == {1} and {(h.width, h.height) for h in written} == {(96, 80)}


def test_a_tiff_s_orientation_turns_neither_pixels_nor_size_in_either_byte_order(tmp_path):
    pixels = scene()[0]
    for big in (False, True):
        (tmp_path / "a.tif").write_bytes(tiff([pixels.astype(np.uint16) * 257], 6, big))
        assert image_size(tmp_path / "a.tif") == (96, 80)
        assert np.array_equal(read_image(tmp_path / "a.tif"), pixels / np.float32(255))


def test_a_tiff_s_alpha_darkens_nothing(tmp_path):
    pixels = scene()[0]
    (tmp_path / "a.tif").write_bytes(tiff([np.dstack([pixels, np.full(pixels.shape[:2], 100, np.uint8)])]))
    assert np.array_equal(read_image(tmp_path / "a.tif"), pixels / np.float32(255))


# ---- bit depth


def test_ten_bits_stored_as_they_are_show_what_eight_bits_show(tmp_path, plain):
    data = write(tmp_path / "data", Combination(".png", "10 in uint16", "none"), count=2)
    with pytest.warns(UserWarning, match="read as 10 bits: none of their values is above 1023"):
        assert same(predicted(data, tmp_path / "out"), plain, 1e-3)
    assert main(["import", str(data), "-o", str(tmp_path / "in"), "--find-text", "false"]) == 0
    levels = np.unique(cv2.imread(str(tmp_path / "in" / "frames" / "000000.png")))
    assert len(levels) > 100


def test_dark_pictures_of_sixteen_bits_are_taken_for_ten_only_where_the_file_or_the_user_says_so(tmp_path, capsys):
    def dark(pixels):
        return np.minimum(as_bits(10)(pixels), 1000)

    data = rewritten(tmp_path / "data", lambda p: png(dark(p)), ".png")
    said = refusal(capsys, "predict", data, "-o", tmp_path / "no", "--checkpoint", "decline")
    assert "highest value is 1000" in said and "give --bit-depth 10, or --bit-depth 16" in said
    given = predicted(data, tmp_path / "given", "--bit-depth", "10")
    stated = rewritten(tmp_path / "stated", lambda p: png(dark(p), {b"sBIT": b"\x0a\x0a\x0a"}), ".png")
    assert same(predicted(stated, tmp_path / "sbit"), given)
    images = sorted((data / "frames").iterdir())
    assert white_of(images, 16) == 65535
    cv2.imwrite(str(images[1]), np.full((80, 96, 3), 40000, np.uint16))  # one bright frame among dark ones
    assert white_of(images) == 65535


def test_a_picture_beyond_the_white_of_its_sequence_is_refused_by_name(tmp_path, capsys):
    data = write(tmp_path / "data", Combination(".png", "12 in uint16", "none"), count=2)
    argv = ["predict", str(data), "-o", str(tmp_path / "no"), "--checkpoint", "decline", "--bit-depth", "10"]
    said = refusal(capsys, *argv)
    assert "000000.png: uint16 pixels from" in said and "white 1023" in said
    assert "--bit-depth: 99; expected" in refusal(capsys, *argv[:-1], "99")


def test_training_selecting_and_mapping_take_a_bit_depth(tmp_path, capsys):
    data = rewritten(tmp_path / "d", lambda p: png(np.minimum(as_bits(10)(p), 1000)), ".png")
    for verb in (["select", data], ["sparse", data], ["train", "--data.sequences", f"[{data}]"]):
        option = "--data.bit-depth" if verb[0] == "train" else "--bit-depth"
        assert f"give {option} 10" in refusal(capsys, *verb, "-o", tmp_path / "out.txt")


# ---- kinds


@pytest.mark.parametrize(
    ("ending", "encoded", "words"),
    [
        (".gif", lambda p: pillow(p, "GIF", save_all=True, append_images=[_flipped(p)]), "2 pictures in one GIF file"),
        (".tif", lambda p: tiff([p.astype(np.int16) - 300]), "int16 pixels from -300"),
        (".tif", lambda p: tiff([np.where(p > 250, np.nan, p / 255)]), "float64 pixels from nan"),
        (".npy", lambda p: npy(p.transpose(2, 0, 1)), "uint8 of shape 3x80x96; expected a picture"),
        (".npy", lambda p: npy(p)[:200], "not a readable array"),
    ],
    ids=["animated", "negative", "not a number", "channels first", "cut off"],
)
def test_pictures_that_are_none_are_refused_with_what_they_are(tmp_path, capsys, ending, encoded, words):
    data = rewritten(tmp_path / "d", encoded, ending)
    said = refusal(capsys, "predict", data, "-o", tmp_path / "no", "--checkpoint", "decline", "--bit-depth", "8")
    assert words in said and "000000" in said


def _flipped(pixels):
    from PIL import Image

    return Image.fromarray(255 - pixels)


def test_arrays_beside_pictures_are_no_frames_and_alone_they_are(tmp_path, plain):
    data = write(tmp_path / "data", None, count=2)
    for i in range(2):
        np.save(data / "frames" / f"{i:06d}.npy", np.ones((80, 96), np.float32))
    assert same(predicted(data, tmp_path / "a"), plain)
    for i, pixels in enumerate(scene()[:2]):
        (data / "frames" / f"{i:06d}.png").unlink()
        np.save(data / "frames" / f"{i:06d}.npy", pixels)
    assert same(predicted(data, tmp_path / "b"), plain)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes here")
def test_a_named_pipe_among_the_frames_is_refused_not_waited_for(tmp_path, capsys):
    data = write(tmp_path / "data", None, count=2)
    os.mkfifo(data / "frames" / "000002.png")
    for verb in ("predict", "import"):
        assert "000002.png: a named pipe" in refusal(capsys, verb, data, "-o", tmp_path / "no")


def test_a_folder_without_pictures_is_named_as_the_one_that_was_looked_in(tmp_path, capsys):
    data = write(tmp_path / "data", None, count=1)
    (data / "frames" / "000000.png").rename(data / "frames" / "000000.heic")
    said = refusal(capsys, "predict", data, "-o", tmp_path / "no", "--checkpoint", "decline")
    assert f"{data / 'frames'}: no images" in said and "000000.heic" in said


# ---- nothing valid


@pytest.mark.parametrize("verb", ["predict", "train", "adapt", "select"])
def test_black_frames_end_every_verb_with_their_count(tmp_path, capsys, verb):
    data = rewritten(tmp_path / "data", lambda p: png(np.zeros_like(p)), ".png", 4)
    shutil.rmtree(data / "truth")
    what = ["--data.sequences", f"[{data}]"] if verb == "train" else [data]
    said = refusal(capsys, verb, *what, "-o", tmp_path / "out.txt")
    assert "none of the 4 frames has a pixel inside mask and lens that is brighter than 2% of white" in said


def test_black_frames_among_others_are_counted(tmp_path, capsys):
    data = write(tmp_path / "data", None, count=4)
    cv2.imwrite(str(data / "frames" / "000001.png"), np.zeros((80, 96, 3), np.uint8))
    predicted(data, tmp_path / "out")
    assert "1 of 4 frames have no valid pixel" in capsys.readouterr().out


# ---- masks


def _labelled(mask: np.ndarray, tissue: tuple, other: tuple) -> np.ndarray:
    return np.where(mask[..., None], np.array(tissue, np.uint8), np.array(other, np.uint8))


MASKS = {
    "0 and 1": lambda m: m.astype(np.uint8),
    "0 and 1 in 16 bits": lambda m: m.astype(np.uint16),
    "red on black": lambda m: _labelled(m, (0, 0, 255), (0, 0, 0)),
    "dark blue on black": lambda m: _labelled(m, (90, 0, 0), (0, 0, 0)),
    "green on red": lambda m: _labelled(m, (0, 255, 0), (0, 0, 255)),
    "inverted 0 and 1": lambda m: (~m).astype(np.uint8),
    "soft edges": lambda m: cv2.GaussianBlur(255 * m.astype(np.uint8), (3, 3), 0),
    "drawn in the alpha": lambda m: np.dstack([np.full((*m.shape, 3), 255, np.uint8), 255 * m.astype(np.uint8)]),
}


@pytest.mark.parametrize("kind", MASKS)
def test_a_mask_of_any_two_values_is_read(tmp_path, plain, kind):
    data = write(tmp_path / "data", None, count=2)
    mask = cv2.imread(str(data / "mask.png"), cv2.IMREAD_GRAYSCALE) > 0
    cv2.imwrite(str(tmp_path / "mask.png"), MASKS[kind](mask))
    found = predicted(data, tmp_path / "out", "--mask", str(tmp_path / "mask.png"))
    if kind == "soft edges":
        assert all(np.isnan(found[name] - plain[name]).mean() < 0.1 for name in plain)
    else:
        assert same(found, plain)


def test_a_mask_of_several_labels_is_refused(tmp_path, capsys):
    data = write(tmp_path / "data", None, count=2)
    labels = np.repeat(np.arange(4, dtype=np.uint8), 24)[None].repeat(80, 0)
    cv2.imwrite(str(tmp_path / "mask.png"), labels)
    argv = ["predict", data, "-o", tmp_path / "no", "--mask", tmp_path / "mask.png", "--checkpoint", "decline"]
    assert "4 labels, where a mask has two values" in refusal(capsys, *argv)


def test_a_mask_made_smaller_keeps_its_middle():
    """Mirror images of a mask stay mirror images at every size: INTER_NEAREST moves both to one side."""
    v, u = np.mgrid[:90, :120] + 0.5
    disc = np.hypot(u - 60, v - 45) < 40
    for size in ((40, 30), (80, 60), (77, 53), (240, 180)):
        small = resized_mask(disc, size)
        assert np.array_equal(small, small[:, ::-1]) and np.array_equal(small, small[::-1])
    pixel = np.arange(9)[None].repeat(9, 0) < 3
    assert resized_mask(pixel, (3, 3)).sum() == 3  # a third is a third


# ---- black border


def test_the_black_border_of_a_plain_folder_is_found_and_said_by_every_verb(tmp_path, plain):
    data = write(tmp_path / "data", None, count=2)
    mask = cv2.imread(str(data / "mask.png"), cv2.IMREAD_GRAYSCALE) > 0
    (data / "mask.png").unlink()
    octagon = np.zeros((80, 96), np.uint8)
    cv2.fillPoly(octagon, [np.array([[30, 4], [66, 4], [88, 24], [88, 56], [66, 76], [30, 76], [8, 56], [8, 24]])], 1)
    for file in (data / "frames").iterdir():
        cv2.imwrite(str(file), cv2.imread(str(file)) * octagon[..., None])
    with pytest.warns(UserWarning, match=r"\d\d% of the image is a black border, which is left out; give --mask"):
        frames = open_sequence(data)
    assert not frames[0].mask[octagon == 0].any() and frames[0].mask[(octagon > 0) & mask].mean() > 0.9
    for values in predicted(data, tmp_path / "out").values():
        assert np.isnan(values[octagon == 0]).all()


# ---- names and encodings


def test_a_byte_order_mark_and_windows_line_ends_are_read(tmp_path, plain):
    data = write(tmp_path / "data", None, count=2)
    for file in (data / "camera.json", data / "light.json"):
        file.write_bytes(b"\xef\xbb\xbf" + file.read_bytes().replace(b"\n", b"\r\n"))
    (data / "times.csv").write_bytes(b"\xef\xbb\xbfname,seconds\r\n000000,0.5\r\n000001,1.5\r\n")
    assert same(predicted(data, tmp_path / "out"), plain)
    assert [frame.time for frame in open_sequence(data)] == [0.5, 1.5]


def test_a_calibration_in_another_encoding_is_refused_as_such(tmp_path, capsys):
    data = write(tmp_path / "data", None, count=2)
    text = (data / "camera.json").read_text().rstrip().rstrip("}") + ', "note": "caméra"}'
    for encoding in ("latin-1", "utf-16"):
        (data / "camera.json").write_bytes(text.encode(encoding))
        assert "camera.json: not UTF-8" in refusal(capsys, "predict", data, "-o", tmp_path / "out")
    (tmp_path / "k.yaml").write_bytes("# caméra\nK: [1, 2]\n".encode("latin-1"))
    said = refusal(capsys, "convert-camera", tmp_path / "k.yaml", "-o", tmp_path / "c.json")
    assert "not a text file in UTF-8 (at byte 5)" in said


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have no such names")
def test_names_that_are_not_utf_8_lose_no_work(tmp_path, plain):
    data = write(tmp_path / "data", None, count=2).rename(tmp_path / os.fsdecode(b"\xe9tude \xff"))
    for i, file in enumerate(sorted((data / "frames").iterdir())):
        file.rename(file.with_name(os.fsdecode(b"caf\xe9_%06d.png" % i)))
    out = tmp_path / os.fsdecode(b"r\xe9sultat")
    found = predicted(data, out)
    assert all(np.array_equal(a, b, equal_nan=True) for a, b in zip(found.values(), plain.values(), strict=True))
    assert json.loads((out / "run.json").read_text(encoding="utf-8"))["verb"] == "predict"
    keep = ["--keep-names", "true", "--find-text", "false"]
    assert main(["import", str(data), "-o", str(tmp_path / os.fsdecode(b"in\xff")), *keep]) == 0
    assert "\\udce9tude" in (tmp_path / os.fsdecode(b"in\xff") / "report.html").read_text(encoding="utf-8")


@pytest.mark.slow
@pytest.mark.parametrize("locale", ["C", "en_US.ISO-8859-1"])
def test_verbs_run_where_the_locale_knows_no_utf_8(tmp_path, locale):
    data = write(tmp_path / "étude", None, count=2)
    environment = {**os.environ, "LC_ALL": locale, "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    for verb in (["predict", "--checkpoint", "decline"], ["import", "--keep-names", "true"]):
        argv = [sys.executable, "-m", "lightdepth", verb[0], data, "-o", tmp_path / f"résultat {verb[0]}", *verb[1:]]
        done = subprocess.run(list(map(os.fsencode, argv)), env=environment, capture_output=True)
        assert done.returncode == 0, done.stderr.decode(errors="replace")


@pytest.mark.parametrize("package", ["lightdepth", "densify", "train"])
def test_every_text_file_is_read_and_written_in_a_named_encoding(package):
    """The locale's encoding is another on the next machine."""
    found = []
    for file in sorted((Path(__file__).parents[1] / package).rglob("*.py")):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if not isinstance(node, ast.Call) or not isinstance(node.func, ast.Attribute):
                continue
            name, of = node.func.attr, ast.unparse(node.func.value)
            words = [a.value for a in node.args if isinstance(a, ast.Constant) and isinstance(a.value, str)]
            text = name in ("read_text", "write_text", "loadtxt") and of != "model"  # pycolmap's writes numbers
            opened = name == "open" and words and set(words[0]) <= set("rwax+t") and of not in ("av", "tarfile")
            if (text or opened) and "encoding" not in {keyword.arg for keyword in node.keywords}:
                found.append(f"{file.name}:{node.lineno}: {ast.unparse(node)[:80]}")
    assert found == []
