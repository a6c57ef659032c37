"""Decoded frames that are kept: the same to the bit, whatever becomes of the files, the disk and the processes."""

from __future__ import annotations

import errno
import multiprocessing
import os
import shutil
import stat
import time
from pathlib import Path
from types import SimpleNamespace

import cv2
import lightning.pytorch as pl
import numpy as np
import pytest
import torch
from scenes import cylinder
from training import CAMERA, LIGHT

from lightdepth.calibration import write_camera, write_light
from lightdepth.datasets.sequence import FrameSequence
from lightdepth.errors import InputError
from lightdepth.frame import FrameBatch
from lightdepth.module import LightDepth
from lightdepth.network import NetworkConfig
from lightdepth.photometry import PhotometricCalibration
from train import frame_cache
from train.datamodule import FrameData, FrameDataModule
from train.frame_cache import FrameCache, cache_root
from train.running import NO_ROOT

COUNT = 7


@pytest.fixture
def sequence(tmp_path) -> Path:
    """Seven frames of a cylinder, each darker than the one before, as a folder of images."""
    folder = tmp_path / "seq"
    (folder / "frames").mkdir(parents=True)
    image = cylinder(CAMERA).frame(light=LIGHT).image[..., ::-1] * 255
    for i in range(COUNT):
        cv2.imwrite(str(folder / "frames" / f"{i:04d}.png"), np.round(image * (1 - 0.1 * i)).astype(np.uint8))
    write_camera(CAMERA, folder / "camera.json")
    write_light(LIGHT, folder / "light.json")
    return folder


@pytest.fixture
def decoded(monkeypatch) -> list[str]:
    """The names of the frames that this process decodes."""
    names: list[str] = []
    load = FrameSequence.__getitem__

    def loading(self, index):
        names.extend([] if isinstance(index, slice) else [self.names[index]])
        return load(self, index)

    monkeypatch.setattr(FrameSequence, "__getitem__", loading)
    return names


def module(sequence: Path, cache: bool | str | Path = False, **options) -> FrameDataModule:
    cache = str(cache) if isinstance(cache, Path) else cache
    data = FrameDataModule(FrameData([str(sequence)], cache=cache, **{"size": (20, 16), "batch_size": 2, **options}))
    data.setup()
    return data


def batches(data: FrameDataModule) -> list[FrameBatch]:
    return [*data.train_dataloader(), *data.val_dataloader()]


def flat(batch: FrameBatch) -> list[torch.Tensor]:
    return [*batch[:3], *batch.light, *batch[4:]]


def same(one: list[FrameBatch], other: list[FrameBatch]) -> bool:
    """To the last bit, whatever the numbers are."""
    pairs = [pair for a, b in zip(one, other, strict=True) for pair in zip(flat(a), flat(b), strict=True)]
    return all(a.dtype == b.dtype and a.numpy().tobytes() == b.numpy().tobytes() for a, b in pairs)


def kept(root: Path) -> list[Path]:
    """The files of the frames that are kept."""
    return sorted(file for file in root.rglob("*.safetensors") if file.stem.isdecimal())


def trained(sequence: Path, cache: bool | Path, workers: int) -> dict[str, torch.Tensor]:
    torch.manual_seed(0)
    model = LightDepth(NetworkConfig(width=4))
    cache = str(cache) if isinstance(cache, Path) else cache
    data = FrameDataModule(FrameData([str(sequence)], size=(20, 16), batch_size=2, num_workers=workers, cache=cache))
    off = {"logger": False, "enable_checkpointing": False, "enable_progress_bar": False, "enable_model_summary": False}
    pl.Trainer(accelerator="cpu", devices=1, max_steps=5, limit_val_batches=0, default_root_dir=NO_ROOT, **off).fit(
        model, datamodule=data
    )
    return model.state_dict()


def test_a_training_is_the_same_to_the_bit_with_no_cache_a_cold_one_and_a_warm_one(sequence, tmp_path):
    plain = trained(sequence, False, 0)
    cold, warm = trained(sequence, tmp_path / "kept", 0), trained(sequence, tmp_path / "kept", 0)
    shared = trained(sequence, tmp_path / "kept", 2)
    assert len(kept(tmp_path / "kept")) == COUNT - 1  # one validates, and was not looked at
    for name, value in plain.items():
        assert torch.equal(value, cold[name]) and torch.equal(value, warm[name]) and torch.equal(value, shared[name])


