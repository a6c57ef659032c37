"""A volume on a device holds what the compiled loops hold, bit for bit; here the device is the CPU, by NVIDIA Warp."""

from __future__ import annotations

import sys
import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch
from colons import sequence, truth
from raising import refused
from scenes import cylinder, sphere
from test_live import fed, setting
from test_tiny_fusion import VOXEL, looks, predicted
from volumes import by_warp, needs_warp, sums

import densify.fusion.chosen as chosen
from densify.config import DensifyConfig, LiveConfig
from densify.fusers import FullFuser, device_of
from densify.fusion.chosen import Volume, unlike, volume_on
from densify.fusion.marching_cubes import packed, unpacked
from densify.fusion.on_device.volume import DeviceVolume
from densify.fusion.patches import BlockSurface, joined
from densify.fusion.rectify import RectifyConfig, SurfaceView, surface_view
from densify.fusion.volume import FusionConfig, TsdfVolume
from densify.live.densifier import Densifier
from densify.pipeline import densify_submap
from lightdepth import native
from lightdepth.camera import KannalaBrandt, Pinhole
from lightdepth.models import DeclineModel, NetworkModel
from lightdepth.network import NetworkConfig, build_network
from lightdepth.tube import lens

pytestmark = needs_warp


def same(loops: Volume, device: Volume) -> int:
    """The number of blocks that both hold, and nothing else."""
    assert loops.views == device.views
    np.testing.assert_array_equal(loops.places, device.places)
    for (name, values), others in zip(sums(loops).items(), sums(device).values(), strict=True):
        np.testing.assert_array_equal(values, others, err_msg=name)
    one, other = loops.extract_mesh(), device.extract_mesh()
    for name, values in vars(one).items():
        assert values.dtype == getattr(other, name).dtype, name
        np.testing.assert_array_equal(values, getattr(other, name), err_msg=name)
    return len(loops.places)


def any_pose(rng: np.random.Generator, reach: float) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    pose[:3, 3] = rng.normal(0, reach, 3)
    return pose


def any_view(rng: np.random.Generator) -> SurfaceView:
    """A rough wall with holes, through a lens of any kind, at any size that fusion merges pixels to."""
    width, height = rng.integers(12, 40, 2).tolist()
    focal, center = rng.uniform(0.4, 1.2) * width, (rng.uniform(0.3, 0.7) * width, rng.uniform(0.3, 0.7) * height)
    bends = rng.uniform(-0.02, 0.02, 4).tolist()
    camera = (
        Pinhole(width, height, focal, 1.1 * focal, *center),
        KannalaBrandt(width, height, focal, focal, *center, *bends),
        lens("c3vd", width, height),
    )[rng.integers(3)]
    distance = rng.uniform(0.5, 3) * np.exp(rng.normal(0, 0.03, (height, width)).cumsum(0) / 4)
    sigma = rng.uniform(0, 0.5, distance.shape).astype(np.float32)
    given = predicted(distance, rng.random(distance.shape) < 0.95, camera)
    image = rng.uniform(-0.1, 1.1, (height, width, 3)).astype(np.float32)
    given = replace(given, uncertainty=sigma if rng.random() < 0.5 else None)
    config = RectifyConfig(focal_px=rng.choice([256.0, focal / 1.9]), feather=rng.choice([0.0, 0.15]))
    return surface_view(given, image, config, rng.choice([np.inf, 3.0]))


@pytest.mark.parametrize("seed", range(16))
def test_any_views_add_and_leave_the_same_sums_and_the_same_surface(seed):
    """Lenses, poses, sizes of voxels and settings at random, views put in and taken out in any order."""
    rng = np.random.default_rng(seed)
    voxel = float(np.exp(rng.uniform(-3, -1.5)))
    config = FusionConfig(truncation=rng.uniform(2, 8), front=rng.uniform(), min_views=int(rng.integers(1, 3)))
    loops, device, held, most = TsdfVolume(voxel, config), by_warp(voxel, config), [], 0
    for _ in range(5):
        if held and rng.random() < 0.3:
            look = held.pop(rng.integers(len(held)))
            changed = [volume.remove(*look) for volume in (loops, device)]
        else:
            held.append((any_view(rng), any_pose(rng, 1.0)))
            changed = [volume.integrate(*held[-1]) for volume in (loops, device)]
        np.testing.assert_array_equal(*map(np.sort, changed))
        most = max(most, same(loops, device))
    assert most > 5


