"""Frames worth training on: the rules on frames whose matches are given, the matchers on rendered colons, the verb."""

from __future__ import annotations

import csv
import os
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from bad_stretches import Stretches, bad_stretches
from colons import colon, slam
from raising import refused
from scenes import LENSES
from verbs import by_options

from lightdepth.camera import Pinhole
from lightdepth.datasets import write_folder
from lightdepth.errors import InputError, MachineFailure
from lightdepth.frame import Frame
from lightdepth.maps import write_text_model
from lightdepth.sparse_map import SparseMap
from lightdepth.tube import ShapeConfig, TextureConfig, TubeConfig, lens
from train.commands.select import select as select_verb
from train.datamodule import FrameData, FrameDataModule
from train.frame_lists import read_frame_list
from train.selecting.covisibility import (
    BLUR,
    FEW_KEYFRAMES,
    FEW_VIEWS,
    LOFTR_NODES,
    NO_MATCHES,
    NOT_IN_MAP,
    SIFT_NODES,
    UNREADABLE,
    MapRules,
    NodeRules,
    published_pairs,
    select_by_map,
    select_by_matching,
)
from train.selecting.matching import (
    LoftrMatcher,
    LoftrSettings,
    MatchAgreement,
    OrientationDescriptor,
    SiftMatcher,
    epipolar_inliers,
)

select = by_options(select_verb)

CAMERA = Pinhole(8, 8, 8.0, 8.0, 4.0, 4.0)
RULES = NodeRules(similarity=0.9, min_matches=10, min_spread=0.0, min_views=3, max_skipped=2, min_frames=1, max_views=9)


class Scripted:
    """Frames whose place is a letter of a word: those of one letter match, those of one capital are also alike."""

    def __init__(self, word: str, features: list[int] | None = None):
        self.word, self.features = word, features or [100] * len(word)
        self.matched: list[tuple[int, int]] = []
        self.names = [f"{i:04d}" for i in range(len(word))]
        self.frames = [Frame(name, np.zeros((8, 8, 3), np.float32), CAMERA) for name in self.names]

    def describe(self, frame: Frame) -> np.ndarray:
        vector = np.zeros(200)
        letter = self.word[frame.number]
        vector[ord(letter) if letter.isupper() else 130 + frame.number] = 1
        return vector

    def keep(self, frame: Frame) -> int:
        return frame.number

    def count(self, kept: int) -> int:
        return self.features[kept]

    def agree(self, one: int, other: int) -> MatchAgreement:
        self.matched.append((one, other))
        same = self.word[one].lower() == self.word[other].lower()
        return MatchAgreement(100 if same else 0, 0.5 if same else 0.0)

    def select(self, rules: NodeRules = RULES):
        return select_by_matching(self.frames, self.names, self.describe, self, rules)

    def kept(self, **changes) -> str:
        return "".join("x" if v.kept else "." for v in self.select(replace(RULES, **changes)))


def test_nodes_with_too_few_views_are_rejected_with_all_their_frames():
    assert Scripted("aaabbccccd").kept() == "xxx..xxxx."
    assert Scripted("aaabbccccd").kept(min_views=2) == "xxxxxxxxx."
    assert Scripted("aaabbccccd").kept(min_views=4) == ".....xxxx."


def test_alike_frames_are_skipped_and_stay_with_their_node_but_the_next_after_the_most_in_a_row_is_matched():
    alike = Scripted("AAAAAAA")
    verdicts = alike.select()
    assert [v.view for v in verdicts] == [True, False, False, True, False, False, True]
    assert alike.matched == [(0, 3), (3, 6)] and all(v.kept for v in verdicts)
    assert Scripted("AAA").kept() == "..."  # one view, whatever is alike to it


def test_views_keep_their_distance_in_frames():
    assert [v.view for v in Scripted("aaaaaaaaa").select(replace(RULES, min_frames=4))] == [
        i % 4 == 0 for i in range(9)
    ]
    assert Scripted("aaaaaaaa").kept(min_frames=4) == "........" and Scripted("aaaaaaaaa").kept(min_frames=4) == "x" * 9


