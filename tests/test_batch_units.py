"""Which sequences a batch is of, and how they are shared out: no surface is made here."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from raising import refused

from densify.batch.manifest import Row, read_manifest
from densify.batch.units import Unit, parsed_share, share_of
from lightdepth.datasets.extent import Extent, digits_of, extent_of


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
