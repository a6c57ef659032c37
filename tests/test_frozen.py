"""Data of the modules that calculate cannot be changed, and what cannot be compared does not try."""

from __future__ import annotations

from dataclasses import FrozenInstanceError, is_dataclass
from importlib import import_module

import numpy as np
import pytest

from densify.alignment import Alignment
from densify.evaluation.trajectory import AlignedTrajectory, Trajectory
from densify.fusion.volume import FusionConfig

MODULES = """
    lightdepth.camera.model lightdepth.camera.perspective lightdepth.camera.fisheye lightdepth.camera.foreign
    lightdepth.photometry lightdepth.robust lightdepth.losses.config lightdepth.losses.total
    densify.alignment densify.agreement densify.bending densify.evaluation.trajectory
    densify.fusion.rectify densify.fusion.volume
"""


@pytest.mark.parametrize("name", MODULES.split())
def test_every_dataclass_is_frozen(name):
    own = [v for v in vars(import_module(name)).values() if is_dataclass(v) and v.__module__ == name]
    assert own and [v for v in own if not v.__dataclass_params__.frozen] == []
    with pytest.raises(FrozenInstanceError):
        FusionConfig().voxel = 1.0


def test_trajectories_are_told_apart_by_what_they_are_and_not_by_their_arrays():
    one, other = (Trajectory(0, np.arange(3), np.zeros((3, 3)), np.ones(3, bool), True) for _ in range(2))
    assert one == one and one != other and len({one, other}) == 2
    assert AlignedTrajectory.__eq__ is object.__eq__


def test_an_alignment_of_nothing_is_all_zeros_and_trusted():
    empty = Alignment("1")
    assert (empty.scale, empty.sigma, empty.points, empty.range_90, empty.inlier_share) == (0, 0, 0, 0, 0)
    assert empty.ok and empty.bend is None and len(empty.inlier_ids) == len(empty.outlier_ids) == 0
    assert empty.inlier_ids.dtype.kind == "i" and empty.inlier_ids is not Alignment("2").inlier_ids