def test_frames_that_are_kept_are_not_decoded_again_whatever_list_and_batch_asks_for_them(sequence, tmp_path, decoded):
    plain = batches(module(sequence))
    assert same(batches(module(sequence, tmp_path / "kept")), plain)
    again = module(sequence, tmp_path / "kept")
    decoded.clear()
    assert same(batches(again), plain) and not decoded
    (tmp_path / "list.txt").write_text("0002\n0004\n0005\n", encoding="utf-8")
    listed = module(sequence, tmp_path / "kept", frames=str(tmp_path / "list.txt"), batch_size=1)
    decoded.clear()
    assert len(batches(listed)) == 3 and not decoded


def test_frames_with_truth_keep_it(tmp_path):
    from lightdepth.datasets import write_folder

    frames = [cylinder(CAMERA).frame(light=LIGHT, name=f"{i:04d}") for i in range(3)]
    write_folder(frames, tmp_path / "seq")
    plain = batches(module(tmp_path / "seq"))
    assert all(bool(batch.true_valid.any()) for batch in plain)
    for _ in range(2):
        assert same(batches(module(tmp_path / "seq", tmp_path / "kept")), plain)


@pytest.mark.parametrize("how", ["other size", "other time", "time set back", "one more", "one less"])
def test_a_sequence_that_has_changed_is_decoded_anew_and_what_it_was_goes(sequence, tmp_path, how):
    batches(module(sequence, tmp_path / "kept"))
    before, frame = kept(tmp_path / "kept"), sequence / "frames" / "0003.png"
    was = frame.stat()
    if how == "one more":
        shutil.copy(frame, frame.with_name("0009.png"))
    elif how == "one less":
        frame.unlink()
    elif how == "other size":
        cv2.imwrite(str(frame), np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8))
    else:  # as many bytes of another picture: PNG without compression
        for value in (100, 101):
            picture = np.full((CAMERA.height, CAMERA.width, 3), value, np.uint8)
            cv2.imwrite(str(frame), picture, [cv2.IMWRITE_PNG_COMPRESSION, 0])
            if value == 100:
                batches(module(sequence, tmp_path / "kept"))
                before, was = kept(tmp_path / "kept"), frame.stat()
        assert frame.stat().st_size == was.st_size
        if how == "time set back":
            os.utime(frame, ns=(was.st_atime_ns, was.st_mtime_ns))
    assert same(batches(module(sequence, tmp_path / "kept")), batches(module(sequence)))
    assert before and not any(file.exists() for file in before)


def test_camera_light_and_mask_that_are_given_size_and_code_keep_frames_of_their_own(sequence, tmp_path, monkeypatch):
    mask = np.zeros((CAMERA.height, CAMERA.width), np.uint8)
    mask[4:-4, 4:-4] = 255
    cv2.imwrite(str(tmp_path / "mask.png"), mask)
    write_light(PhotometricCalibration(gain=3.0), tmp_path / "light.json")
    batches(module(sequence, tmp_path / "kept"))
    for given in ({"mask": str(tmp_path / "mask.png")}, {"light": str(tmp_path / "light.json")}, {"size": (25, 20)}):
        assert same(batches(module(sequence, tmp_path / "kept", **given)), batches(module(sequence, **given)))
    write_light(PhotometricCalibration(gain=5.0), tmp_path / "light.json")
    given = {"light": str(tmp_path / "light.json")}
    assert same(batches(module(sequence, tmp_path / "kept", **given)), batches(module(sequence, **given)))
    there = len(kept(tmp_path / "kept"))
    monkeypatch.setattr(frame_cache, "code_hash", lambda: "another version")
    batches(module(sequence, tmp_path / "kept"))
    assert len(kept(tmp_path / "kept")) == there + COUNT


