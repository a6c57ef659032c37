"""Splits: by sequence or patient, found on disk, refused where a sequence is in two parts; and what data/ ships."""

from __future__ import annotations

import re
import warnings
from pathlib import Path

import pytest
from colons import colon
from raising import refused

from lightdepth.datasets import FORMATS, write_c3vd
from lightdepth.datasets.c3vd import C3VD, C3VD_V2
from lightdepth.datasets.catalogue import read_dataset_yaml
from lightdepth.datasets.splits import check_apart, folders, read_split, same_sequence
from lightdepth.tube import lens
from train.datamodule import FrameData, FrameDataModule

DATA = Path(__file__).parents[1] / "data"
DATASETS = sorted(p for p in DATA.iterdir() if p.is_dir())
SPLITS = sorted(DATA.glob("*/splits/*"))
HEADINGS = ("Licence", "How to get it", "Layout", "Units", "What is taken as truth", "Traps", "Splits", "How to cite")
LIGHTDEPTH = DATA / "c3vd" / "splits" / "lightdepth.yaml"
LENS = lens("c3vd", 50, 40)


@pytest.fixture(scope="session")
def one_c3vd(tmp_path_factory) -> Path:
    """A C3VD sequence of four frames, byte for byte as the data set has them."""
    folder = tmp_path_factory.mktemp("c3vd") / "sequence"
    write_c3vd(colon(0, 4, 6.0, LENS).frames, folder)
    return folder


@pytest.fixture
def tree(one_c3vd, tmp_path):
    """Makes a data root with sequences of these names."""

    def make(*names: str) -> Path:
        for name in names:
            folder = tmp_path / "root" / name
            folder.mkdir(parents=True)
            for file in one_c3vd.iterdir():
                (folder / file.name).hardlink_to(file)
        return tmp_path / "root"

    return make


@pytest.fixture
def split(tmp_path):
    """Writes a split file of this text."""

    def write(text: str) -> Path:
        path = tmp_path / "split.yaml"
        path.write_text(text)
        return path

    return write


def parts(**of: str) -> str:
    return "parts:\n" + "".join(f"  {part}: [{names}]\n" for part, names in of.items())


# ---- what data/ ships


@pytest.mark.parametrize("folder", DATASETS, ids=lambda p: p.name)
def test_every_data_set_has_a_card_with_what_a_user_asks_first_and_a_file_for_machines(folder):
    card = (folder / "README.md").read_text()
    assert card.startswith("# ")
    assert re.findall(r"^## (.+)$", card, re.MULTILINE) == list(HEADINGS)
    for heading, text in re.findall(r"^## (.+)\n\n([^#]*)", card, re.MULTILINE):
        assert text.strip(), heading
    for split in (folder / "splits").glob("*"):
        assert f"splits/{split.name}" in card
    info = read_dataset_yaml(folder / "dataset.yaml")
    assert info.format is None or info.format in FORMATS
    assert (folder / "dataset.yaml").read_text().startswith("# ")


@pytest.mark.parametrize("path", SPLITS, ids=lambda p: f"{p.parts[-3]}/{p.name}")
def test_every_shipped_split_is_read_names_sequences_of_its_data_set_and_says_what_it_is(path):
    assert path.read_text().startswith("# ") and path.suffix == ".yaml"
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        split = read_split(path)
    assert split.info is not None and split.info.name
    assert len(warned) == len(split.leaks)
    if split.info.sequences:
        listed = {c.name for chosen in split.parts.values() for c in chosen}
        assert listed <= set(split.info.sequences)


def test_data_holds_no_code_and_no_images():
    assert {p.suffix for p in DATA.rglob("*") if p.is_file()} == {".md", ".yaml"}
    assert not list(DATA.rglob("__init__.py"))


def test_the_cameras_in_dataset_yaml_are_those_of_the_readers():
    for name, camera in (("c3vd", C3VD), ("c3vdv2", C3VD_V2), ("c3vdv3", C3VD_V2)):
        assert read_dataset_yaml(DATA / name / "dataset.yaml").cameras["CF-HQ190L"] == camera


