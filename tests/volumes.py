"""Volumes of both kinds, the compiled loops' and NVIDIA Warp's on the CPU, for tests that are to pass on either."""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import partial

import numpy as np
import pytest

from densify.fusion.chosen import Volume
from densify.fusion.on_device.volume import DeviceVolume
from densify.fusion.volume import TsdfVolume
from lightdepth import native

needs_warp = pytest.mark.skipif(not native.has_warp(), reason="NVIDIA Warp is not installed (extra [gpu])")
by_warp = partial(DeviceVolume, device="cpu")


def on_both(*modules: str) -> Callable:
    """A fixture by which every test of a module has volumes of either kind where it, or one of the modules that it
    takes helpers from, says TsdfVolume."""

    @pytest.fixture(
        scope="module",
        autouse=True,
        params=[TsdfVolume, pytest.param(by_warp, marks=needs_warp)],
        ids=["loops", "warp"],
    )
    def kind(request):
        with pytest.MonkeyPatch.context() as patch:
            for module in modules:
                patch.setattr(sys.modules[module], "TsdfVolume", request.param)
            yield request.param

    return kind


def sums(volume: Volume) -> dict[str, np.ndarray]:
    """All that a volume holds, block by block in the order of their places."""
    slots = volume.slots(volume.places)
    if isinstance(volume, DeviceVolume):
        held, columns = volume._sums.numpy()[slots], volume._columns.numpy()[slots]
        parts = held[:, 0], held[:, 1], held[:, 2], np.moveaxis(held[:, 3:], 1, 2), columns[..., 0], columns[..., 1]
    else:
        names = ("_weight", "_distance", "_seen", "_color", "_behind", "_known")
        parts = tuple(getattr(volume, name)[slots] for name in names)
    return dict(zip(("weight", "distance", "seen", "color", "behind", "known"), parts, strict=True))


def sums_at(volume: Volume, name: str, voxels: np.ndarray) -> np.ndarray:
    """One kind of sum at voxels (n,) as a cut has them, 512 times the slot and the place there."""
    slots = volume.slots(volume.places)
    order = np.argsort(slots)
    row = order[np.searchsorted(slots, voxels // 512, sorter=order)]
    return sums(volume)[name][row, voxels % 512]