def test_a_camera_light_or_mask_that_lies_elsewhere_is_seen_by_a_frame(sequence, tmp_path):
    data = module(sequence)
    source, first, other = data._sources[str(sequence)], data._train.datasets[0][0], data._train.datasets[0][1]

    def folder(batch: FrameBatch) -> Path:
        return FrameCache(tmp_path, source, (20, 16), batch).folder

    assert not torch.equal(first.image, other.image) and folder(first) == folder(other)
    changed = [
        first._replace(rays=-first.rays),
        first._replace(mask=~first.mask),
        first._replace(light=first.light._replace(gain=first.light.gain + 1)),
    ]
    assert len({folder(first), *map(folder, changed)}) == 4
    assert {each.parent for each in map(folder, changed)} == {folder(first).parent}  # the last takes the others' place


@pytest.mark.parametrize("how", ["empty", "cut off", "a bit", "another frame's", "no such format", "rays", "folder"])
def test_what_is_spoilt_is_not_believed_and_made_anew(sequence, tmp_path, decoded, how):
    plain = batches(module(sequence))
    batches(module(sequence, tmp_path / "kept"))
    files = kept(tmp_path / "kept")
    file = files[1]
    content, whole = file.read_bytes(), files[0].parent
    if how == "rays":
        file = next(each for each in whole.glob("*.safetensors") if not each.stem.isdecimal())
        content = file.read_bytes()
    frame_cache._RAYS.clear()
    spoilt = {
        "empty": b"",
        "cut off": content[:-7],
        "a bit": content[:-9] + bytes([content[-9] ^ 4]) + content[-8:],
        "another frame's": files[0].read_bytes(),
        "no such format": b"\x80\x04cos\nsystem\n(S'exit 1'\ntR.",
        "rays": content[:-1] + bytes([content[-1] ^ 64]),
    }
    if how == "folder":
        shutil.rmtree(tmp_path / "kept")
    else:
        file.write_bytes(spoilt[how])
    again = module(sequence, tmp_path / "kept")
    if how == "folder":
        shutil.rmtree(tmp_path / "kept")  # also under a training that has begun
    decoded.clear()
    assert same(batches(again), plain) and decoded
    decoded.clear()
    frame_cache._RAYS.clear()
    assert same(batches(again), plain) and not decoded


def killed_while_it_writes(sequence: Path, root: Path) -> None:
    os.replace = lambda *names: os._exit(9)
    cache = module(sequence, False)
    part = cache._train.datasets[0]
    part.cache = FrameCache(root, cache._sources[str(sequence)], (20, 16), part[0])
    part.cache.folder.mkdir(parents=True)
    part[1]


def test_of_a_killed_process_no_frame_is_left_and_its_remains_go(sequence, tmp_path):
    process = multiprocessing.get_context("fork").Process(
        target=killed_while_it_writes, args=(sequence, tmp_path / "kept")
    )
    process.start()
    process.join(120)
    assert process.exitcode == 9
    assert list((tmp_path / "kept").rglob(".partial-*")) and not kept(tmp_path / "kept")
    assert same(batches(module(sequence, tmp_path / "kept")), batches(module(sequence)))
    assert not list((tmp_path / "kept").rglob(".partial-*")) and len(kept(tmp_path / "kept")) == COUNT


def read_with_others(sequence: Path, root: Path, barrier, results) -> None:
    barrier.wait(120)
    found = batches(module(sequence, root))
    results.put([value.numpy().tobytes() for batch in found for value in flat(batch)])


def test_several_trainings_at_once_share_what_they_keep(sequence, tmp_path):
    context = multiprocessing.get_context("fork")
    barrier, results = context.Barrier(3), context.Queue()
    processes = [
        context.Process(target=read_with_others, args=(sequence, tmp_path / "kept", barrier, results)) for _ in range(3)
    ]
    for process in processes:
        process.start()
    found = [results.get(timeout=120) for _ in processes]
    for process in processes:
        process.join(120)
    plain = [value.numpy().tobytes() for batch in batches(module(sequence)) for value in flat(batch)]
    assert found == [plain] * 3
    assert len(kept(tmp_path / "kept")) == COUNT and not list((tmp_path / "kept").rglob(".partial-*"))