def test_the_light_depth_split_tests_whole_on_the_paper_s_eight_sequences_and_trains_on_none_of_their_frames():
    split = read_split(DATA / "c3vd" / "splits" / "lightdepth.yaml")
    test = [c.name for c in split.parts["test"]]
    frames = [split.frame_count(name) for name in test]
    assert dict(zip(test, frames, strict=True)) == {
        "trans_t2_a": 194, "trans_t3_a": 250, "trans_t4_a": 382, "cecum_t1_a": 276,
        "cecum_t2_a": 370, "cecum_t3_a": 730, "desc_t4_a": 148, "sigmoid_t3_a": 613,
    }  # fmt: skip
    assert all(c.frames is None for part in split.parts.values() for c in part) and not split.leaks
    registered = {n for n in split.info.sequences if not n.startswith("screening")}
    assert {c.name for part in split.parts.values() for c in part} == registered and len(registered) == 22


def test_ppsnet_s_lists_cut_desc_t4_a_in_two_and_say_that_it_leaks():
    with pytest.warns(UserWarning, match="desc_t4_a leaks: its first half is trained on"):
        split = read_split(DATA / "c3vd" / "splits" / "ppsnet.yaml")
    halves = {part: [c.frames for c in chosen if c.name == "desc_t4_a"] for part, chosen in split.parts.items()}
    assert halves == {"train": [(0, 74)], "test": [(74, 148)]}
    assert len(split.parts["train"]) == 15 and len(split.parts["test"]) == 8
    whole = read_split(DATA / "c3vd" / "splits" / "lightdepth.yaml")
    assert {c.name for c in split.parts["test"]} == {c.name for c in whole.parts["test"]}


# ---- what is refused


REFUSED = {
    "the same sequence in two parts": (
        parts(train="a, b", test="c, b"),
        "b of test is in train too",
    ),
    "the same twice in a part": (parts(train="a, b, a"), "train has a twice"),
    "in upper case": (
        parts(train="trans_T1_a", val="Trans_t1_A"),
        r"Trans_t1_A of val, which is trans_T1_a, is in train",
    ),
    "under review": (
        parts(train="x/trans_t1_a", test="x/trans_t1_a_under_review"),
        "which is x/trans_t1_a, is in train",
    ),
    "C3VDv2's name": (
        parts(train="c0_transverse_t2_v3", test="trans_t2_c"),
        "which is c0_transverse_t2_v3, is in train",
    ),
    "C3VDv2's screening": (parts(train="c0_full_t3_v1", test="screening_t3"), "is in train too"),
    "with a dot": (parts(train="a/./b", test="a/b"), "is in train too"),
    "above the root": (parts(train="../other/a"), "train: '../other/a' … leads outside the data's root"),
    "through a folder": (parts(train="a/../../b"), "leads outside the data's root"),
    "absolute": (parts(train="/etc"), "leads outside the data's root"),
    "a name of 300": (parts(train="a" * 300), "no folder has such a name: 300 bytes in one part"),
    "a name of many": (parts(train="a/" * 800), "no folder has such a name: 1600 letters"),
    "a zero": (parts(train='"a\\0b"'), "no folder has such a name: a zero"),
    "another drive": (parts(train='"C:\\\\data"'), "leads outside the data's root"),
    "an empty part": (parts(train="a", val=""), "val is empty"),
    "no part": ("parts: {}\n", "no parts in it"),
    "a part of another name": (
        parts(train="a", validation="b"),
        "parts.validation is not known",
    ),
    "a key of another name": ("sets: {}\n" + parts(train="a"), "sets is not known"),
    "no list": ("parts: {train: a}\n", "parts.train: found 'a' … a valid list"),
    "a key twice": ("parts:\n  train: [a]\n  train: [b]\n", "the key train is there twice"),
    "broken YAML": ("parts: [\n", "not valid YAML"),
    "an object of Python": ("parts: !!python/object/apply:os.system [true]\n", "not valid YAML"),
    "a list": ("- a\n", "no keys in it"),
    "ranges without a reason": (
        parts(train='"a[0:5]"', test='"a[5:9]"'),
        "a[5:9] of test is in train too",
    ),
    "an empty range": (parts(train='"a[5:5]"'), "no frames in [5:5]"),
    "ranges that meet": (
        parts(train='"a[0:5]"', test='"a[4:9]"') + "leaks: {a: why}\n",
        "(a[0:5]), with frames in both",
    ),
    "the whole and a range": (parts(train='"a[0:5]"', test="a") + "leaks: {a: why}\n", "with frames in both"),
    "a leak that is none": (parts(train="a") + "leaks: {a: why}\n", "leaks: a is not in two parts"),
    "an excluded one": (parts(train="dataset_4/keyframe_1") + "excluded: {dataset_4: bad}\n", "but excluded (bad)"),
    "a patient in two parts": (
        "unit: patient\npatients: {p: [a*, c]}\n" + parts(train="a1", test="c"),
        "c of test and a1 of train are of the same patient, p",
    ),
    "nobody's sequence": ("unit: patient\npatients: {p: a*}\n" + parts(train="a1, b"), "b has no patient"),
    "two patients' sequence": (
        "unit: patient\npatients: {p: a*, q: a1}\n" + parts(train="a1"),
        "a1 has patients p and q",
    ),
    "patients for nothing": ("patients: {p: a}\n" + parts(train="a"), "patients, but unit is sequence"),
}