def planes_at_random(rng: np.random.Generator, view: SurfaceView) -> SurfaceView:
    """The view with planes, weights and colours that no surface has: every rounding is met."""
    n = len(view.weights)
    planes = rng.normal(size=(n, 4)).astype(np.float32)
    planes[:, :3] /= np.linalg.norm(planes[:, :3], axis=1, keepdims=True)
    weights = rng.choice([0, 1, 2, 127, 128, 254, 255], n).astype(np.uint8)
    colors = rng.integers(0, 256, (n, 4)).astype(np.uint8)
    planes[-1], weights[-1], colors[:, 3] = 0, 0, 1
    return SurfaceView(view.points, planes, weights, colors, view.table)


@pytest.mark.parametrize("seed", range(4))
def test_planes_and_weights_that_no_surface_has_add_the_same_sums_too(seed):
    rng = np.random.default_rng(100 + seed)
    loops, device = TsdfVolume(VOXEL), by_warp(VOXEL)
    for view, _ in looks():
        look = planes_at_random(rng, view), any_pose(rng, 0.5)
        np.testing.assert_array_equal(np.sort(loops.integrate(*look)), device.integrate(*look))
    assert same(loops, device) > 10


@pytest.mark.parametrize("scene", [cylinder, sphere])
def test_a_whole_frame_through_a_wide_lens_gives_the_same_surface(scene):
    made = scene(lens("fisheye", 96, 80))
    view = surface_view(made.prediction(), made.frame().image, RectifyConfig(), 25.0)
    volumes = TsdfVolume(0.4), by_warp(0.4)
    for volume in volumes:
        volume.integrate(view, np.eye(4))
    assert same(*volumes) > 100 and len(volumes[1].extract_mesh().triangles) > 3000


def test_nothing_is_fused_into_one_rounding_on_any_device():
    """A CPU of Warp's need not do it where it may: what tells a GPU's compiler is the option."""
    import warp

    from densify.fusion.on_device.naming import MODULE

    options = warp.get_module_options(MODULE)
    assert options["fuse_fp"] is False and options["fast_math"] is False


def test_blocks_that_hold_nothing_give_their_rows_back_in_the_end():
    """A view that wanders opens new blocks at each place and leaves them again."""
    view, device, loops = looks()[0][0], by_warp(VOXEL), TsdfVolume(VOXEL)
    stays = np.eye(4)
    stays[:3, 3] = -50.0
    for volume in (device, loops):
        volume.integrate(view, stays)
    most = 0
    for step in range(150):
        pose = np.eye(4)
        pose[:3, 3] = 4.0 * step
        device.integrate(view, pose)
        device.remove(view, pose)
        most = max(most, device._rows)
    assert 1024 < most < 1500 and device._rows < most
    assert same(loops, device) > 5


def test_a_volume_that_outgrows_its_memory_keeps_what_it_holds():
    loops, device = TsdfVolume(VOXEL), by_warp(VOXEL)
    for step in range(60):
        pose = np.eye(4)
        pose[:3, 3] = 4.0 * step
        for volume in (loops, device):
            volume.integrate(looks()[0][0], pose)
    assert same(loops, device) > 600 and device._rows > 256


def test_slots_of_blocks_that_are_not_held_are_none():
    device = by_warp(VOXEL)
    assert device.slots(np.zeros(0, np.int64)).shape == (0,)
    device.integrate(*looks()[0])
    beyond = packed(unpacked(device.places) + 1000)
    assert (device.slots(beyond) == -1).all() and (device.slots(device.places) >= 0).all()
    device.remove(*looks()[0])
    assert not len(device.places) and device._rows > 0