def test_a_node_is_closed_at_more_than_its_most_views():
    assert [v.node for v in Scripted("aaaaaaaa").select(replace(RULES, max_views=3))] == [0, 0, 0, 0, 1, 1, 1, 1]


def test_frames_are_matched_with_the_last_or_the_middle_view():
    last, middle = Scripted("aaaaa"), Scripted("aaaaa")
    last.select()
    middle.select(replace(RULES, reference="middle"))
    assert last.matched[-1] == (3, 4) and middle.matched[-1] == (2, 4)


def test_matches_that_lie_in_one_corner_do_not_make_frames_covisible():
    assert Scripted("aaaa").kept(min_spread=0.4) == "xxxx" and Scripted("aaaa").kept(min_spread=0.6) == "...."
    assert Scripted("aaaa").kept(min_matches=100) == "...."  # more than, as published


def test_rejected_frames_have_their_reason():
    script = Scripted("aaabccd", [100, 100, 100, 100, 100, 100, 20])
    assert [v.reason for v in script.select()] == ["", "", "", NO_MATCHES, FEW_VIEWS, FEW_VIEWS, BLUR]


def test_frames_with_little_detail_are_blur_even_when_they_match_each_other():
    script = Scripted("aaaaabbb" + "cccccc", [100] * 8 + [30] * 4 + [90, 90])
    assert "".join(".x"[v.kept] for v in script.select()) == "xxxxxxxx......"  # two sharp views make no node
    assert [v.reason for v in script.select()][8:] == [BLUR] * 4 + [FEW_VIEWS] * 2
    assert all(v.kept for v in script.select(replace(RULES, blur=0.0)))


def test_every_frame_is_described_once_and_frames_that_cannot_be_read_are_rejected():
    script, read = Scripted("aaaa"), []

    class Frames(list):
        def __getitem__(self, i):
            read.append(i)
            if i == 1:
                raise InputError("000000.png", "broken", "copy it again")
            return script.frames[i]

    verdicts = select_by_matching(Frames(), script.names, script.describe, script, RULES)
    assert [v.reason for v in verdicts] == ["", UNREADABLE, "", ""] and read == [0, 1, 2, 3]
    with refused(found="none could be read", cure="000000.png: broken"):
        select_by_matching(_AllBroken(), script.names, script.describe, script, RULES)


class _AllBroken(list):
    def __getitem__(self, i):
        raise InputError("000000.png", "broken", "copy it again")


def test_rules_that_cannot_hold_are_refused():
    with refused(where="NodeRules.min_views"):
        replace(RULES, min_views=0)
    with refused(found="no node could have"):
        replace(RULES, min_views=9, max_views=5)


def test_loftr_has_colonmapper_s_published_values():
    assert (LOFTR_NODES.min_matches, LoftrSettings().confidence, LOFTR_NODES.min_views) == (100, 0.4, 3)
    assert (LOFTR_NODES.max_skipped, LOFTR_NODES.min_frames, LOFTR_NODES.max_views) == (7, 4, 9)
    assert LOFTR_NODES.similarity == 0.92


@pytest.mark.parametrize("name", LENSES)
def test_matches_of_one_motion_are_told_from_others_on_every_lens(name):
    rng = np.random.default_rng(3)
    camera = LENSES[name]
    points = rng.uniform((-9, -7, 4), (9, 7, 30), (200, 3))
    turn = cv2.Rodrigues(np.array([0.05, -0.1, 0.08]))[0]
    moved = points @ turn.T + (0.5, -0.3, -1.5)
    seen = camera.project(points)[1] & camera.project(moved)[1]
    rays = [
        camera.unproject(camera.project(p[seen])[0] + rng.normal(0, 0.3, (seen.sum(), 2)))[0] for p in (points, moved)
    ]
    wrong = rng.random(seen.sum()) < 0.3
    rays[1][wrong] = rng.permutation(rays[1][wrong])
    inlier = epipolar_inliers(*rays, 0.5)
    assert inlier[~wrong].mean() > 0.95 and inlier[wrong].mean() < 0.25
    assert not epipolar_inliers(rays[0][:7], rays[1][:7], 0.5).any()


