"""Frames at the size that they are trained at, kept on the disk once they are decoded.

ROOT/<of>/<state>/<number>.safetensors, one for each frame, and <hash>.safetensors, the rays that they share. `of` is a
hash of which sequence it is, how it is read, at what size, and by what code; `state` one of its files' names, sizes and
times, and of the camera, light and mask of its first frame. A file is mapped into memory, and believed only where its
sum is right; it appears by a rename, so that several processes and machines can share the folder. Whatever goes wrong,
the frame is decoded.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import time
import warnings
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from functools import cache
from importlib import metadata
from pathlib import Path

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

import lightdepth
from lightdepth.datasets import SequenceSource
from lightdepth.datasets.state import identity_of, state_of
from lightdepth.errors import InputError
from lightdepth.files.writing import is_dead_partial, write_remade
from lightdepth.frame import FrameBatch
from lightdepth.native import user_cache
from lightdepth.photometry import LightTerms

ROOM = 2_000_000_000
"""Bytes of a disk that are left free: checkpoints need some."""
UNUSED_S = 30 * 24 * 3600.0
"""Seconds after which frames go that no training has asked for."""
_USED = "used"
_SUFFIX = ".safetensors"
_DECODERS = ("numpy", "scipy", "opencv-python-headless", "av", "pillow", "torch", "pydicom", "OpenEXR")
_RENDERERS = ("numba", "warp-lang")


def cache_root(asked: bool | str) -> Path | None:
    """The folder that is asked for: False or "off" none, True or "on" the user's own. Raises InputError for a file, and
    where there is no folder of the user's."""
    if asked in (False, "off", ""):
        return None
    if asked not in (True, "on"):
        root = Path(str(asked))
        if root.exists() and not root.is_dir():
            raise InputError(root, "is a file", "expected a folder to keep decoded frames in")
        return root
    own = user_cache()
    if own is None:
        raise InputError("data.cache", "this user has no home to keep frames in", "name a folder: --data.cache FOLDER")
    return own / "frames"


def check_outside(root: Path, sequences: Sequence[str]) -> None:
    """Raises InputError where frames would be kept inside a sequence, which would be another one each time."""
    for path in map(Path, sequences):
        if path.is_dir() and root.resolve().is_relative_to(path.resolve()):
            raise InputError(root, f"lies in {path}, whose frames it is to keep", "choose another --data.cache")


class KeptFrames:
    """Batches of frames in a folder, by number: given back to the bit, or not at all. `said` of what is kept where."""

    def __init__(self, folder: Path, said: str) -> None:
        self.folder, self.said = folder, said
        self._full = False

    def read(self, number: int) -> FrameBatch | None:
        """A frame, or None where it is not there, or not whole."""
        try:
            record = _Record.read(self.folder / f"{number}{_SUFFIX}")
            if record.tensors["number"].item() != number:
                return None
            rays = _shared(self.folder / f"{record.rays}{_SUFFIX}")
        except (OSError, SafetensorError, KeyError, ValueError):
            return None
        return record.batch(rays)

    def keep(self, number: int, batch: FrameBatch) -> None:
        """Keeps a frame, if that is possible; a warning says, once, where it is not."""
        if self._full:
            return
        record = _Record.of(batch, number)
        rays = self.folder / f"{record.rays}{_SUFFIX}"
        try:
            self._make()  # somebody may have cleared it
            if shutil.disk_usage(self.folder).free < ROOM:
                return
            try:
                if not rays.is_file():  # of a folder of this name that was cleared, they may be in memory
                    raise FileNotFoundError(rays)
                _shared(rays)
            except (OSError, SafetensorError, KeyError, ValueError):
                write_remade(rays, _Record({"rays": batch.rays}).bytes())
            write_remade(self.folder / f"{number}{_SUFFIX}", record.bytes())
        except OSError as error:
            self._full = True
            warnings.warn(
                f"no more {self.said} ({error.strerror or error})",
                RuntimeWarning,
                stacklevel=2,
            )

    def _make(self) -> None:
        """Makes the folder; one of its own for all frames is the user's alone."""
        root = self.folder.parent.parent
        if not root.is_dir():
            root.mkdir(0o700, parents=True, exist_ok=True)
        self.folder.mkdir(parents=True, exist_ok=True)


class FrameCache(KeptFrames):
    """The frames of one sequence at one size. `number` is a frame's own."""

    def __init__(self, root: Path, source: SequenceSource, size: tuple[int, int], first: FrameBatch) -> None:
        """`first` is a frame of it: it tells of cameras, lights and masks that lie elsewhere."""
        seen = _Record.of(first)
        common = {name: value for name, value in seen.tensors.items() if name == "mask" or name.startswith("light.")}
        state = _hash(state_of(source), _Record(common, seen.rays).sum)
        folder = root / _hash(identity_of(source), size, code_hash())[:16] / state[:32]
        super().__init__(folder, "decoded frames are kept in --data.cache")
        self.bytes = len(seen.bytes())

    def prepare(self, frames: int) -> str:
        """Makes the folder, clears what no one needs, and returns a sentence on what will not be kept of so many
        frames; empty where all are."""
        try:
            self._make()
            write_remade(self.folder / _USED, b"")
        except OSError as error:
            self._full = True
            return f"decoded frames are not kept in --data.cache, which cannot be written ({error.strerror or error})"
        there, free = 0, 0
        with suppress(OSError):  # another process clears it, because the sequence has changed once more
            _tidy(self.folder)
            there = sum(1 for file in self.folder.iterdir() if file.stem.isdecimal())
            free = max(0, shutil.disk_usage(self.folder).free - ROOM)
        missing = (frames - there) * self.bytes
        if free < missing:
            return (
                f"{missing / 1e9:.3g} GB of decoded frames do not fit into the {free / 1e9:.3g} GB "
                f"that --data.cache may fill ({ROOM / 1e9:.0f} GB stay free): those that do not are decoded each time"
            )
        return ""


