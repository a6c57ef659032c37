"""Marching cubes: closed, oriented, and silent about what is not known."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from densify.marching_cubes import CORNERS, EDGES, marching_cubes, triangle_table


def surface(values: np.ndarray):
    """Vertices and triangles of one block (B, B, B)."""
    neighbors = np.full((1, 8), -1)
    neighbors[0, 0] = 0
    first, second, share, triangles = marching_cubes(values[None], neighbors, np.ones(1, bool))
    a, b = (np.stack(np.unravel_index(i, values.shape), -1) for i in (first, second))
    return a + share[:, None] * (b - a), triangles


def edges_of(triangles: np.ndarray) -> list[tuple[int, int]]:
    return [(int(t[i]), int(t[(i + 1) % 3])) for t in triangles for i in range(3)]


@pytest.mark.parametrize("seed", range(5))
def test_any_field_has_a_surface_without_cracks_whose_sides_do_not_change(seed):
    """Random values make every case, ambiguous ones too: each edge away from the border belongs to two triangles that
    run through it in opposite ways."""
    values = np.random.default_rng(seed).normal(size=(9, 9, 9)).astype(np.float32)
    vertices, triangles = surface(values)
    directed = edges_of(triangles)
    assert len(directed) == len(set(directed)) > 3000
    backward = {(b, a) for a, b in directed}
    open_edges = [e for e in directed if e not in backward]
    border = ((vertices < 1e-6) | (vertices > 8 - 1e-6)).any(1)
    assert all(border[a] and border[b] for a, b in open_edges)


def test_a_case_and_its_triangles_cut_off_exactly_the_inside_corners():
    table, counts = triangle_table()
    for case in range(256):
        inside = [bool(case >> c & 1) for c in range(8)]
        used = set(table[case, : counts[case]].ravel().tolist())
        assert used == {e for e, (a, b, _) in enumerate(EDGES.tolist()) if inside[a] != inside[b]}
    assert counts[0] == counts[255] == 0 and counts.max() == 5


def test_a_ball_has_its_area_and_its_volume_on_the_right_side():
    grid = np.stack(np.meshgrid(*[np.arange(24.0)] * 3, indexing="ij"), -1) - 11.6
    values = (np.linalg.norm(grid, axis=-1) - 8).astype(np.float32)
    vertices, triangles = surface(values)
    a, b, c = (vertices[triangles[:, i]] - 11.6 for i in range(3))
    assert 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() == pytest.approx(4 * np.pi * 64, rel=0.01)
    assert np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6 == pytest.approx(4 / 3 * np.pi * 512, rel=0.01)


def test_no_cell_with_an_unknown_corner_has_any_surface():
    values = np.broadcast_to(np.arange(8.0, dtype=np.float32)[:, None, None] - 3.5, (8, 8, 8)).copy()
    values[3, 4, 4] = np.nan
    vertices, triangles = surface(values)
    middles = vertices[triangles].mean(1)
    np.testing.assert_allclose(vertices[:, 0], 3.5)
    assert not ((np.abs(middles[:, 1:] - 4) < 1).all(1)).any()
    area = 0.5 * np.linalg.norm(
        np.cross(*(vertices[triangles[:, i]] - vertices[triangles[:, 0]] for i in (1, 2))), axis=1
    )
    assert area.sum() == pytest.approx(49 - 4)


def test_blocks_that_touch_have_one_surface_without_a_seam():
    values = np.random.default_rng(0).normal(size=(8, 8, 8)).astype(np.float32)
    blocks = np.stack([values[i : i + 4, j : j + 4, k : k + 4] for i, j, k in product((0, 4), repeat=3)])
    places = list(product((0, 1), repeat=3))
    neighbors = np.array(
        [[places.index(tuple(q)) if max(q) < 2 else -1 for q in (p + CORNERS).tolist()] for p in places]
    )
    _, _, _, together = marching_cubes(blocks, neighbors, np.ones(8, bool))
    vertices, whole = surface(values)
    assert len(together) == len(whole) and together.max() + 1 == len(vertices)