@pytest.fixture(scope="module")
def stretches() -> Stretches:
    """Good stretches with motion blur, stool and wall between them; the seed calibrated nothing."""
    kinds = [""] * 7
    for bad in ("motion blur", "stool", "wall"):
        kinds += [bad] * 4 + [""] * 6
    config = TubeConfig(ShapeConfig(length=100.0, step=1.4), TextureConfig(resolution=0.3))
    return bad_stretches(300, lens("c3vd", 240, 192), len(kinds), 1.2, config, kinds)


def test_blurred_covered_and_wall_close_stretches_are_rejected_and_the_rest_kept(stretches):
    names = [f.name for f in stretches.frames]
    verdicts = select_by_matching(stretches.frames, names, OrientationDescriptor(), SiftMatcher(), SIFT_NODES)
    kept, good = np.array([v.kept for v in verdicts]), stretches.good
    assert good.mean() < 0.75  # what keeping all would give
    assert (kept & good).sum() >= 0.9 * kept.sum() and (kept & good).sum() >= 0.9 * good.sum()
    assert any(v.reason == BLUR for v in verdicts)


def test_blur_is_not_taken_for_its_sharp_neighbour(stretches):
    sharp = stretches.frames[3]
    blurred = replace(sharp, image=cv2.GaussianBlur(sharp.image, (0, 0), 4))
    describe = OrientationDescriptor()
    assert describe(sharp) @ describe(blurred) < SIFT_NODES.similarity < describe(sharp) @ describe(sharp)


def test_neither_highlights_nor_the_mask_s_border_hold_features(stretches):
    frame = stretches.frames[0]
    spotted = frame.image.copy()
    for x in range(60, 180, 20):
        cv2.circle(spotted, (x, 90), 3, (1.0, 1.0, 1.0), -1)
    matcher = SiftMatcher()
    pixels = frame.camera.project(matcher.keep(replace(frame, image=spotted)).rays)[0]
    near = np.abs(pixels[:, None] - [(x + 0.5, 90.5) for x in range(60, 180, 20)]).max(-1).min(-1)
    assert len(pixels) > 100 and near.min() > 4
    outside = cv2.distanceTransform(frame.valid.astype(np.uint8), cv2.DIST_L2, 5)
    assert outside[tuple(pixels.astype(int).T[::-1])].min() > 2


def test_loftr_counts_sure_matches_inside_the_mask():
    frame = colon().frames[0]
    mask = np.ones(frame.image.shape[:2], bool)
    mask[:, :48] = False

    def network(pair):
        assert pair["image0"].shape == (1, 1, 80, 96) and float(pair["image0"][..., :40].max()) == 0
        places = torch.tensor([[60.0, 40], [70, 50], [80, 60], [10, 40]])
        return {"confidence": torch.tensor([0.9, 0.5, 0.3, 0.9]), "keypoints0": places, "keypoints1": places}

    matcher = LoftrMatcher(network=network)
    kept = matcher.keep(replace(frame, mask=mask))
    assert matcher.agree(kept, kept) == (2, 2 / 32) and matcher.count(kept) is None


def test_loftr_s_weights_are_a_file_and_never_fetched(tmp_path):
    with refused(where="--loftr.weights", found="no weights given"):
        LoftrMatcher()
    with refused(found="no such file"):
        LoftrMatcher(LoftrSettings(tmp_path / "missing.ckpt"))
    (tmp_path / "bad.ckpt").write_bytes(b"bad")
    with refused(found="damaged"):
        LoftrMatcher(LoftrSettings(tmp_path / "bad.ckpt"))


