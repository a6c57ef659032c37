"""Views in, one surface out: exact depth gives an exact surface, and what was put in can be taken out."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
import pytest
from raising import refused
from scenes import Scene, cylinder, slanted_plane, sphere
from volumes import on_both, sums

from densify.fusion.marching_cubes import CORNERS, packed, unpacked
from densify.fusion.rectify import FULL, RectifyConfig, SurfaceView, surface_view
from densify.fusion.volume import STEPS, FusionConfig, Mesh, TsdfVolume
from lightdepth.camera import Pinhole
from lightdepth.prediction import DepthPrediction
from lightdepth.tube import lens

CAMERA = Pinhole(120, 90, 100.0, 100.0, 60.0, 45.0)
kind = on_both(__name__)


def plane(z: float | np.ndarray = 20.0, color: float = 0.5, valid: np.ndarray | None = None) -> SurfaceView:
    """What a camera sees of a plane that faces it at depth z."""
    rays, everywhere = CAMERA.rays()
    distance = (z / rays[..., 2]).astype(np.float32)
    prediction = DepthPrediction("1", distance, everywhere if valid is None else valid, CAMERA, "plane")
    return surface_view(prediction, np.full((90, 120, 3), color, np.float32), RectifyConfig(feather=0.0))


def fused(views, poses=None, voxel: float = 0.4, **config) -> Mesh:
    volume = TsdfVolume(voxel, FusionConfig(**config))
    for view, pose in zip(views, poses or [np.eye(4)] * len(views), strict=True):
        volume.integrate(view, pose)
    return volume.extract_mesh()


def shifted(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, 3] = x, y, z
    return pose


def test_a_plane_is_where_it_was_seen_in_its_colour():
    mesh = fused([plane(color=0.25)], voxel=0.37)
    assert len(mesh.vertices) > 1000 and len(mesh.triangles) > 1000
    assert np.abs(mesh.vertices[:, 2] - 20).max() < 0.01 * 0.37
    np.testing.assert_allclose(mesh.colors, 0.25, atol=0.003)
    np.testing.assert_allclose(np.abs(mesh.vertices[:, :2]).max(0), [12, 9], atol=0.8)


def test_the_surface_has_one_side_only_and_it_faces_the_camera():
    """No sheet at the rim, where cells have corners that nobody has seen."""
    mesh = fused([plane()])
    a, b, c = (mesh.vertices[mesh.triangles[:, i]] for i in range(3))
    normals = np.cross(b - a, c - a)
    assert (normals[:, 2] <= 1e-9).all() and (normals[:, 2] < 0).mean() > 0.95
    area = -0.5 * normals[:, 2].sum()
    assert area == pytest.approx(np.prod(np.ptp(mesh.vertices[:, :2], axis=0)), rel=0.04)


def test_the_pose_carries_the_surface_into_the_map():
    pose = np.eye(4)
    pose[:3, :3] = [[0, 0, -1], [0, 1, 0], [1, 0, 0]]  # the camera looks along the map's x
    pose[:3, 3] = [0, 0, -5.0]
    assert np.abs(fused([plane()], [pose]).vertices[:, 0] - 25).max() < 0.01


def test_the_unit_of_the_map_does_not_matter():
    """A map whose distances are thousandths, or thousands, fuses alike."""
    expected = fused([plane()])
    for unit in (1e-3, 1e3):
        mesh = fused([plane(20.0 * unit)], voxel=0.4 * unit)
        assert len(mesh.vertices) == pytest.approx(len(expected.vertices), rel=0.03)
        assert np.abs(mesh.vertices[:, 2] / unit - 20).max() < 0.01


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 0.0, -3.0])
def test_depth_that_is_not_known_does_no_harm(bad):
    z = np.full((90, 120), 20.0)
    valid = np.ones((90, 120), bool)
    valid[:, :60] = False
    z[:, :60] = bad
    expected = fused([plane(valid=valid)])
    with np.errstate(invalid="ignore"):
        mesh = fused([plane(z)])
    assert len(mesh.vertices) == len(expected.vertices) > 500
    assert np.abs(mesh.vertices[:, 2] - 20).max() < 0.01


def test_a_view_without_any_depth_changes_nothing():
    volume = TsdfVolume(0.4, FusionConfig())
    assert not len(volume.integrate(plane(valid=np.zeros((90, 120), bool)), np.eye(4)))
    assert not len(volume.places) and not len(volume.extract_mesh().triangles)


def test_an_empty_volume_gives_an_empty_mesh():
    mesh = TsdfVolume(1.0, FusionConfig()).extract_mesh()
    assert mesh.vertices.shape == mesh.triangles.shape == mesh.colors.shape == (0, 3)
    assert mesh.triangles.dtype.kind == "i" and mesh.views.shape == mesh.weights.shape == (0,)


def left_half() -> np.ndarray:
    valid = np.ones((90, 120), bool)
    valid[:, 70:] = False
    return valid


def test_what_one_view_saw_is_kept_unless_more_are_wanted():
    views = [plane(), plane(valid=left_half())]
    whole, shared, none = (fused(views, min_views=n).vertices for n in (1, 2, 3))
    assert whole[:, 0].max() > 10 and len(whole) > 1000
    assert shared[:, 0].max() < 4 and 0.4 * len(whole) < len(shared) < 0.8 * len(whole)
    assert len(none) == 0


def test_every_vertex_knows_how_many_views_saw_it_and_with_what_weight():
    mesh = fused([plane(), plane(valid=left_half()), plane(color=1.0)])
    left, right = mesh.vertices[:, 0] < 1, mesh.vertices[:, 0] > 3
    assert (mesh.views[left] == 3).all() and (mesh.views[right] == 2).all()
    middle = np.linalg.norm(mesh.vertices[:, :2], axis=1) < 2
    np.testing.assert_allclose(mesh.weights[middle], 2.5, atol=0.15)  # two whole looks and a saturated one
    assert mesh.weights[right & (mesh.vertices[:, 0] > 9)].max() < 1.5


@pytest.mark.parametrize(("z", "views"), [(20.1, 2), (20.3, 1)])
def test_a_vertex_was_seen_by_the_views_that_saw_the_voxel_nearest_to_it(z, views):
    """Voxels lie at depths 20.0 and 20.4. A second wall, before this one, is spoken for to depth 20.02 only."""
    mesh = fused([plane(z), plane(20.02 - 6 * 0.4)], voxel=0.4)
    middle = np.linalg.norm(mesh.vertices[:, :2], axis=1) < 6
    assert middle.sum() > 100 and np.abs(mesh.vertices[middle, 2] - z).max() < 0.1
    assert (mesh.views[middle] == views).all()


def test_a_view_that_looks_through_a_wall_moves_it_less_where_the_front_is_soft():
    """One view has the wall at 20, one with half the weight at 21.8, of a truncation of 2.4: only before it does the
    second pull."""
    looks = [plane(20.0), plane(21.8, color=1.0)]
    hard, soft = (np.median(fused(looks, front=f).vertices[:, 2]) for f in (1.0, 0.3))
    assert 20.0 < soft < hard - 0.05


def test_two_views_that_disagree_meet_by_their_weights():
    assert np.median(fused([plane(20.0), plane(20.6)]).vertices[:, 2]) == pytest.approx(20.3, abs=0.05)
    assert np.median(fused([plane(20.0), plane(20.6, color=1.0)]).vertices[:, 2]) == pytest.approx(20.2, abs=0.04)


def numbers(volume: TsdfVolume) -> dict:
    mesh = volume.extract_mesh()
    return {name: getattr(mesh, name) for name in mesh.__dataclass_fields__}


@cache
def three_views() -> list[tuple[SurfaceView, np.ndarray]]:
    valid = np.random.default_rng(0).random((90, 120)) < 0.9
    return [(plane(), np.eye(4)), (plane(20.4, 0.3, valid), shifted(1.7, 0.3)), (plane(19.8, 0.9), shifted(-6, 2, 0.1))]


def test_a_view_that_is_taken_out_leaves_no_trace_bit_for_bit():
    volume, expected = TsdfVolume(0.4, FusionConfig()), TsdfVolume(0.4, FusionConfig())
    for view, pose in three_views():
        volume.integrate(view, pose)
    moved = volume.remove(*three_views()[1])
    for view, pose in three_views()[::2]:
        expected.integrate(view, pose)
    assert len(moved) and np.array_equal(volume.places, expected.places) and volume.views == 2
    for name, values in numbers(volume).items():
        np.testing.assert_array_equal(values, numbers(expected)[name], err_msg=name)


def test_a_corrected_pose_gives_the_surface_of_a_fresh_run_bit_for_bit():
    volume, expected = TsdfVolume(0.4, FusionConfig()), TsdfVolume(0.4, FusionConfig())
    corrected = [(view, shifted(0.05 * i, 0, 0.1 * i) @ pose) for i, (view, pose) in enumerate(three_views())]
    for view, pose in three_views():
        volume.integrate(view, pose)
    for (view, old), (_, new) in zip(three_views(), corrected, strict=True):
        volume.remove(view, old)
        volume.integrate(view, new)
    for view, pose in reversed(corrected):
        expected.integrate(view, pose)
    for name, values in numbers(volume).items():
        np.testing.assert_array_equal(values, numbers(expected)[name], err_msg=name)


def test_a_volume_from_which_all_is_taken_out_holds_nothing():
    volume = TsdfVolume(0.4, FusionConfig())
    for act in (volume.integrate, volume.remove):
        for view, pose in three_views():
            act(view, pose)
    assert not len(volume.places) and volume.views == 0


def by_hand(view: SurfaceView, pose: np.ndarray, voxel: float, places: np.ndarray) -> dict[str, np.ndarray]:
    """What one view adds to the sums of blocks (n, 3), in plain NumPy."""
    inner = np.stack(np.unravel_index(np.arange(512), (8, 8, 8)))
    rotation, translation = pose[:3, :3], pose[:3, 3]
    origins = (places * (8 * voxel) @ rotation.T + translation).astype(np.float32)
    offsets = rotation.astype(np.float32) @ (inner * voxel).astype(np.float32)
    points = origins[:, :, None] + offsets
    pixels = view.table.look_up(origins, offsets)
    normal, tau = np.moveaxis(view.planes[pixels], -1, 1), np.float32(6 * voxel)
    s = normal[:, 3] - normal[:, 0] * points[:, 0] - normal[:, 1] * points[:, 1] - normal[:, 2] * points[:, 2]
    front = FusionConfig().front
    fading = np.minimum(np.clip(1 + s / tau, 0, 1), 1 - (1 - front) * np.clip(s / tau, 0, 1))
    weight = np.rint(view.weights[pixels] * fading).astype(int)
    near = (np.abs(s) < 2 * voxel) & (weight > 0)
    return {
        "weight": weight,
        "distance": weight * np.rint(np.clip(s, -tau, tau) * (STEPS / tau)).astype(int),
        "seen": (weight > 0).astype(int),
        "color": weight[..., None] * view.colors[pixels] * near[..., None],
    }


def test_a_view_adds_what_the_formula_says_to_every_voxel_of_its_blocks():
    for view, pose in three_views():
        volume = TsdfVolume(0.4, FusionConfig())
        volume.integrate(view, pose)
        for name, expected in by_hand(view, pose, 0.4, unpacked(volume.places)).items():
            off = np.abs(sums(volume)[name] - expected)
            # A half is rounded up or down with the order of three products: rarely, and by one step of one look.
            assert off.max() <= (1 if name != "distance" else 4 * FULL) and (off > 0).mean() < 1e-3, name
            assert np.abs(expected).max() > 0


def test_blocks_come_and_go_and_are_found_from_their_neighbours():
    rng, volume, held = np.random.default_rng(0), TsdfVolume(0.4, FusionConfig()), []
    for _ in range(40):
        if held and rng.random() < 0.4:
            volume.remove(*held.pop(rng.integers(len(held))))
        else:
            held.append((three_views()[rng.integers(3)][0], shifted(*rng.uniform(-8, 8, 3))))
            volume.integrate(*held[-1])
    fresh = TsdfVolume(0.4, FusionConfig())
    for view, pose in held:
        fresh.integrate(view, pose)
    assert np.array_equal(volume.places, fresh.places) and len(fresh.places) > 100
    for name, values in sums(volume).items():
        np.testing.assert_array_equal(values, sums(fresh)[name], err_msg=name)
    np.testing.assert_array_equal(volume.extract_mesh().vertices, fresh.extract_mesh().vertices)
    if not hasattr(volume, "_above"):  # by Warp, neighbours are looked up when they are asked for
        return
    slots = volume.slots(volume.places)
    for corner, step in enumerate(CORNERS):
        expected = volume.slots(packed(unpacked(volume.places) + step))
        assert np.array_equal(volume._above[slots, corner], expected)
        assert np.array_equal(volume._below[slots, corner], volume.slots(packed(unpacked(volume.places) - step)))


SCENES = {"plane": slanted_plane, "sphere": sphere, "tube": cylinder}


@cache
def exact(kind: Callable, name: str, lens_name: str) -> tuple[np.ndarray, Mesh]:
    """Error of each vertex in voxels, and the surface, from one view with exact depth; the largest ray angle is 89."""
    scene: Scene = SCENES[name](lens(lens_name, 160, 128))
    voxel = 0.3
    volume = kind(voxel, FusionConfig())
    volume.integrate(surface_view(scene.prediction(), scene.frame().image, RectifyConfig(), 25.0), np.eye(4))
    mesh = volume.extract_mesh()
    if name == "plane":
        normal = np.array([0.3, -0.2, -1.0])
        return np.abs(mesh.vertices @ normal / np.linalg.norm(normal) + 12) / voxel, mesh
    radius = np.linalg.norm(mesh.vertices if name == "sphere" else mesh.vertices[:, :2], axis=1)
    return np.abs(radius - (10 if name == "sphere" else 8)) / voxel, mesh


@pytest.mark.parametrize("lens_name", ["pinhole", "fisheye", "c3vd"])
@pytest.mark.parametrize("name", SCENES)
def test_exact_depth_gives_a_surface_good_to_a_small_part_of_a_voxel(kind, name, lens_name):
    """Plane, sphere and tube, through each lens. Seen: medians up to 0.002, 95th percentiles up to 0.01."""
    error, mesh = exact(kind, name, lens_name)
    print(f"{name}, {lens_name}: median {np.median(error):.4f}, 95th percentile {np.quantile(error, 0.95):.4f} voxels")
    assert len(mesh.triangles) > 3000
    assert np.median(error) <= 0.06 and np.quantile(error, 0.95) <= 0.5


@pytest.mark.parametrize("lens_name", ["fisheye", "c3vd"])
def test_the_surface_reaches_to_the_rim_of_the_field(kind, lens_name):
    camera = lens(lens_name, 160, 128)
    rays, valid = camera.rays()
    _, mesh = exact(kind, "sphere", lens_name)
    found = np.degrees(np.arccos(mesh.vertices[:, 2] / np.linalg.norm(mesh.vertices, axis=1)).max())
    widest = np.degrees(np.arccos(rays[valid][:, 2].min()))
    print(f"{lens_name}: {found:.1f} of {widest:.1f} degrees")
    assert found > widest - 2 * np.degrees(0.3 / 10)  # two voxels


def step(camera, near: float = 10.0, far: float = 16.0) -> DepthPrediction:
    rays, valid = camera.rays()
    valid = valid & (rays[..., 2] > 0.5)
    depth = np.where(np.arange(camera.width) < camera.width // 2, near, far)
    distance = np.where(valid, depth / np.where(valid, rays[..., 2], 1), 1).astype(np.float32)
    return DepthPrediction("1", distance, valid, camera, "step")


@pytest.mark.parametrize("name", ["pinhole", "fisheye"])
def test_there_is_no_curtain_between_two_planes(name):
    prediction = step(lens(name, 160, 128))
    view = surface_view(prediction, np.full((128, 160, 3), 0.5, np.float32), RectifyConfig())
    z = fused([view], voxel=0.25).vertices[:, 2]
    assert (np.abs(z - 10) < 0.05).sum() > 500 and (np.abs(z - 16) < 0.05).sum() > 500
    assert not ((z > 11) & (z < 15)).any()


@pytest.mark.parametrize("voxel", [0.0, -1.0, np.nan, np.inf])
def test_a_voxel_without_size_is_refused(voxel):
    with refused(cure="expected a positive length in map units"):
        TsdfVolume(voxel, FusionConfig())


def test_voxels_far_too_small_are_refused_before_memory_is_gone():
    volume = TsdfVolume(1e-4, FusionConfig())
    with refused(cure="choose larger voxels"):
        volume.integrate(plane(), np.eye(4))
    assert not len(volume.places)


def test_a_view_too_far_from_the_origin_for_names_is_refused():
    volume = TsdfVolume(0.4, FusionConfig())
    with refused(found="one view reaches 2500", cure="at most 524288"):
        volume.integrate(plane(), shifted(-1e6))
    assert not len(volume.places)