@pytest.mark.parametrize("what", REFUSED)
def test_a_split_that_would_deceive_is_refused_with_file_and_reason(split, what):
    text, message = REFUSED[what]
    path = split(text)
    with refused(message) as raised:
        read_split(path)
    assert str(path) in str(raised.value)


def test_a_sequence_that_the_data_set_does_not_have_is_refused_with_the_one_that_is_meant(tmp_path):
    path = tmp_path / "c3vd" / "splits" / "mine.yaml"
    path.parent.mkdir(parents=True)
    (tmp_path / "c3vd" / "dataset.yaml").write_text((DATA / "c3vd" / "dataset.yaml").read_text())
    path.write_text("dataset: c3vd\n" + parts(train="trans_t1_a, cecum_t5_a"))
    with refused(found="C3VD has no sequence cecum_t5_a", cure="is cecum_t"):
        read_split(path)


def test_names_of_one_sequence_are_known_as_one_and_others_are_not():
    assert same_sequence("c0_descending_t4_v1") == same_sequence("DESC_t4_a_under_review") == "desc_t4_a"
    assert same_sequence("c1_cecum_t1_v1") != same_sequence("cecum_t1_a")
    assert len({same_sequence(n) for n in ("trans_t2_a", "trans_t2_b", "x/trans_t2_a", "screening_t2")}) == 4


# ---- on disk


def test_sequences_are_found_under_their_other_names(split, tree):
    root = tree("trans_t1_a_under_review", "c0_cecum_t1_v2", "desc_t4_a")
    found = folders(read_split(split(parts(train="trans_t1_a, cecum_t1_b", test="desc_t4_a"))), root, ("train", "test"))
    names = {part: [folder.name for folder, _ in of] for part, of in found.items()}
    assert names == {"train": ["trans_t1_a_under_review", "c0_cecum_t1_v2"], "test": ["desc_t4_a"]}
    tree("TRANS_T1_A")
    with refused(found="TRANS_T1_A and trans_t1_a_under_review are both trans_t1_a"):
        folders(read_split(split(parts(train="trans_t1_a"))), root, ("train",))


def test_all_missing_sequences_are_listed_but_only_of_the_parts_that_are_asked_for(split, tree):
    root = tree("a")
    of = read_split(split(parts(train="a, b, c/d", test="e")))
    with refused(found="are not there: b, c/d", cure="download"):
        folders(of, root, ("train",))
    assert [f.name for f, _ in folders(read_split(split(parts(train="a", test="e"))), root, ("train",))["train"]] == [
        "a"
    ]
    with refused(found="no such folder"):
        folders(of, root / "nowhere", ("train",))


def test_one_folder_by_a_link_is_one_sequence(split, tree):
    root = tree("a")
    (root / "b").symlink_to(root / "a", target_is_directory=True)
    with refused(found="b of test is the same folder as a of train"):
        folders(read_split(split(parts(train="a", test="b"))), root, ("train",))


# ---- training