@pytest.mark.slow
def test_kornia_s_loftr_runs_with_the_weights_of_a_file(tmp_path):
    from kornia.feature import LoFTR

    torch.manual_seed(0)
    torch.save({"state_dict": LoFTR(pretrained=None).state_dict()}, tmp_path / "loftr.ckpt")
    matcher = LoftrMatcher(LoftrSettings(tmp_path / "loftr.ckpt", confidence=0.0))
    one, other = (matcher.keep(f) for f in colon().frames[:2])
    assert matcher.agree(one, other).matches >= 0


def vouched(**changes):
    frames = colon().frames
    submap = slam(frames[::2]).map.submaps[0]  # keyframes 0, 2, 4, 6, 8 of ten frames
    names = [f.name for f in frames]
    return (
        submap,
        names,
        lambda given=None, m=submap: select_by_map(
            names, SparseMap((m,), "test"), replace(MapRules(points=1, keyframes=1), **changes), given
        ),
    )


def test_a_map_vouches_for_its_covisible_keyframes_and_what_lies_between_them():
    _, _, chosen = vouched()
    assert [v.kept for v in chosen()] == [True] * 9 + [False] and chosen()[9].reason == NOT_IN_MAP
    _, _, keyframes_only = vouched(between=1)
    assert [v.kept for v in keyframes_only()] == [i % 2 == 0 for i in range(10)]
    _, _, strict = vouched(points=10**6)
    assert [v.reason for v in strict()] == [NOT_IN_MAP if i % 2 else FEW_KEYFRAMES for i in range(10)]


def test_published_pairs_take_the_place_of_counted_points_unless_told_otherwise(tmp_path):
    submap, _, chosen = vouched(points=10**6)
    (tmp_path / "camerasModel.txt").write_text("000000.png 000000.png 000002.png\n000004.png 000006.png\n")
    pairs = published_pairs(tmp_path, SparseMap((submap,), "test"))
    assert "".join(".x"[v.kept] for v in chosen(pairs)) == "xxx.xxx..."  # 2 and 4 see nothing in common
    _, _, ignoring = vouched(points=10**6, published=False)
    assert not any(v.kept for v in ignoring(pairs))
    (tmp_path / "camerasModel.txt").write_text("one two\n")
    with refused(where="camerasModel.txt", found="one: no number"):
        published_pairs(tmp_path, SparseMap((submap,), "test"))


def test_a_map_of_other_frames_is_refused():
    with refused(found="none of the 1 frames"):
        select_by_map(["000999"], SparseMap((vouched()[0],), "test"), MapRules())


