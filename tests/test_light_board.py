"""The place of an endoscope's lamps, from photographs of printed boards."""

from __future__ import annotations

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from boards import Lamp, Lens, Scene, photograph, turned, write_frames
from raising import refused

from lightdepth.calibration import read_light, write_light
from lightdepth.camera import KannalaBrandt, Pinhole
from lightdepth.cli import main
from lightdepth.datasets import SequenceSource
from lightdepth.errors import MissingOption
from lightdepth.frame import Frame
from lightdepth.light.board import Board, BoardConfig, find_board
from lightdepth.light.board_page import board_page
from lightdepth.light.board_pose import Pose, White, board_pose, white_paper
from lightdepth.light.fit_on_board import LampsConfig, fit_on_board, fit_on_white
from lightdepth.photometry import MeasuredLamps, PhotometricCalibration

PLACE = np.array([2.5, -1.0, -0.5])
PINHOLE, FISHEYE = Lens(400, 300, 240.0), Lens(400, 300, 240.0, True, -0.05)
SMALL = Scene(PINHOLE, squares=(7, 5), square=5.0, marker=3.5)
CHARUCO = Board("charuco", (7, 5), 5.0, 3.5)
ONE = LampsConfig(number=1)
WORDS = ["--position", "charuco", "--board.squares", "[7,5]", "--board.square-mm", "5", "--board.marker-mm", "3.5"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_frames(SMALL, tmp_path_factory.mktemp("board") / "frames", 7, 13, 26)


def image_of(scene: Scene, pose: tuple[np.ndarray, np.ndarray], seed: int = 0) -> np.ndarray:
    return photograph(scene, *pose, np.random.default_rng(seed)).astype(np.float32) / 255


# ---- closed form: paper without photographs


def paper(lamps=((*PLACE, 1.0),), tilts=(35, 5, 25, 40, 15, 30, 20, 38), lens=0.0, stray=0.0, gamma=2.2, **given):
    """White paper under lamps (x, y, z, share) whose light falls off with exp(-1.5 (1 - cosine)), its codes with noise
    of .2 %; the lens darkens with the cosine's power, stray light is a share of what comes from 20 mm."""
    rng, whites = np.random.default_rng(0), []
    across = np.stack(np.meshgrid(np.linspace(-9, 9, 7), np.linspace(-9, 9, 7), [0.0]), -1).reshape(-1, 3)
    for i, tilt in enumerate(tilts):
        distance = given.get("distances", np.geomspace(11, 30, len(tilts)))[i]
        pose = np.eye(4)
        pose[:3, :3] = turned(np.deg2rad(tilt) * np.array([np.cos(1.9 * i), np.sin(1.9 * i), 0]))
        pose[:3, 3] = (0, 0, distance)
        x = across * distance / 20 @ pose[:3, :3].T + pose[:3, 3]
        normal, light = -pose[:3, 2], np.zeros(len(x))
        for *place, share in lamps:
            towards = np.array(place) - x
            far = np.linalg.norm(towards, axis=1)
            light += share * np.exp(-1.5 * (1 + towards[:, 2] / far)) * (towards @ normal) / far**3
        light = (light + stray / 400) * (x[:, 2] / np.linalg.norm(x, axis=1)) ** lens * rng.uniform(0.5, 2)
        log_v = np.log(light) / gamma + 0.002 * rng.standard_normal(len(x))
        whites.append(White(f"{i}", Pose(pose, 0.1), x, log_v, np.full(len(x), 0.002), 0.0))
    return whites


def found_on(whites, config=ONE):
    return fit_on_white(whites, config, "paper", len(whites))


@pytest.mark.parametrize(
    "world",
    [{}, {"lens": 1.5}, {"stray": 0.03}, {"gamma": 1.4}],
    ids=["plain", "a lens that darkens", "light in the room", "another response"],
)
def test_one_lamp_is_found_where_it_is(world):
    found = found_on(paper(**world))
    assert len(found.fit.lamps.shares) == 1
    assert np.abs(found.fit.lamps.middle - PLACE).max() < (0.3 if "stray" in world else 0.1)
    assert (np.abs(found.fit.lamps.middle - PLACE) < found.half_width).all()
    assert found.fit.lamps.gamma == pytest.approx(world.get("gamma", 2.2), rel=0.03)


def test_what_the_lens_darkens_is_told_from_the_lamps_spread_and_both_are_in_mu():
    found = found_on(paper(lens=1.5))
    assert found.lamp_mu == pytest.approx(1.5, abs=0.3) and found.lens_mu == pytest.approx(1.6, abs=0.35)
    light = found.light
    assert light.lamps is not None and light.mu == pytest.approx(found.lamp_mu + light.lamps.lens_mu, abs=1e-3)


def test_a_lens_that_brightens_to_its_side_is_said_to_do_so(tmp_path):
    found = found_on(paper(lens=-0.8))
    assert found.lens_mu < -0.3
    assert f"the lens {found.lens_mu:.2f} (below 0: images are brighter at the edge" in found.summary()
    board_page(found, "paper").write(tmp_path / "page.html")
    assert "below 0: images are brighter at the edge" in (tmp_path / "page.html").read_text(encoding="utf-8")
    assert "below 0" not in found_on(paper(lens=0.8)).summary()


def test_two_lamps_are_told_from_one_by_frames_that_were_kept_from_the_fit():
    two = [(2.6, 0.4, -0.3, 0.6), (-2.2, 0.6, -0.3, 0.4)]
    found = found_on(paper(two), LampsConfig())
    assert len(found.fit.lamps.shares) == 2 and found.withheld[2] < 0.9 * found.withheld[1]
    order = np.argsort(-found.fit.lamps.places[:, 0])
    assert found.fit.lamps.places[order] == pytest.approx(np.array(two)[:, :3], abs=0.25)
    assert found.light.position_mm == pytest.approx((0.68, 0.48, -0.3), abs=0.15)
    assert len(found.light.lamps.positions_mm) == 2
    assert len(found_on(paper(), LampsConfig()).fit.lamps.shares) == 1


def test_a_given_gamma_is_kept_and_an_axis_that_is_not_sought_is_the_cameras():
    found = found_on(paper(), LampsConfig(1, 2.2, axis=False))
    assert found.light.gamma == 2.2 and found.light.direction == (0, 0, 1)
    assert found.half_width.max() < found_on(paper()).half_width.max()


def test_boards_that_all_face_the_camera_at_one_distance_do_not_tell_the_place():
    with refused(
        "the place of the light cannot be determined", "tilted by 0 to 1 degrees", cure="tilted by 20 to 45 degrees"
    ):
        found_on(paper(tilts=[0, 1, 0, 1, 0, 1], distances=[20] * 6))


def test_a_lamp_in_the_middle_of_the_lens_is_not_told_from_no_offset_and_the_interval_is_said():
    with refused("may as well be 0", "±", cure="ring light"):
        found_on(paper([(0.01, 0.0, -0.5, 1.0)]))


def test_brightness_that_no_lamp_explains_is_refused():
    whites = paper()
    rng = np.random.default_rng(0)
    with refused("unexplained", cure="dark room"):
        found_on([replace(w, log_v=w.log_v + 0.15 * rng.standard_normal(len(w))) for w in whites])


# ---- boards in photographs


@pytest.mark.parametrize("lens", [PINHOLE, FISHEYE], ids=["pinhole", "fisheye"])
@pytest.mark.parametrize("charuco", [True, False], ids=["charuco", "checkerboard"])
def test_a_board_is_found_and_lies_where_it_was_put(lens, charuco):
    scene = replace(SMALL, lens=lens, charuco=charuco)
    rotation = turned(np.array([0.4, -0.3, 0.2]))
    shift = np.array([0.5, -0.5, 28.0]) - rotation @ [17.5, 12.5, 0]
    camera = (
        KannalaBrandt(400, 300, 240.0, 240.0, 200.0, 150.0, -0.05, 0.0, 0.0, 0.0)
        if lens.fisheye
        else Pinhole(400, 300, 240.0, 240.0, 200.0, 150.0)
    )
    image = image_of(scene, (rotation, shift))
    sighting = find_board(image, CHARUCO if charuco else Board("checkerboard", (7, 5), 5.0))
    assert sighting is not None and len(sighting.places) >= 20
    pose = board_pose(camera, sighting)
    assert pose is not None and pose.error < 0.3
    normal = rotation[:, 2] * -np.sign(rotation[:, 2] @ shift)
    assert np.degrees(np.arccos(min(pose.normal @ normal, 1.0))) < 0.5
    assert pose.distance == pytest.approx(abs(rotation[:, 2] @ shift), abs=0.1)
    white = white_paper(Frame("0", image, camera), pose, sighting.board)
    assert len(white) > 50 and np.exp(white.log_v).min() > 0.3  # the print is at .2 and below


@pytest.mark.parametrize("legacy", [False, True])
def test_a_charuco_board_that_begins_with_a_marker_has_its_white_there(legacy):
    words = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    drawing = cv2.aruco.CharucoBoard((7, 6), 5.0, 3.5, words)
    drawing.setLegacyPattern(legacy)
    image = drawing.generateImage((360, 310), marginSize=20)[..., None].repeat(3, -1).astype(np.float32) / 255
    sighting = find_board(image, Board("charuco", (7, 6), 5.0, 3.5))
    assert sighting is not None and len(sighting.places) == 30
    assert (sighting.board.white_within(np.array([[2.5, 0.4], [7.5, 0.4]])) > 0).tolist() == [legacy, not legacy]


@pytest.mark.parametrize("size", [(1, 1), (90, 120)])
def test_an_image_without_anything_in_it_shows_no_board(size):
    for level in (0.0, 1.0):
        for board in (CHARUCO, Board("checkerboard", (7, 5), 5.0)):
            assert find_board(np.full((*size, 3), level, np.float32), board) is None


@pytest.mark.parametrize("turn", range(4))
def test_a_checkerboard_that_is_lopsided_has_its_white_where_the_image_is_bright(turn):
    scene = replace(SMALL, charuco=False, squares=(8, 5))
    rotation = turned(np.array([0, 0, turn * np.pi / 2 + 0.1]))
    image = image_of(scene, (rotation, np.array([0, 0, 38.0]) - rotation @ [20, 12.5, 0]))
    sighting = find_board(image, Board("checkerboard", (8, 5), 5.0))
    assert sighting is not None
    camera = Pinhole(400, 300, 240.0, 240.0, 200.0, 150.0)
    white = white_paper(Frame("0", image, camera), board_pose(camera, sighting), sighting.board)
    assert len(white) > 50 and np.exp(white.log_v).min() > 0.3


def test_the_verb_finds_the_lamp_within_three_tenths_of_a_millimetre_and_writes_it_with_its_interval(
    folder, tmp_path, capsys
):
    out = tmp_path / "new" / "light.json"
    argv = ["calibrate-light", str(folder), "-o", str(out), *WORDS]
    assert main(argv) == 0
    assert "light: at x" in capsys.readouterr().out
    light = read_light(out)
    assert np.abs(np.subtract(light.position_mm, PLACE)).max() < 0.3
    assert light.source == "measured" and light.gamma == pytest.approx(2.2, rel=0.05)
    assert light.lamps is not None and 0 < max(light.lamps.deviation_mm) < 0.5
    page = (out.parent / "light.html").read_text(encoding="utf-8")
    assert "90 % interval" in page and page.count("<img") == 1
    assert main(argv) == 3 and "already there" in capsys.readouterr().err
    assert main([*argv, "--overwrite", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)["result"]
    assert all(low < place < high for (low, high), place in zip(told["interval_mm"], light.position_mm, strict=True))


def frames_of(folder, *more):
    return SequenceSource(folder, *more).open()


def test_a_board_that_is_not_there_is_refused_with_what_is(folder, tmp_path):
    with refused("found in 0 of 7 frames; markers of 4x4 are there", cure="--board.dictionary"):
        fit_on_board(frames_of(folder), replace(CHARUCO, dictionary="6x6"))
    with refused("a checkerboard of 7 by 5 squares was found in 0 of 7 frames"):
        fit_on_board(frames_of(folder), Board("checkerboard", (7, 5), 5.0))
    placed = [(turned(np.array([0.2, 0, 0])), np.array([-17.0, -12, 32]))] * 5
    write_frames(replace(SMALL, charuco=False), tmp_path / "checkers", placed=placed)
    with refused("a checkerboard of 7 by 5 squares is there"):
        fit_on_board(frames_of(tmp_path / "checkers"), Board("checkerboard", (6, 4), 5.0))


@pytest.mark.parametrize("wrong", ["squares", "camera"])
def test_a_board_that_does_not_lie_where_the_camera_says_is_refused(folder, tmp_path, wrong):
    board, camera = CHARUCO, folder / "camera.json"
    if wrong == "squares":
        board = replace(CHARUCO, squares=(6, 5))
    else:
        camera = tmp_path / "camera.json"
        camera.write_text(json.dumps(SMALL.lens.file() | {"params": [330.0, 190.0, 240.0, 110.0]}))
    with refused("no farther than 0.3%" if wrong == "camera" else "", cure="expected"):
        fit_on_board(SequenceSource(folder, camera=camera).open(), board)


def test_a_board_in_too_few_frames_or_saturated_is_refused(folder, tmp_path):
    with refused("found in 4 of 4 frames", cure="at least 5: take more"):
        fit_on_board(frames_of(folder)[-4:], CHARUCO)
    (tmp_path / "white" / "frames").mkdir(parents=True)
    for path in sorted((folder / "frames").iterdir()):
        image = cv2.imread(str(path)).astype(float)
        cv2.imwrite(str(tmp_path / "white" / "frames" / path.name), np.clip(2.2 * image, 0, 255).astype(np.uint8))
    (tmp_path / "white" / "camera.json").write_text((folder / "camera.json").read_text())
    with refused("of the board's white is saturated", cure="exposure"):
        fit_on_board(frames_of(tmp_path / "white"), CHARUCO)


def test_a_board_without_a_size_is_wrong_usage_and_sizes_that_contradict_each_other_are_refused():
    for missing in (BoardConfig(None, 4.0, 3.0), BoardConfig((9, 7), None, 3.0), BoardConfig((9, 7), 4.0, None)):
        with pytest.raises(MissingOption):
            Board.of("charuco", missing)
    assert Board.of("checkerboard", BoardConfig((9, 7), 4.0)).squares == (9, 7)
    with refused("--board.marker-mm", cure="less than the square's side"):
        Board.of("charuco", BoardConfig((9, 7), 4.0, 4.0))
    with refused("--board.dictionary", "4x4 has 1000 markers"):
        Board.of("charuco", BoardConfig((60, 60), 4.0, 3.0))


# ---- the file


def test_lamps_survive_their_file_and_a_light_without_them_is_written_as_before(tmp_path):
    lamps = MeasuredLamps(((1.0, 2.0, 0.0), (-1, 2, 0)), (0.25, 0.75), (0.1, 0.1, 0.2), 0.3)
    light = PhotometricCalibration(position_mm=(-0.5, 2, 0), source="measured", lamps=lamps)
    write_light(light, tmp_path / "light.json")
    assert read_light(tmp_path / "light.json") == light
    assert light.co_located().lamps is None
    write_light(replace(light, lamps=None), tmp_path / "plain.json")
    known = {"gamma", "mu", "position_mm", "direction", "gain", "reflectance", "source"}
    assert set(json.loads((tmp_path / "plain.json").read_text())) == known


@pytest.mark.parametrize(
    "wrong",
    [
        {"shares": [1.0, 0.5]},
        {"shares": [2.0]},
        {"positions_mm": []},
        {"deviation_mm": [0.1, -0.1, 0.1]},
        {"deviation_mm": [0.1, 0.1]},
        {"positions_mm": [[1.0, float("nan"), 0.0]]},
        {"number": 2},
    ],
)
def test_lamps_written_wrongly_are_refused_with_their_file(tmp_path, wrong):
    lamps = {"positions_mm": [[1.0, 0.0, 0.0]], "shares": [1.0], "deviation_mm": [0.1, 0.1, 0.1]} | wrong
    (tmp_path / "light.json").write_text(json.dumps({"gamma": 2.2, "lamps": lamps}))
    with refused(where="light.json"):
        read_light(tmp_path / "light.json")


# ---- the bar: twelve poses, two lenses, seeds used for nothing else


@pytest.mark.slow
@pytest.mark.parametrize("fisheye", [False, True])
@pytest.mark.parametrize("seed", range(100, 104))
def test_twelve_boards_place_the_lamp_within_three_tenths_of_a_millimetre(tmp_path, seed, fisheye):
    rng = np.random.default_rng(seed)
    place = (float(rng.uniform(-3, 3)), float(rng.choice([-2, 2])), float(rng.uniform(-1, 0.5)))
    lamp = Lamp(place, tilt=(0.08, -0.05))
    scene = Scene(FISHEYE if fisheye else PINHOLE, (lamp,), marker=3.2, vignetting=1.0, seed=seed)
    frames = frames_of(write_frames(scene, tmp_path / "frames", 12, 12, 30))
    found = fit_on_board(frames, Board("charuco", (9, 7), 4.0, 3.2))
    assert np.abs(found.fit.lamps.middle - place).max() < 0.3