def test_patches_of_either_kind_join_to_one_surface():
    made = []
    for volume in (TsdfVolume(VOXEL), by_warp(VOXEL)):
        surface = BlockSurface()
        for look in looks():
            surface.renew(volume, volume.integrate(*look))
        patches = [surface.patches[code] for code in sorted(surface.patches)]
        assert all(len(np.unique(p.edges)) == p.n and p.triangles.max() == p.n - 1 for p in patches)
        made.append(joined(patches))
    assert len(made[0][0]) > 150
    for one, other in zip(*made, strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_cut_of_no_blocks_and_of_blocks_without_surface_is_empty():
    device = by_warp(VOXEL, FusionConfig(min_views=9))
    device.integrate(*looks()[0])
    for slots in (np.zeros(0, int), device.slots(device.places)):
        found = device.cut(slots)
        assert len(found.names) == len(found.triangles) == len(found.rows) == 0
        assert found.first_vertex.tolist() == found.first_triangle.tolist() == [0]
        assert device.colors_at(found).shape == (0, 3) and found.positions.shape == (0, 3)


# Which kind is made


@pytest.fixture
def gpu(monkeypatch):
    """What takes Warp's CPU for a GPU named cuda:7."""

    def on_the_cpu(voxel, config=FusionConfig(), device="cuda"):
        assert device == "cuda:7"
        return DeviceVolume(voxel, config, "cpu")

    monkeypatch.setattr("densify.fusion.on_device.volume.DeviceVolume", on_the_cpu)
    unlike.cache_clear()
    yield "cuda:7"
    unlike.cache_clear()


def test_a_gpu_gets_the_volume_and_nothing_else_does(gpu, monkeypatch):
    with warnings.catch_warnings(action="error"):
        assert isinstance(volume_on(gpu, 1.0, FusionConfig()), DeviceVolume)
        for device in ("cpu", "mps"):
            assert isinstance(volume_on(device, 1.0, FusionConfig()), TsdfVolume)
        monkeypatch.setattr(native, "has_warp", lambda: False)
        assert isinstance(volume_on(gpu, 1.0, FusionConfig()), TsdfVolume)


def test_a_gpu_that_rounds_otherwise_is_not_fused_on_and_the_user_is_told(gpu, monkeypatch):
    look = chosen._look
    monkeypatch.setattr(DeviceVolume, "integrate", lambda self, view, pose: self._add(*look(0.01), 1))
    with pytest.warns(UserWarning, match="makes other .*vertices.* than the processor"):
        assert isinstance(volume_on(gpu, 1.0, FusionConfig()), TsdfVolume)


def test_a_gpu_on_which_warp_fails_is_not_fused_on_and_the_user_is_told(gpu, monkeypatch):
    def fails(*_):
        raise RuntimeError("no such architecture")

    monkeypatch.setattr(DeviceVolume, "integrate", fails)
    with pytest.warns(UserWarning, match="no such architecture"):
        assert isinstance(volume_on(gpu, 1.0, FusionConfig()), TsdfVolume)


def test_surfaces_are_fused_where_the_network_runs(monkeypatch):
    network = NetworkModel(build_network(NetworkConfig(width=4)), 32, "small")
    assert device_of(network) == "cpu" == device_of(DeclineModel()) == device_of(lambda frame: None)
    asked = []
    monkeypatch.setattr("densify.fusers.volume_on", lambda *given: asked.append(given[0]))
    monkeypatch.setattr("densify.live.densifier.volume_on", lambda *given: asked.append(given[0]))
    monkeypatch.setattr(type(network), "device", torch.device("cuda", 1))
    FullFuser(1.0, DensifyConfig(), device_of(network))
    assert asked == ["cuda:1"] and Densifier(network, LiveConfig())._device == "cuda:1"


def test_a_submap_is_made_dense_and_grows_live_alike_wherever_it_is_fused(gpu, monkeypatch):
    frames, found, config = setting(count=3)
    (submap,) = found.map.submaps
    made, kinds = [], []
    for device in ("cpu", gpu):
        for place in ("densify.fusers", "densify.live.densifier"):
            monkeypatch.setattr(f"{place}.device_of", lambda model, device=device: device)
        dense = densify_submap(submap, sequence(frames), truth, config).dense
        live = fed(Densifier(truth, config, submap.id), frames, submap)
        kinds.append(type(live._volume))
        numbers = (dense.vertices, dense.triangles, dense.colors, dense.weights, dense.views, dense.expected_error)
        made.append([*numbers, *live.mesh().joined()])
    assert kinds == [TsdfVolume, DeviceVolume] and len(made[0][0]) > 500 < len(made[0][6])
    for one, other in zip(*made, strict=True):
        np.testing.assert_array_equal(one, other)


def test_without_the_library_the_message_says_what_to_install(monkeypatch):
    native.warp.cache_clear()
    monkeypatch.setitem(sys.modules, "warp", None)
    with refused(cure="lightdepth[gpu]"):
        DeviceVolume(1.0)
    native.warp.cache_clear()