@pytest.fixture(scope="module")
def data(stretches, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("data") / "seq"
    write_folder(stretches.frames[:18], folder)
    return folder


def test_the_verb_writes_list_table_page_and_pictures_and_nothing_over_what_is_there(data, tmp_path, capsys):
    out = tmp_path / "new" / "list.txt"
    select(data, out)
    assert {p.name for p in out.parent.iterdir()} == {"list.txt", "list.csv", "list.html", "list_contact.png"}
    rows = list(csv.DictReader((out.parent / "list.csv").open()))
    names = read_frame_list(out)
    assert [r["name"] for r in rows if r["kept"] == "1"] == names and 0 < len(names) < 18 == len(rows)
    text = out.read_text()
    assert text.startswith("#") and f"{len(names)} of 18 frames kept" in text and "# min_matches: " in text
    assert f"{len(names)} of 18 frames kept" in capsys.readouterr().out
    assert cv2.imread(str(out.parent / "list_contact.png")).shape[1] > 1000
    page = (out.parent / "list.html").read_text()
    assert all(f'<a href="{name}">' in page for name in ("list.txt", "list.csv", "list_contact.png"))
    with refused(cure="--overwrite"):
        select(data, out)
    select(data, out, overwrite=True, no_frames=True, with_folder=True)
    assert not (out.parent / "list_contact.png").exists() and "<img" not in (out.parent / "list.html").read_text()
    assert "list_contact.png" not in (out.parent / "list.html").read_text()
    assert read_frame_list(out) == [f"seq/{name}" for name in names]


def test_nothing_is_written_when_no_frame_is_kept_or_writing_fails(data, tmp_path, monkeypatch):
    with refused(found="none of the 18 frames is kept"):
        select(data, tmp_path / "a" / "list.txt", sift_nodes=replace(SIFT_NODES, min_matches=10**6))
    monkeypatch.setattr(
        "lightdepth.reporting.report.Report.write", lambda *_: (_ for _ in ()).throw(OSError(28, "disk full"))
    )
    with pytest.raises(MachineFailure, match=r"the disk is full .*is kept: --resume goes on"):
        select(data, tmp_path / "b" / "list.txt")
    assert not (tmp_path / "a").exists() and os.listdir(tmp_path / "b") == [".list.txt.unfinished"]
    for wrong in (tmp_path, tmp_path / "list.csv"):
        with refused(cure="name of a list"):
            select(data, wrong)


def test_the_verb_takes_a_map_in_place_of_matching(tmp_path):
    frames = colon().frames
    write_folder(frames, tmp_path / "seq")
    write_text_model(slam(frames[::2]).map.submaps[0], tmp_path / "map")
    select(tmp_path / "seq", tmp_path / "list.txt", map=tmp_path / "map", map_rules=MapRules(points=1, keyframes=1))
    assert read_frame_list(tmp_path / "list.txt") == [f.name for f in frames[:9]]


def names_read(module: FrameDataModule, monkeypatch) -> tuple[set[str], set[str]]:
    """Frames that an epoch of training and one of validation read from disk, as sequence/name."""
    read: set[str] = set()
    import lightdepth.datasets.format as folder

    original = folder.read_image

    def spy(path, white):
        read.add(f"{path.parent.parent.name}/{path.stem}")
        return original(path, white)

    module.setup()
    monkeypatch.setattr(folder, "read_image", spy)
    list(module.train_dataloader())
    trained = set(read)
    read.clear()
    list(module.val_dataloader())
    monkeypatch.undo()
    return trained, set(read)


def test_training_reads_exactly_the_listed_frames_and_validates_on_the_last_of_them(tmp_path, monkeypatch):
    write_folder(colon().frames, tmp_path / "one")
    (tmp_path / "list.txt").write_text("# kept\n" + "".join(f"{i:06d}\n" for i in (0, 2, 3, 7, 8)))
    options = {"frames": str(tmp_path / "list.txt"), "size": (24, 20), "batch_size": 1}
    trained, validated = names_read(FrameDataModule(FrameData([str(tmp_path / "one")], **options)), monkeypatch)
    assert trained == {f"one/{i:06d}" for i in (0, 2, 3, 7)} and validated == {"one/000008"}


def test_frames_of_two_sequences_are_listed_with_their_folder(tmp_path, monkeypatch):
    for name in ("one", "two"):
        write_folder(colon().frames, tmp_path / name)
    sequences = [str(tmp_path / name) for name in ("one", "two")]
    listed = tmp_path / "list.txt"
    options = {"frames": str(listed), "size": (24, 20), "batch_size": 1}
    listed.write_text("one/000001\none/000002.png\ntwo/000005\ntwo/000006\ntwo/000009\n")
    trained, validated = names_read(FrameDataModule(FrameData(sequences, **options)), monkeypatch)
    assert trained == {"one/000001", "two/000005", "two/000006"} and validated == {"one/000002", "two/000009"}
    for text, said in (
        ("000001\n", "write folder/name"),
        ("one/000001\ntwo/000999\n", "two/000999 is not a frame"),
        ("one/000001\none/000002\n", "two … none of its frames is listed"),
    ):
        listed.write_text(text)
        with refused(said):
            FrameDataModule(FrameData(sequences, **options)).setup()