class _Record:
    """Tensors by name, and the hash of the rays that belong to them; with a sum over all of it in the file."""

    def __init__(self, tensors: Mapping[str, Tensor], rays: str = "") -> None:
        self.tensors, self.rays = dict(tensors), rays

    @classmethod
    def of(cls, batch: FrameBatch, number: int = -1) -> _Record:
        tensors = {name: value for name, value in batch._asdict().items() if name not in ("light", "rays")}
        tensors |= {f"light.{name}": value for name, value in batch.light._asdict().items()}
        if not batch.true_valid.any() and not batch.true_distance.any():
            del tensors["true_distance"], tensors["true_valid"]
        return cls({**tensors, "number": torch.tensor(number)}, hashlib.sha256(_bytes(batch.rays)).hexdigest()[:32])

    @classmethod
    def read(cls, path: Path) -> _Record:
        """Raises ValueError where it is not what was written."""
        with safe_open(path, "pt") as file:
            told = file.metadata() or {}
            record = cls({name: file.get_tensor(name) for name in file.keys()}, told["rays"])  # noqa: SIM118  # no mapping
        if record.sum != told["sum"]:
            raise ValueError(f"{path}: the sum is wrong")
        return record

    @property
    def sum(self) -> str:
        """What changes with any of it."""
        found = zlib.crc32(self.rays.encode())
        for name, value in sorted(self.tensors.items()):
            found = zlib.crc32(f"{name} {value.dtype} {tuple(value.shape)}".encode(), found)
            found = zlib.crc32(_bytes(value), found)
        return f"{found:08x}"

    def bytes(self) -> bytes:
        content = {name: value.contiguous() for name, value in self.tensors.items()}
        result: bytes = save(content, {"rays": self.rays, "sum": self.sum})
        return result

    def batch(self, rays: Tensor) -> FrameBatch:
        found = self.tensors
        mask = found["mask"]
        return FrameBatch(
            found["image"],
            mask,
            rays,
            LightTerms(*(found[f"light.{name}"] for name in LightTerms._fields)),
            found.get("true_distance", torch.zeros(mask.shape)),
            found.get("true_valid", torch.zeros(mask.shape, dtype=torch.bool)),
        )


_RAYS: dict[Path, Tensor] = {}
"""Rays that frames of this process share: most sequences have one camera."""


def _shared(path: Path) -> Tensor:
    """The rays of a file."""
    if path not in _RAYS:
        rays = _Record.read(path).tensors["rays"].clone()
        if hashlib.sha256(_bytes(rays)).hexdigest()[:32] != path.stem:
            raise ValueError(f"{path}: other rays")
        while len(_RAYS) >= 64:
            del _RAYS[next(iter(_RAYS))]
        _RAYS[path] = rays
    return _RAYS[path]


def _bytes(value: Tensor) -> memoryview:
    return value.contiguous().numpy().reshape(-1).view(np.uint8).data


def _hash(*parts: object) -> str:
    return hashlib.sha256(repr(parts).encode("utf-8", "surrogateescape")).hexdigest()


@cache
def code_hash() -> str:
    """What decodes and renders: this program's own code, and the versions of what it calls."""
    found = hashlib.sha256()
    home = Path(lightdepth.__file__).parent
    for file in sorted(home.rglob("*.py")):
        found.update(file.relative_to(home).as_posix().encode() + b"\0" + file.read_bytes())
    for name in (*_DECODERS, *_RENDERERS):
        with suppress(metadata.PackageNotFoundError):
            found.update(f"{name} {metadata.version(name)}\n".encode())
    return found.hexdigest()


def _tidy(folder: Path) -> None:
    """Clears what killed processes left of a folder's frames, what its sequence was before it changed, and what nothing
    has asked for in a month, of any sequence."""
    for file in list(folder.iterdir()):
        if is_dead_partial(file):
            _remove(file)
    for other in _states(folder.parent.parent):
        if other != folder and (other.parent == folder.parent or _age(other) > UNUSED_S):
            _clear(other)


def _states(root: Path) -> Iterator[Path]:
    """The folders of frames below a root, and nothing else that may be there."""
    for of in list(root.iterdir()):
        if len(of.name) == 16 and _is_hash(of.name) and of.is_dir():
            yield from (state for state in list(of.iterdir()) if len(state.name) == 32 and _is_hash(state.name))


def _is_hash(name: str) -> bool:
    return set(name) <= set("0123456789abcdef")


def _age(state: Path) -> float:
    for file in (state / _USED, state):
        with suppress(OSError):
            return time.time() - file.stat().st_mtime
    return 0.0


def _clear(state: Path) -> None:
    """Removes the files that are ours of a folder, and the folders where nothing is left in them."""
    with suppress(OSError):
        for file in list(state.iterdir()):
            if file.suffix == _SUFFIX or file.name == _USED or is_dead_partial(file):
                _remove(file)
        state.rmdir()
        state.parent.rmdir()


def _remove(file: Path) -> None:
    with suppress(OSError):
        os.unlink(file)
