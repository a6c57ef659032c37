"""`lightdepth import`: what it takes from a video, what it leaves behind, and what it says is wrong."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from raising import refused
from verbs import by_options
from videos import CAMERA, OCTAGON, picture, uneven_times, write_video

from lightdepth.calibration import write_camera
from lightdepth.cli import main
from lightdepth.command_line.verbs import verb_parser
from lightdepth.command_line.words import spelled
from lightdepth.commands.import_frames import import_frames as import_frames_verb
from lightdepth.datasets import FrameSequence, VideoFile, open_sequence, write_folder
from lightdepth.datasets.sequence import border_mask
from lightdepth.frame import Frame
from lightdepth.image_quality import Measures, Meter, one_field
from lightdepth.importing.overlay import find_overlay
from lightdepth.importing.selection import BLURRED, DOUBLE, KEPT, PASSED, UNREADABLE, Choice, selected
from lightdepth.models import DeclineModel, predict

import_frames = by_options(import_frames_verb)

COUNT = 72
TIMES = uneven_times(COUNT, seed=1)
SMEARED = set(range(4, COUNT, 6))
TAGS = {"title": "MUELLER HANS", "comment": "born 1950", "creation_time": "2021-03-04T05:06:07Z", "location": "+48+11/"}


def smeared(image: np.ndarray) -> np.ndarray:
    return cv2.GaussianBlur(image, (0, 0), 3) * OCTAGON[..., None].astype(np.uint8)


@pytest.fixture(scope="session")
def sources(tmp_path_factory) -> dict[str, Path]:
    """One examination with blurred frames in between, at a variable frame rate, in two codecs."""
    folder = tmp_path_factory.mktemp("Mueller_Hans_1950")
    images = [smeared(picture(i)) if i in SMEARED else picture(i) for i in range(COUNT)]
    write_camera(CAMERA, folder / "camera.json")
    return {
        "h264": write_video(folder / "Mueller_Hans.mp4", images, TIMES, tags=TAGS, bf="2", crf="20"),
        "ffv1": write_video(folder / "Mueller_Hans.mkv", images, TIMES, "ffv1", "bgr0", TAGS),
    }


@pytest.fixture(scope="session")
def imported(sources, tmp_path_factory) -> dict[str, Path]:
    """Both of them imported at 4 frames per second."""
    outputs = {}
    for codec, source in sources.items():
        outputs[codec] = tmp_path_factory.mktemp("out") / codec
        import_frames(source, outputs[codec], rate=4)
    return outputs


def findings(folder: Path) -> str:
    return " ".join(f["found"] for f in json.loads((folder / "run.json").read_text())["findings"])


def iou(a: np.ndarray, b: np.ndarray) -> float:
    return (a & b).sum() / (a | b).sum()


@pytest.mark.parametrize("codec", ["h264", "ffv1"])
def test_a_real_video_becomes_a_sequence_with_its_times_its_border_and_its_sharp_frames(imported, codec):
    frames = open_sequence(imported[codec])
    assert frames.source == str(imported[codec]) and frames[0].camera == CAMERA
    for frame in frames:
        assert frame.time == pytest.approx(TIMES[frame.number], abs=1e-3)
    intervals = [int(frame.time * 4 + 1e-6) for frame in frames]
    assert intervals == list(range(int(TIMES[-1] * 4) + 1))  # one in each quarter of a second, by time
    assert not SMEARED & set(frames.numbers)
    assert iou(frames[0].mask, OCTAGON) >= 0.97
    beyond = cv2.dilate(OCTAGON.astype(np.uint8), np.ones((9, 9))) == 0
    assert frames[0].image[beyond].max() == 0
    expected = picture(frames[3].number) / 255
    assert np.abs(frames[3].image - expected).mean() < (1e-6 if codec == "ffv1" else 0.03)


def test_what_was_imported_is_predicted_on(imported):
    frames = open_sequence(imported["h264"])
    predictions = list(predict(DeclineModel(rows=64), frames[:2]))
    assert [p.name for p in predictions] == frames.names[:2] and np.isfinite(predictions[0].distance).all()
    assert predictions[0].valid[OCTAGON].mean() > 0.9


def test_frames_of_other_sources_keep_their_numbers_and_times(tmp_path):
    frames = [
        Frame(f"{n:06d}", picture(n).astype(np.float32) / 255, CAMERA, time=n / 10, true_world_from_cam=np.eye(4))
        for n in range(30, 60, 2)
    ]
    write_folder(frames, tmp_path / "in")
    import_frames(tmp_path / "in", tmp_path / "out", blur=0, start=1.0, end=2.0)
    read = open_sequence(tmp_path / "out")
    assert read.numbers == list(range(40, 52, 2)) and read[1].time == pytest.approx(4.2)
    np.testing.assert_array_equal(read[0].image, frames[5].image)


def test_without_a_camera_it_is_imported_and_the_report_and_the_next_command_say_so(tmp_path, capsys):
    (tmp_path / "in").mkdir()
    for i in range(12):
        cv2.imwrite(str(tmp_path / "in" / f"Mueller_{i}.png"), picture(i)[..., ::-1])
    assert main(["import", str(tmp_path / "in"), "-o", str(tmp_path / "out")]) == 0
    assert f"next: lightdepth densify {tmp_path / 'out'} --camera auto -o runs/dense" in capsys.readouterr().out
    assert not (tmp_path / "out" / "camera.json").exists() and "No calibration" in findings(tmp_path / "out")
    with refused(found="no camera.json", cure="give --camera"):
        open_sequence(tmp_path / "out")
    assert b"Mueller" not in b"".join(f.read_bytes() for f in (tmp_path / "out").rglob("*") if f.is_file())


def test_neither_metadata_nor_file_names_are_carried_over(imported, sources, tmp_path):
    assert b"MUELLER" in sources["h264"].read_bytes()
    files = [f for f in imported["h264"].rglob("*") if f.is_file()]
    everything = b"".join(f.name.encode() + f.read_bytes() for f in files).lower()
    for secret in (b"mueller", b"born 1950", b"2021-03-04", b"+48+11"):
        assert secret not in everything
    png = next(f for f in files if f.suffix == ".png").read_bytes()
    assert not any(chunk in png for chunk in (b"tEXt", b"iTXt", b"zTXt", b"eXIf", b"tIME"))
    assert "carries metadata (comment, " in findings(imported["h264"])
    import_frames(sources["h264"], tmp_path / "named", every=20, keep_names=True)
    assert "Mueller_Hans.mp4" in (tmp_path / "named" / "report.html").read_text()


def test_a_report_for_mailing_has_no_picture_of_the_patient_and_no_name(sources, imported, tmp_path, monkeypatch):
    argv = ["import", str(sources["h264"]), "-o", str(tmp_path / "out"), "--no-frames"]
    monkeypatch.setattr("sys.argv", ["lightdepth", *argv])
    assert main(argv) == 0
    everything = b"".join(f.read_bytes() for f in (tmp_path / "out").iterdir()).lower()
    assert b"mueller" not in everything and str(tmp_path).lower().encode() not in everything
    left = sorted(f.name for f in (tmp_path / "out").iterdir())
    assert left == ["config.yaml", "frames.csv", "log.txt", "report.html", "run.json"]
    page, whole = ((folder / "report.html").read_text() for folder in (tmp_path / "out", imported["h264"]))
    assert "<h2>Pictures" in whole and "<h2>Pictures" not in page and whole.count("<img") > page.count("<img") + 2


def strokes(text: str, at: tuple[int, int], scale: float = 0.5) -> np.ndarray:
    canvas = np.zeros(OCTAGON.shape, np.uint8)
    cv2.putText(canvas, text, at, cv2.FONT_HERSHEY_SIMPLEX, scale, 255, 1, cv2.LINE_AA)
    return canvas


def burnt(image: np.ndarray, alpha: np.ndarray, color: tuple[int, int, int]) -> np.ndarray:
    share = alpha[..., None] / 255
    return np.rint(image * (1 - share) + share * np.array(color)).astype(np.uint8)


@pytest.mark.parametrize("color", [(255, 255, 255), (250, 220, 40), (40, 230, 60)], ids=["white", "yellow", "green"])
@pytest.mark.parametrize("codec", ["none", "h264"])
def test_text_on_moving_tissue_is_found_and_hardly_anything_else(color, codec, tmp_path):
    fixed = np.maximum(strokes("MUELLER, HANS", (50, 50)), strokes("12.03.1950", (90, 180), 0.4))
    images, counting = [], np.zeros_like(fixed)
    for i in range(60):
        clock = strokes(f"10:42:{i // 3:02d}", (110, 120), 0.45)
        counting = np.maximum(counting, clock)
        images.append(burnt(picture(i), np.maximum(fixed, clock), color))
    if codec == "h264":
        video = VideoFile(write_video(tmp_path / "a.mp4", images, np.arange(60) / 25))
        images = [video.read(i) for i in range(60)]
    overlay = find_overlay(images[::2], OCTAGON)
    text = np.maximum(fixed, counting) > 64
    assert overlay.moved and (overlay.mask & text).sum() >= 0.95 * text.sum()
    boxes = np.zeros(text.shape, np.uint8)  # what must go: lines of text, not their strokes alone
    for part in (strokes("MUELLER, HANS", (50, 50)), strokes("12.03.1950", (90, 180), 0.4), counting):
        x, y, w, h = cv2.boundingRect((part > 64).astype(np.uint8))
        boxes[max(0, y - 5) : y + h + 5, max(0, x - 5) : x + w + 5] = 1
    wrong = overlay.mask & (boxes == 0) & OCTAGON
    assert wrong.sum() <= 0.02 * OCTAGON.sum()


@pytest.mark.parametrize("place", [(2, 30), (200, 190)], ids=["from the border in", "from the tissue out"])
def test_letters_on_the_border_go_with_the_line_that_they_belong_to(place, tmp_path):
    alpha = strokes("PAT 4711", place)
    across = alpha > 128
    assert (across & OCTAGON).any() and (across & ~OCTAGON).any()
    images = [burnt(picture(i), alpha, (255, 255, 255)) for i in range(60)]
    source = write_video(tmp_path / "a.mkv", images, np.arange(60) / 25, "ffv1", "bgr0")
    import_frames(source, tmp_path / "out")
    mask = cv2.imread(str(tmp_path / "out" / "mask.png"), cv2.IMREAD_GRAYSCALE) > 0
    assert not (mask & across).any() and iou(mask | across, OCTAGON) > 0.9
    for file in (tmp_path / "out" / "frames").iterdir():
        assert cv2.imread(str(file))[across].max() < 25, file.name  # the tips of letters, thinner than a pixel


def test_where_there_is_no_text_none_is_found():
    images = [picture(i) for i in range(60)]
    assert find_overlay(images, OCTAGON).mask.sum() <= 0.001 * OCTAGON.sum()


def test_of_a_camera_that_stands_still_it_is_said_that_text_cannot_be_told():
    rng = np.random.default_rng(0)
    still = [np.clip(picture(0) + rng.normal(0, 2, (208, 256, 1)), 0, 255).astype(np.uint8) for _ in range(30)]
    overlay = find_overlay(still, OCTAGON)
    assert not overlay.moved and not overlay.mask.any()


def test_text_is_black_in_the_frames_and_invalid_in_the_mask_and_more_can_be_given(tmp_path):
    alpha = np.maximum(strokes("MUELLER", (60, 60)), strokes("LOGO", (1, 12), 0.4))  # on tissue, and beyond it
    images = [burnt(picture(i), alpha, (255, 255, 255)) for i in range(60)]
    write_camera(CAMERA, tmp_path / "camera.json")
    source = write_video(tmp_path / "a.mkv", images, np.arange(60) / 25, "ffv1", "bgr0")
    more = np.zeros(OCTAGON.shape, np.uint8)
    more[150:160, 100:140] = 255
    cv2.imwrite(str(tmp_path / "more.png"), more)
    import_frames(source, tmp_path / "out", overlay_mask=tmp_path / "more.png", size=(128, 104))
    text = cv2.resize(np.maximum(alpha, more), (128, 104), interpolation=cv2.INTER_AREA) > 128
    for frame in open_sequence(tmp_path / "out"):
        assert frame.image[text].max() == 0 and not frame.mask[text].any()
        assert frame.camera == CAMERA.resized(128, 104)
    assert "Burnt-in text" in findings(tmp_path / "out")


def test_the_border_may_be_cut_off_and_the_camera_with_it(sources, tmp_path):
    wide = [cv2.copyMakeBorder(picture(i), 20, 30, 40, 50, cv2.BORDER_CONSTANT) for i in range(40)]
    camera = CAMERA.cropped(-40, -20, 346, 258)
    write_camera(camera, tmp_path / "camera.json")
    write_video(tmp_path / "a.mkv", wide, np.arange(40) / 25, "ffv1", "bgr0")
    import_frames(tmp_path / "a.mkv", tmp_path / "out", crop="auto")
    frame = open_sequence(tmp_path / "out")[0]
    assert abs(frame.camera.width - 256) <= 4 and abs(frame.camera.height - 208) <= 4
    ray, _ = frame.camera.unproject(np.array([frame.camera.cx + 30, frame.camera.cy - 20]))
    expected, _ = camera.unproject(np.array([camera.cx + 30, camera.cy - 20]))
    np.testing.assert_allclose(ray, expected)
    x, y = camera.cx - frame.camera.cx, camera.cy - frame.camera.cy
    assert x == round(x) and y == round(y)
    window = wide[frame.number][int(y) : int(y) + frame.camera.height, int(x) : int(x) + frame.camera.width]
    assert np.abs(frame.image * 255 - window)[frame.mask].max() < 1e-3


def woven(count: int = 24) -> list[np.ndarray]:
    """Interlaced pictures: the odd rows are taken half a frame later."""
    images = []
    for i in range(count):
        even, odd = picture(2 * i), picture(2 * i + 1)
        even[1::2] = odd[1::2]
        images.append(even)
    return images


def test_interlaced_pictures_are_told_and_one_field_is_kept(tmp_path):
    images = woven()
    source = write_video(tmp_path / "a.mkv", images, np.arange(len(images)) / 25, "ffv1", "bgr0")
    import_frames(source, tmp_path / "told", frames=False)
    import_frames(source, tmp_path / "kept", every=1, deinterlace=True)
    assert "interlaced" in findings(tmp_path / "told") and "interlaced" not in findings(tmp_path / "kept")
    field = one_field(images[5])
    np.testing.assert_array_equal(field[::2], images[5][::2])
    inside = cv2.erode(OCTAGON.astype(np.uint8), np.ones((9, 9))) > 0
    error = [np.abs(found.astype(float) - picture(10))[inside].mean() for found in (field, images[5])]
    assert error[0] < 0.4 * error[1]
    ramp = np.repeat(np.arange(0, 200, 2, dtype=np.uint8)[:, None, None], 3, 2).repeat(4, 1)
    np.testing.assert_array_equal(one_field(ramp)[:-1], ramp[:-1])  # every row stays in its place


def measures(**given: object) -> Measures:
    count = len(next(iter(given.values())))
    usual = {"brightness": 120, "saturated": 0, "dark": 0, "sharpness": 0.2, "change": 5, "combing": 0.6}
    usual |= {"red": 150, "green": 90, "blue": 80}
    return Measures(**{k: np.array(given.get(k, [v] * count), float) for k, v in usual.items()})


def test_frames_are_chosen_by_time_and_what_is_blurred_frozen_or_unreadable_is_not():
    times = np.array([0, 0.1, 0.2, 0.5, 0.55, 1.4, 1.45, 1.5, 1.6])
    found = measures(
        sharpness=[0.2, 0.22, 0.21, 0.05, 0.2, 0.2, 0.2, 0.25, 0.24],
        change=[np.inf, 5, 5, 5, 5, 5, 0, 5, 5],
        brightness=[120, 120, 120, 120, 120, 120, 120, 120, np.nan],
    )
    fate = selected(times, found, Choice(rate=2))
    assert fate.tolist() == [PASSED, KEPT, PASSED, BLURRED, KEPT, KEPT, DOUBLE, KEPT, UNREADABLE]
    assert (selected(times, found, Choice(blur=0)) == KEPT).sum() == 7
    assert np.flatnonzero(selected(times, found, Choice(every=2, blur=0)) == KEPT).tolist() == [0, 2, 4]
    assert (selected(times, found, Choice(max_frames=3)) == KEPT).sum() == 3
    with refused(found="the frames have no times", cure="choose with --every"):
        selected(np.full(9, np.nan), found, Choice(rate=2))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"rate": 2.0, "every": 3}, "give one of them"),
        ({"rate": 0.0}, "above 0"),
        ({"every": 0}, "at least 1"),
        ({"blur": 1.0}, "below 1"),
        ({"start": 2.0, "end": 1.0}, "an end after the start"),
        ({"start": 99.0}, "no frames between"),
        ({"size": (0, 5)}, "from 1 to"),
    ],
)
def test_wrong_options_are_refused_and_leave_nothing(sources, tmp_path, options, message):
    with refused(message):
        import_frames(sources["ffv1"], tmp_path / "out", **options)
    assert not list(tmp_path.iterdir())


def test_what_is_wrong_is_said_in_plain_sentences(tmp_path):
    spoiled = []
    for i in range(60):
        image = picture(i // 2 if i < 30 else i)  # every second frame repeats the one before
        image[100:160, 20 + i // 2 * 2 : 190 + i // 2 * 2] = 255
        spoiled.append((image * (0.6 if i % 10 < 5 else 1)).astype(np.uint8) if i < 40 else image)
    write_camera(CAMERA.resized(512, 416), tmp_path / "camera.json")
    source = write_video(tmp_path / "a.mkv", spoiled, np.arange(60) / 25, "ffv1", "bgr0")
    import_frames(source, tmp_path / "out")
    said = findings(tmp_path / "out")
    for words in ("calibrated at 512x416: it was rescaled by 0.5", "repeat the frame before", "saturated", "jumps"):
        assert words in said
    assert open_sequence(tmp_path / "out")[0].camera == CAMERA
    write_camera(CAMERA.cropped(0, 0, 200, 208), tmp_path / "camera.json")
    dark = [np.repeat((image.mean(-1, keepdims=True) * 0.2), 3, -1).astype(np.uint8) for image in spoiled]
    write_video(source, dark, np.arange(60) / 25, "ffv1", "bgr0")
    import_frames(source, tmp_path / "dark")
    said = findings(tmp_path / "dark")
    assert all(words in said for words in ("cropped or padded", "Dark:", "grey"))
    assert not (tmp_path / "dark" / "camera.json").exists()


def test_a_video_cut_off_is_imported_as_far_as_it_goes(sources, tmp_path):
    data = sources["h264"].read_bytes()
    (tmp_path / "cut.mp4").write_bytes(data[: len(data) // 2])
    write_camera(CAMERA, tmp_path / "camera.json")
    import_frames(tmp_path / "cut.mp4", tmp_path / "out")
    assert "cut off" in findings(tmp_path / "out") and 3 < len(open_sequence(tmp_path / "out")) < 20


def test_sharpness_does_not_depend_on_exposure_and_falls_with_blur():
    meter = Meter(OCTAGON)
    for image in (picture(0), (picture(0) * 0.6).astype(np.uint8), smeared(picture(0))):
        meter.add(image)
    plain, darker, blurred = meter.result().sharpness
    assert darker == pytest.approx(plain, rel=0.15) and blurred < 0.6 * plain


@pytest.mark.parametrize("kind", ["octagon", "circle"])
def test_a_border_with_noise_text_and_a_dark_lumen_is_found_all_the_same(kind):
    rng = np.random.default_rng(1)
    v, u = np.mgrid[:208, :256] + 0.5
    region = OCTAGON if kind == "octagon" else np.hypot(u - 128, v - 104) < 98
    images = []
    for i in range(8):
        image = picture(12 * i, region).astype(float)
        image[np.hypot(u - 128 - 3 * i, v - 104) < 25] = 3  # the lumen
        image = image + np.abs(rng.normal(0, 7, image.shape))
        image = np.clip(image, 0, 255).astype(np.uint8)
        cv2.putText(image, "NAME", (2, 12), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (255, 255, 255), 1)
        images.append(image.astype(np.float32) / 255)
    assert iou(border_mask(images), region) >= 0.97


def test_flags_may_be_given_bare():
    argv = ["--no_frames", "--keep_names", "--deinterlace", "false", "SRC", "--overwrite"]
    words = spelled(verb_parser(import_frames_verb, "import"), argv)
    assert words == ["--frames=false", "--keep_names=true", "--deinterlace", "false", "SRC", "--overwrite"]


def test_the_sequence_that_is_read_is_one_of_ours(imported):
    assert isinstance(open_sequence(imported["ffv1"], "folder"), FrameSequence)
