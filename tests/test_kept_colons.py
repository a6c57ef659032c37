"""Colons that a training rendered are read by the run that goes on with it, to the bit, and go with its end."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from test_resumed_training import Signal, difference, run
from training import TINY_RUN

from lightdepth.errors import Interrupted
from lightdepth.frame import FrameBatch
from train import colons, datamodule, frame_cache, kept_colons
from train.colons import TubeData, tube_scene, val_scene
from train.datamodule import FrameData, FrameDataModule
from train.kept_colons import KeptColons

TUBE = TubeData(scenes=3, val_scenes=1, frames=2, lenses=("pinhole", "fisheye"), family="mixed", val_family="variant")
SIZE = (20, 16)


@pytest.fixture
def rendered(monkeypatch) -> list[int]:
    """The seeds of the colons that this process renders."""
    seeds: list[int] = []

    def noted(real):
        return lambda tube, seed, *rest: seeds.append(seed) or real(tube, seed, *rest)

    monkeypatch.setattr(datamodule, "tube_scene", noted(tube_scene))
    monkeypatch.setattr(datamodule, "val_scene", noted(val_scene))
    return seeds


def module(root: Path | None, tube: TubeData = TUBE, seed: int = 0, size=SIZE) -> tuple[FrameDataModule, str]:
    """Data that is set up, its colons kept below `root`, and what is said of it."""
    data = FrameDataModule(FrameData(tube=tube, size=size, seed=seed))
    if root is not None:
        data.read_colons(root)
    data.setup()
    return data, data.keep_colons()


def tensors(data: FrameDataModule) -> list[torch.Tensor]:
    batches: list[FrameBatch] = [batch for part in (data._train, data._val) for batch in part]
    return [each for batch in batches for each in (*batch[:3], *batch.light, *batch[4:])]


def same(one: FrameDataModule, other: FrameDataModule) -> bool:
    """To the last bit, and laid out alike: some sums depend on that."""
    pairs = zip(tensors(one), tensors(other), strict=True)
    return all(
        a.dtype == b.dtype and a.shape == b.shape and a.is_contiguous() == b.is_contiguous() and torch.equal(a, b)
        for a, b in pairs
    )


def state() -> tuple[object, ...]:
    return torch.get_rng_state().numpy().tobytes(), np.random.get_state()[1].tobytes()  # noqa: NPY002  # that nobody draws from


def test_colons_that_are_kept_are_read_to_the_bit_and_draw_nothing(tmp_path, rendered):
    before = state()
    plain, _ = module(None)
    first, said = module(tmp_path)
    assert len(rendered) == 8 and said == "" and state() == before
    rendered.clear()
    again, said = module(tmp_path)
    assert rendered == [] and said == "" and state() == before
    assert same(first, plain) and same(again, plain) and again.names(0, 0) == plain.names(0, 0)
    shutil.rmtree(tmp_path)
    assert same(again, plain)  # they are in memory, as rendered ones are


def test_more_colons_are_rendered_beside_those_that_are_kept(tmp_path, rendered):
    module(tmp_path)
    rendered.clear()
    more = replace(TUBE, scenes=4)
    data, _ = module(tmp_path, more)
    assert rendered == [3] and same(data, module(None, more)[0])


@pytest.mark.parametrize(
    "other",
    [
        {"tube": replace(TUBE, frames=1)},
        {"tube": replace(TUBE, mu=(0.0, 1.0))},
        {"tube": replace(TUBE, val_family=None)},
        {"seed": 1},
        {"size": (24, 16)},
    ],
    ids=str,
)
def test_colons_of_other_settings_are_rendered_anew_and_the_old_ones_go(tmp_path, rendered, other):
    module(tmp_path)
    rendered.clear()
    data, _ = module(tmp_path, **other)
    assert len(rendered) == 4 and same(data, module(None, **other)[0])
    assert len(list(tmp_path.iterdir())) == 1


def test_colons_of_another_version_are_rendered_anew(tmp_path, rendered, monkeypatch):
    module(tmp_path)
    rendered.clear()
    monkeypatch.setattr(kept_colons, "code_hash", lambda: "another one")
    module(tmp_path)
    assert len(rendered) == 4
    changed = tmp_path.parent / "colons.py"
    changed.write_bytes(Path(colons.__file__).read_bytes() + b"\n")
    monkeypatch.setattr(kept_colons.colons, "__file__", str(changed))
    module(tmp_path)
    assert len(rendered) == 8


@pytest.mark.parametrize("how", ["cut", "a bit", "another colon's", "gone", "rays gone"])
def test_a_colon_that_is_spoilt_is_rendered_anew_and_kept_again(tmp_path, rendered, how, monkeypatch):
    plain, _ = module(tmp_path)
    kept = sorted(file for file in tmp_path.rglob("*.safetensors") if file.stem.isdecimal())
    content = kept[0].read_bytes()
    if how == "rays gone":
        for file in set(tmp_path.rglob("*.safetensors")) - set(kept):
            file.unlink()
        monkeypatch.setattr(frame_cache, "_RAYS", {})
    elif how == "gone":
        kept[0].unlink()
    else:
        spoilt = {"cut": content[:-9], "a bit": content[:-1] + bytes([content[-1] ^ 1]), "": b""}
        kept[0].write_bytes(spoilt.get(how) or kept[1].read_bytes())
    for anew in (1 if how != "rays gone" else 4, 0):
        rendered.clear()
        monkeypatch.setattr(frame_cache, "_RAYS", {})
        assert same(module(tmp_path)[0], plain) and len(rendered) == anew


def test_no_more_is_kept_than_there_is_room_for_and_it_is_said(tmp_path, rendered, monkeypatch):
    plain, _ = module(None)
    for name, value in (("MOST", 30_000), ("ROOM", 1 << 60)):
        with monkeypatch.context() as patch:
            patch.setattr(kept_colons, name, value)
            root = tmp_path / name
            root.mkdir()
            data, said = module(root / "run" / ".state")
            assert "rendered anew by --resume" in said and same(data, plain)
            rendered.clear()
            assert same(module(root / "run" / ".state")[0], plain)
            assert len(rendered) == {"MOST": 2, "ROOM": 4}[name]


def test_a_folder_that_cannot_be_written_stops_nothing(tmp_path, rendered):
    (tmp_path / "file").write_text("in the way", encoding="utf-8")
    with pytest.warns(RuntimeWarning, match="no more rendered colons are kept for --resume"):
        data, _ = module(tmp_path / "file")
    assert same(data, module(None)[0])


def test_a_resumed_training_renders_nothing_equals_the_uninterrupted_one_and_leaves_no_colons(tmp_path, rendered):
    given = [*TINY_RUN, "--trainer.max_steps", "4", "--trainer.logger", "none", "--data.batch-size", "2"]
    whole, halted = tmp_path / "whole", tmp_path / "halted"
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        assert run(whole, given) == 0
        with pytest.raises(Interrupted):
            run(halted, given, [Signal([1])])
        assert len(list((halted / ".state" / "colons").rglob("*.safetensors"))) > 3
        rendered.clear()
        assert run(halted, given, resume=True) == 0
    finally:
        torch.set_num_threads(threads)
    assert rendered == [] and difference(halted, whole) == []
    assert not (halted / ".state").exists() and not (whole / ".state").exists()


def test_a_run_that_was_stopped_is_replaced_with_its_colons(tmp_path):
    given = [*TINY_RUN, "--trainer.max_steps", "3", "--trainer.logger", "none"]
    with pytest.raises(Interrupted):
        run(tmp_path / "run", given, [Signal([1])])
    assert run(tmp_path / "run", [*given, "--overwrite"]) == 0
    assert not (tmp_path / "run" / ".state").exists() and [path.name for path in tmp_path.iterdir()] == ["run"]


def test_whoever_asks_for_a_colon_by_its_seed_gets_all_its_frames_or_none(tmp_path):
    module(tmp_path)
    kept = KeptColons(tmp_path, TUBE, 0, SIZE)
    assert all(len(kept.frames(seed) or []) == 2 for seed in (0, 1, 2, 1_000_000)) and kept.frames(3) is None
