"""Rays against a mesh, on the CPU and by the library that does it on a GPU."""

from __future__ import annotations

import sys

import numpy as np
import pytest
import torch
from colons import SMALL
from raising import refused

import lightdepth.tube.scene as scene
from lightdepth import native
from lightdepth.tube import Tube, camera_path, lens, octagon, realistic, render_sequence
from lightdepth.tube.casting import EmbreeCaster, WarpCaster, rendering_device
from lightdepth.tube.variant import variant_frames

CPU = torch.device("cpu")
CAMERA = lens("fisheye", 80, 64)
needs_warp = pytest.mark.skipif(not native.has_warp(), reason="NVIDIA Warp is not installed (extra [gpu])")
needs_gpu = pytest.mark.skipif(
    not (torch.cuda.is_available() and native.has_warp()), reason="no GPU, or NVIDIA Warp is not installed"
)


@pytest.fixture(scope="module")
def shape():
    return Tube(SMALL, np.random.default_rng(5)).shape


def random_points(shape, count: int) -> torch.Tensor:
    """Inside the colon or a little outside it."""
    rng = np.random.default_rng(1)
    near = shape.centers[rng.integers(0, len(shape.centers), count)]
    return torch.from_numpy((near + rng.normal(0, 12, (count, 3))).astype(np.float32))


def test_a_ray_across_a_triangle_meets_it_where_algebra_says():
    corners, faces = np.array([[0, 0, 5], [4, 0, 5], [0, 4, 5.0]]), np.array([[0, 1, 2]])
    for caster in [EmbreeCaster(corners, faces)] + [WarpCaster(corners, faces, CPU)] * native.has_warp():
        directions = torch.tensor([[0.0, 0, 1], [0, 0, -1]])
        hit = caster.cast(torch.tensor([[1.0, 2, 0]] * 2), directions)
        np.testing.assert_allclose(hit.distance, [5.0, np.inf], rtol=1e-6)
        np.testing.assert_allclose(hit.uv[0], [0.25, 0.5], atol=1e-5)
        start, end = torch.zeros(3, 3), torch.tensor([[0.4, 0.4, 6], [0.4, 0.4, 4], [0, 0, 0]])
        assert caster.blocked(start, end).tolist() == [True, False, False]


@needs_warp
def test_both_libraries_meet_the_same_triangles(shape):
    vertices = shape.vertices.reshape(-1, 3)
    embree, warp = EmbreeCaster(vertices, shape.faces), WarpCaster(vertices, shape.faces, CPU)
    start, end = random_points(shape, 4000), random_points(shape, 4000).flip(0)
    directions = torch.nn.functional.normalize(end - start, dim=-1)
    a, b = embree.cast(start, directions), warp.cast(start, directions)
    met = a.distance.isfinite()
    assert met.float().mean() > 0.5 and not met.all()
    assert (met == b.distance.isfinite()).float().mean() > 0.999  # of rays that graze an edge, one may slip by
    same = met & (a.face == b.face)
    assert same.sum() > 0.999 * met.sum()
    torch.testing.assert_close(a.distance[same], b.distance[same], rtol=1e-4, atol=1e-3)
    torch.testing.assert_close(a.uv[same], b.uv[same], rtol=0, atol=5e-3)
    hidden = embree.blocked(start, end)
    assert 0.1 < hidden.float().mean() < 0.9
    assert (hidden == warp.blocked(start, end)).float().mean() > 0.999


def same_views(some, others) -> None:
    for one, other in zip(some, others, strict=True):
        np.testing.assert_allclose(one.distance, other.distance, rtol=1e-4, atol=1e-3)
        off = np.abs(one.image - other.image)
        assert off.mean() < 1e-4 and (off > 1.5 / 255).mean() < 1e-3  # rounding to 8 bits may fall to the other side


def some_views(device="cpu", at_once=3, config=None):
    rng = np.random.default_rng(8)
    tube = Tube(config or realistic(), rng, device=device)
    poses = camera_path(tube.shape, 3, 20.0, rng)
    batches = [poses[i : i + at_once] for i in range(0, 3, at_once)]
    return [view for batch in batches for view in tube.views(batch, CAMERA, octagon(CAMERA), rng)]


def test_a_batch_of_views_is_the_views_one_by_one():
    same_views(some_views(), some_views(at_once=1))


@needs_warp
def test_a_colon_looks_the_same_by_either_library(monkeypatch):
    expected = some_views()
    made = []

    def by_warp(*mesh) -> WarpCaster:
        made.append(WarpCaster(*mesh))
        return made[-1]

    monkeypatch.setattr(scene, "make_caster", by_warp)
    same_views(some_views(), expected)
    assert made


@needs_gpu
def test_a_colon_looks_the_same_on_a_gpu():
    same_views(some_views("cuda"), some_views())
    frames = [render_sequence(3, 4, CAMERA, 10.0, SMALL, device=device).frames for device in ("cuda", "cpu")]
    for one, other in zip(*frames, strict=True):
        np.testing.assert_allclose(one.true_distance, other.true_distance, rtol=1e-4, atol=1e-3)
    assert variant_frames(3, 1, CAMERA, "weak")[0].image.any()


def test_a_camera_that_sees_no_wall_sees_nothing():
    rng = np.random.default_rng(5)
    tube = Tube(SMALL, rng)
    inside = camera_path(tube.shape, 1, 5.0, rng)[0]
    outside = inside.copy()
    outside[:3, 3] += 1000
    views = tube.views(np.stack([outside, inside]), CAMERA, octagon(CAMERA), rng)
    assert not views[0].image.any() and not views[0].distance.any()
    assert views[1].image.any() and np.isfinite(views[1].image).all()


def test_the_distance_to_the_wall_needs_no_gpu(shape):
    tube = Tube(SMALL, np.random.default_rng(5))
    on_it, above = shape.vertices[40, :5], shape.vertices[40, :5] + 0.3 * shape.normals[40, :5]
    np.testing.assert_allclose(tube.distance_to_wall(on_it), 0, atol=1e-4)
    np.testing.assert_allclose(tube.distance_to_wall(above), 0.3, atol=0.05)


def test_a_device_that_is_not_there_is_refused(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert rendering_device("auto") == CPU == rendering_device("cpu")
    with refused(found="PyTorch finds no GPU"):
        rendering_device("cuda")
    with refused(where="to render on", found="'gpu'"):
        rendering_device("gpu")


def test_without_the_library_the_message_says_what_to_install(monkeypatch):
    native.warp.cache_clear()
    monkeypatch.setitem(sys.modules, "warp", None)
    with refused(cure="lightdepth[gpu]"):
        WarpCaster(np.zeros((3, 3)), np.array([[0, 1, 2]]), CPU)
    native.warp.cache_clear()