def test_training_takes_train_and_val_of_a_split_and_never_opens_its_test(split, tree):
    root = tree("trans_t1_a", "trans_t1_b", "trans_t2_a")
    for file in (root / "trans_t2_a").iterdir():
        file.unlink()  # opening it would fail
    path = split(parts(train='"trans_t1_a[1:3]"', val="trans_t1_b", test="trans_t2_a"))
    data = FrameDataModule(FrameData(split=str(path), root=str(root), size=(25, 20)))
    data.setup()
    assert data.counts == {"train": 2, "val": 4}
    assert data.sequences == [str(root / "trans_t1_a")] and data.val_sequences == [str(root / "trans_t1_b")]
    chosen = FrameDataModule(FrameData([str(root / "trans_t1_a")], [str(root / "trans_t1_b")], size=(25, 20)))
    chosen.setup()
    assert (data._train[0].image == chosen._train[1].image).all()  # frames 1 and 2 of four


def test_a_split_needs_its_root_a_training_part_and_no_sequences_beside_it(split, tree):
    root, path = str(tree("a")), str(split(parts(test="a")))
    with refused(found="no train in it"):
        FrameDataModule(FrameData(split=path, root=root)).setup()
    with refused(cure="--data.split FILE --data.root DIR"):
        FrameDataModule(FrameData(split=path))
    with refused(cure="not both"):
        FrameDataModule(FrameData([root], split=path, root=root))
    with refused(found="no frame in a[7:9]", cure="its numbers are 0 to 3"):
        FrameDataModule(FrameData(split=str(split(parts(train='"a[7:9]"'))), root=root)).setup()


def test_the_shipped_split_trains_on_a_tree_of_its_sequences_without_a_word(tree):
    named = read_split(LIGHTDEPTH).parts
    root = tree(*(c.name for part in ("train", "val") for c in named[part]))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        data = FrameDataModule(FrameData(split=str(LIGHTDEPTH), root=str(root), size=(25, 20)))
        data.setup()
    assert data.counts == {"train": 4 * 12, "val": 4 * 2}


def test_fewer_frames_than_the_data_set_has_are_said(tree, tmp_path):
    root = tree("desc_t4_a", "trans_t1_a")
    path = tmp_path / "c3vd" / "splits" / "mine.yaml"
    path.parent.mkdir(parents=True)
    (tmp_path / "c3vd" / "dataset.yaml").write_text((DATA / "c3vd" / "dataset.yaml").read_text())
    path.write_text("dataset: c3vd\n" + parts(train="desc_t4_a", val="trans_t1_a"))
    with pytest.warns(UserWarning, match="desc_t4_a: 4 frames; the data set has 148. Is it complete"):
        FrameDataModule(FrameData(split=str(path), root=str(root), size=(25, 20))).setup()


def test_folders_given_by_hand_to_train_and_validate_on_are_kept_apart(tree, tmp_path):
    root = tree("a", "b")
    link = tmp_path / "link"
    link.symlink_to(root / "a", target_is_directory=True)
    for val in (root / "a", root / "b" / ".." / "a", link, root, root / "a" / "frames"):
        with refused(found="validated on, but also trained on"):
            FrameDataModule(FrameData([str(root / "a")], [str(val)]))
    check_apart([root / "a"], [root / "b"])


# ---- dataset.yaml


BROKEN_INFO = {
    "a camera of another model": (
        "cameras: {c: {model: X, width: 1, height: 1, params: []}}",
        "cameras.c … unknown camera model",
    ),
    "a format without a reader": ("format: bag", "format: no reader for 'bag'"),
    "frames below one": ("sequences: {a: 0}", "sequences.a: found 0 … greater than 0"),
    "a sequence outside": ("sequences: {../a: 3}", "leads outside the data's root"),
    "a unit of its own": ("unit: inch", "unit: found 'inch' … 'mm' or 'none'"),
    "no licence": ("licence: ''", "licence: found '' … at least 1 character"),
}


@pytest.mark.parametrize("what", BROKEN_INFO)
def test_a_dataset_yaml_that_says_what_cannot_be_is_refused(tmp_path, what):
    line, message = BROKEN_INFO[what]
    lines = {"name": "n", "licence": "l", "url": "u", "unit": "mm"}
    key, _, value = line.partition(": ")
    text = "".join(f"{k}: {v}\n" for k, v in {**lines, key: value}.items())
    path = tmp_path / "dataset.yaml"
    path.write_text(text)
    with refused(message) as raised:
        read_dataset_yaml(path)
    assert str(path) in str(raised.value)