def test_a_disk_that_is_full_is_told_once_and_stops_nothing(sequence, tmp_path, monkeypatch):
    data = module(sequence, tmp_path / "kept")
    calls = []

    def full(path, content):
        calls.append(path)
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(frame_cache, "write_remade", full)
    with pytest.warns(RuntimeWarning, match="no more decoded frames are kept in --data.cache .No space left") as told:
        found = batches(data)
    assert same(found, batches(module(sequence))) and len(told) == len(calls) == 1


def test_some_room_is_left_on_the_disk_and_what_does_not_fit_is_said(sequence, tmp_path, monkeypatch):
    monkeypatch.setattr(shutil, "disk_usage", lambda path: SimpleNamespace(free=frame_cache.ROOM + 5000))
    data = module(sequence, tmp_path / "kept")
    assert any("GB of decoded frames do not fit into the 5e-06 GB that --data.cache may fill" in d for d in data.doubts)
    batches(data)
    assert len(kept(tmp_path / "kept")) == COUNT
    monkeypatch.setattr(shutil, "disk_usage", lambda path: SimpleNamespace(free=frame_cache.ROOM - 1))
    assert same(batches(module(sequence, tmp_path / "more")), batches(module(sequence)))
    assert not kept(tmp_path / "more")


def test_a_folder_that_cannot_be_written_is_told_and_what_is_in_it_serves(sequence, tmp_path, monkeypatch, decoded):
    plain = batches(module(sequence, tmp_path / "kept"))

    def refused(path, content):
        raise OSError(errno.EROFS, "Read-only file system")

    monkeypatch.setattr(frame_cache, "write_remade", refused)
    data = module(sequence, tmp_path / "kept")
    assert data.doubts == [
        "decoded frames are not kept in --data.cache, which cannot be written (Read-only file system)"
    ]
    decoded.clear()
    assert same(batches(data), plain) and not decoded


def test_a_frame_that_cannot_be_read_is_left_out_as_it_is_without_a_cache(sequence, tmp_path):
    (sequence / "frames" / "0002.png").write_bytes(b"no picture")
    told: list[list[str]] = []
    for cache in (False, tmp_path / "kept", tmp_path / "kept"):
        data, said = module(sequence, cache), list[str]()
        data.tell = said.append
        told.append([str(same(batches(data), batches(module(sequence)))), *said])
    assert told[0] == told[1] == told[2] and len(told[0]) == 2 and told[0][0] == "True"


def test_what_no_training_has_asked_for_in_a_month_goes_and_nothing_of_others(sequence, tmp_path):
    root = tmp_path / "kept"
    batches(module(sequence, root))
    other = Path(shutil.copytree(sequence, tmp_path / "other"))
    batches(module(other, root))
    stamps = sorted(root.rglob("used"), key=lambda file: file.stat().st_mtime_ns)
    (root / "mine.txt").write_text("mine", encoding="utf-8")
    (stamps[0].parent / "mine.txt").write_text("mine", encoding="utf-8")
    batches(module(other, root))
    assert len(kept(root)) == 2 * COUNT
    old = time.time() - frame_cache.UNUSED_S - 60
    os.utime(stamps[0], (old, old))
    batches(module(other, root))
    assert len(kept(root)) == COUNT and stamps[1].exists() and not stamps[0].exists()
    assert (root / "mine.txt").exists() and (stamps[0].parent / "mine.txt").exists()


def test_the_folder_is_chosen_by_a_word_or_a_name(sequence, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "home"))
    own = tmp_path / "home" / "lightdepth" / "frames"
    assert [cache_root(word) for word in (False, "off", True, "on")] == [None, None, own, own]
    batches(module(sequence, True))
    assert len(kept(own)) == COUNT and stat.S_IMODE(own.stat().st_mode) == 0o700
    (tmp_path / "file").write_text("", encoding="utf-8")
    with pytest.raises(InputError, match="is a file"):
        cache_root(str(tmp_path / "file"))
    with pytest.raises(InputError, match="choose another"):
        module(sequence, sequence / "kept")
    assert not (sequence / "kept").exists()


def test_a_user_without_a_home_is_asked_for_a_folder(monkeypatch):
    monkeypatch.setattr(frame_cache, "user_cache", lambda: None)
    with pytest.raises(InputError, match="name a folder"):
        cache_root("on")
