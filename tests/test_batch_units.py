"""Which sequences a batch is of, and how they are shared out: no surface is made here."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from colons import CAMERA, colon
from raising import refused
from sequences import asked_of_all

import densify.batch.units as batch_units
from densify.batch.manifest import Row, read_manifest
from densify.batch.units import Unit, parsed_share, share_of
from densify.inputs import MapSource
from lightdepth.datasets import write_c3vd, write_simcol
from lightdepth.datasets.extent import Extent, digits_of, extent_of
from lightdepth.datasets.reading import image_files
from lightdepth.tube import lens


def pictures(folder: Path, count: int, size: tuple[int, int] = (8, 6), first: int = 9) -> Path:
    folder.mkdir(parents=True)
    for i in range(count):
        cv2.imwrite(str(folder / f"{i:03d}.png"), np.full((size[1], size[0], 3), first + i, np.uint8))
    return folder


def units(*frames: int) -> list[Unit]:
    extents = [Extent(count, 10, 10, "") if count else None for count in frames]
    return [Unit(f"u{i}", Row(i, Path(f"d{i}")), None, extent) for i, extent in enumerate(extents)]  # type: ignore[arg-type]


def test_shares_are_of_about_the_same_cost_and_every_unit_is_in_one():
    rng = np.random.default_rng(0)
    many = units(*rng.integers(1, 1000, 200))
    shares = [share_of(many, (i, 7)) for i in range(1, 8)]
    assert sorted(unit.name for share in shares for unit in share) == sorted(unit.name for unit in many)
    costs = [sum(unit.cost for unit in share) for share in shares]
    assert max(costs) / min(costs) < 1.01
    assert all(a.cost >= b.cost for share in shares for a, b in zip(share, share[1:], strict=False))
    assert [len(share_of(units(5, 0), (i, 3))) for i in (1, 2, 3)] == [1, 1, 0]  # one that cannot be read is a unit too


@pytest.mark.parametrize("wrong", ["", "1", "0/2", "3/2", "1/0", "-1/2", "1/2/3", "a/b", "1 / 2"])
def test_a_share_that_is_none_is_refused(wrong):
    with refused("--shard", cure="I/N"):
        parsed_share(wrong)


def test_sequences_are_found_three_folders_down_and_results_and_what_is_hidden_are_not(tmp_path):
    root = tmp_path / "data"
    for name in ("a", "b/c/frames", "b/d", "e/f/g/h", ".hidden/x", "out"):
        pictures(root / name, 2)
    (root / "empty").mkdir()
    (root / "notes.txt").write_text("no video")
    found = [row.data.relative_to(root).as_posix() for row in read_manifest(root, (root / "out").resolve())]
    assert found == ["a", "b/c", "b/d"]


def test_links_in_a_circle_and_to_a_folder_above_stop_nothing_and_make_no_sequence_twice(tmp_path):
    root = tmp_path / "data"
    pictures(root / "a", 2), pictures(tmp_path / "elsewhere" / "b", 2), (root / "c").mkdir()
    for link, to in {
        "circle.csv": "circle.csv",
        "c/up": "..",
        "here": ".",
        "b": "../elsewhere/b",
        "gone": "no",
    }.items():
        (root / link).symlink_to(to)
    found = [row.data.relative_to(root).as_posix() for row in read_manifest(root, tmp_path / "out")]
    assert found == ["a", "b"]
    matched = read_manifest(Path(f"{root}/*"), tmp_path / "out")
    assert {"a", "b"} <= {row.data.name for row in matched}


def test_the_digits_of_a_sequence_follow_its_frames_and_not_its_place(tmp_path):
    one, same = pictures(tmp_path / "one", 5), pictures(tmp_path / "elsewhere" / "same", 5)
    assert extent_of(one) == extent_of(same) == Extent(5, 8, 6, extent_of(one).digits)
    assert extent_of(one).pixels == 5 * 8 * 6
    for other in (pictures(tmp_path / "longer", 6), pictures(tmp_path / "brighter", 5, first=10)):
        assert extent_of(other).digits != extent_of(one).digits
    (same / "004.png").rename(same / "014.png")
    assert extent_of(same).digits != extent_of(one).digits
    with refused(found="does not exist"):
        extent_of(tmp_path / "nowhere")


def test_the_digits_of_a_file_follow_its_size_its_beginning_and_its_end(tmp_path):
    long = b"a" * (3 << 20)
    for name, content in {"a": long, "b": b"b" + long[1:], "c": long[1:] + b"c", "d": long + b"a", "e": b""}.items():
        (tmp_path / name).write_bytes(content)
    assert len({digits_of(tmp_path / name) for name in "abcde"}) == 5


def rows_of(folder: Path, text: str | bytes) -> list[Row]:
    table = folder / "list.csv"
    table.write_bytes(text if isinstance(text, bytes) else text.encode())
    return read_manifest(table, folder / "out")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('data,name\n"a,b\nc,d\n', "list.csv: line 3 … quotation mark"),
        ('data,name\na,b"c"d\n"e"f,g\n', "list.csv: line 3 … quotation mark"),
        ("data\n" + "a" * 200_000, "list.csv: line 2 … quotation mark"),
        ("data,name\na,b" + "漢" * 40, "list.csv: row 1 … of 121 bytes … up to 100 bytes"),
        ("data\n" + "a" * 256, "list.csv: row 1 … 256 between two slashes"),
        ("data\n" + "a/" * 2049, "list.csv: row 1 … of 4098 bytes"),
        ("data,map\na," + "a" * 256, "list.csv: row 1 … 256 between two slashes"),
        ("data,mm_per_unit\na,nan", "list.csv: row 1 … mm_per_unit 'nan' … above 0"),
        ("data,mm_per_unit\na,-1", "list.csv: row 1 … mm_per_unit '-1' … above 0"),
        ("data,bit_depth\na,99", "list.csv: row 1 … bit_depth '99' … from 8 to 32"),
        ('data,light\na,"gamma=2,mu=banana"', "list.csv: row 1 … banana"),
        ("data,name\na,b,,c", "list.csv: row 1 … 4 cells … expected 2"),
    ],
)
def test_a_table_that_is_wrong_is_refused_by_its_line_or_row(tmp_path, text, said):
    with refused(said):
        rows_of(tmp_path, text)


def test_empty_columns_to_the_right_as_spreadsheets_save_them_are_left_out(tmp_path):
    (row,) = rows_of(tmp_path, "data;name;;\na;b;;\n;;;\n")
    assert (row.data, row.name) == (tmp_path / "a", "b")
    (row,) = rows_of(tmp_path, "data,mm_per_unit,\na,light,\n")
    assert row.given == {"mm_per_unit": "light"}


def test_what_cannot_be_told_apart_is_a_unit_with_its_trouble_and_stops_no_other(tmp_path, monkeypatch):
    pictures(tmp_path / "good", 3), pictures(tmp_path / "bad", 3), pictures(tmp_path / "map", 1)

    def digits(path: Path) -> str:
        if path.name == "map":
            raise PermissionError(13, "Permission denied", str(path))
        return digits_of(path)

    monkeypatch.setattr(batch_units, "digits_of", digits)
    rows = rows_of(tmp_path, "data,map\nbad,map\ngood,\n")
    bad, good = batch_units.units_of(rows, asked_of_all())
    assert (bad.name, bad.extent) == ("row-0001", None) and good.name.startswith("seq-") and not good.trouble
    assert (
        bad.trouble.startswith(f"{tmp_path / 'map'}: cannot be read (Permission denied)") and "Errno" not in bad.trouble
    )


def test_the_same_frames_at_two_places_are_told_and_the_same_place_with_other_options_is_not(tmp_path):
    for name in ("a", "b", "c"):
        pictures(tmp_path / name, 3)
    pictures(tmp_path / "other", 3, first=20), pictures(tmp_path / "longer", 4)

    def said(text: str) -> str:
        return batch_units.said_of_copies(
            batch_units.units_of(rows_of(tmp_path, text), asked_of_all()), lambda unit: unit.row.data.name
        )

    assert said('data,light\na,\na,"gamma=2,mu=1"\nother,\nlonger,\n') == ""
    assert said("data\na\nother\nb\nc\n").startswith("2 sequences have the same frames as another one, ")
    assert said('data,light\na,\nlonger,\nb,"gamma=2,mu=1"\n').endswith(": a and b")


def test_a_file_for_all_sequences_that_cannot_be_read_is_refused_before_any_work(tmp_path):
    pictures(tmp_path / "a", 3)
    (tmp_path / "wrong").write_text("no light, no camera and no picture")
    units = batch_units.units_of([Row(1, tmp_path / "a")], asked_of_all())
    for option in ("light", "camera", "mask"):
        given = asked_of_all(**{option: str(tmp_path / "wrong") if option == "light" else tmp_path / "wrong"}).source
        batch_units.check_files_of_all(given, MapSource())
        with refused(where=str(tmp_path / "wrong")):
            batch_units.check_contents_of_all(given, units)
    with refused("banana"):
        batch_units.check_contents_of_all(asked_of_all(light="gamma=banana").source, units)
    batch_units.check_contents_of_all(asked_of_all(light="gamma=2.2,mu=0", camera=Path("auto")).source, units)


@pytest.mark.parametrize("write", [write_c3vd, write_simcol])
def test_pictures_of_the_truth_among_the_frames_are_no_frames(tmp_path, write):
    write(colon(0, 3, 6.0, lens("c3vd", 50, 40) if write is write_c3vd else CAMERA).frames, tmp_path / "Frames_S1")
    assert extent_of(tmp_path / "Frames_S1").frames == 3
    names = image_files(tmp_path / "Frames_S1").values()
    assert len(names) == 3 and all("color" in name or "FrameBuffer" in name for name in names)
