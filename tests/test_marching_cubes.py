"""Marching cubes: closed, oriented, without seams between blocks, and silent about what is not known."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from densify.fusion.marching_cubes import CORNERS, EDGES, Cut, cut, one_vertex_an_edge, packed, triangle_table, unpacked


def cut_of(values: np.ndarray) -> Cut:
    """The surface of values (8 a, 8 b, 8 c), NaN where nothing is known, in as many blocks, held in no order."""
    shape = np.array(values.shape) // 8
    places = np.random.default_rng(0).permutation(list(np.ndindex(*shape)))
    blocks = np.stack([values[tuple(np.s_[8 * p : 8 * p + 8] for p in place)].reshape(512) for place in places])
    codes = packed(places - 1).tolist()
    above = [[codes.index(c) if c in codes else -1 for c in packed(p - 1 + CORNERS).tolist()] for p in places]
    distance = np.rint(np.nan_to_num(blocks, nan=-1) * 2**24).astype(np.int32)
    behind, known = (np.packbits(bits, axis=1, bitorder="little") for bits in (distance < 0, ~np.isnan(blocks)))
    arrays = behind, known, np.array(above, np.int32), np.array(codes), np.arange(len(codes))
    return cut(distance, np.ones_like(distance), *arrays)


def surface(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices, counted in voxels from the first, and triangles."""
    found = cut_of(values)
    starts = np.repeat(found.first_vertex[:-1], np.diff(found.first_triangle))
    first, triangles = one_vertex_an_edge(found.names, found.triangles + starts[:, None])
    return found.positions[first] + 8, triangles


def edges_of(triangles: np.ndarray) -> list[tuple[int, int]]:
    return [(int(t[i]), int(t[(i + 1) % 3])) for t in triangles for i in range(3)]


def noise(seed: int, *shape: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1, 1, shape)


@pytest.mark.parametrize("seed", range(3))
def test_any_field_has_a_surface_without_cracks_whose_sides_do_not_change(seed):
    """Random values make every case, ambiguous ones too: each edge away from the border belongs to two triangles that
    run through it in opposite ways."""
    vertices, triangles = surface(noise(seed, 16, 8, 16))
    directed = edges_of(triangles)
    assert len(directed) == len(set(directed)) > 3000
    backward = {(b, a) for a, b in directed}
    open_edges = [e for e in directed if e not in backward]
    border = ((vertices < 1e-6) | (vertices > np.array([15, 7, 15]) - 1e-6)).any(1)
    assert all(border[a] and border[b] for a, b in open_edges)


def test_any_signs_whatever_give_a_closed_surface():
    values = np.ones((16, 16, 16))
    values[1:15, 1:15, 1:15] = noise(1, 14, 14, 14)
    case = sum((values[x : x + 15, y : y + 15, z : z + 15] < 0) << b for b, (x, y, z) in enumerate(CORNERS.tolist()))
    vertices, triangles = surface(values)
    assert len(np.unique(case)) == 256 and len(vertices) > 2000
    edges = np.concatenate([triangles[:, [i, (i + 1) % 3]] for i in range(3)])
    there, times = np.unique(edges, axis=0, return_counts=True)
    back, back_times = np.unique(edges[:, ::-1], axis=0, return_counts=True)
    assert np.array_equal(there, back) and np.array_equal(times, back_times)


def cell_by_cell(values: np.ndarray) -> np.ndarray:
    """The corners (m, 9) of all triangles, from the table and nothing else."""
    table, counts = triangle_table()
    found = []
    for cell in product(*(range(n - 1) for n in values.shape)):
        places = np.array(cell) + CORNERS
        at = values[tuple(places.T)]
        if np.isnan(at).any():
            continue
        case = int(((at < 0) << np.arange(8)).sum())
        for triangle in table[case, : counts[case]]:
            one, two = EDGES[triangle, 0], EDGES[triangle, 1]
            share = (at[one] / (at[one] - at[two]))[:, None]
            found.append((places[one] + share * (places[two] - places[one])).ravel())
    return np.array(found)


def test_blocks_together_have_the_triangles_of_their_cells_one_by_one():
    values = noise(2, 16, 16, 8)
    values[noise(3, 16, 16, 8) < -0.98] = np.nan
    values[9:14, 9:14, 2:6] = 1.0
    expected = cell_by_cell(values)
    vertices, triangles = surface(values)
    assert len(triangles) == len(expected) > 1000
    assert len(vertices) == len(np.unique(expected.reshape(-1, 3).round(6), axis=0))
    ours = vertices[triangles].reshape(-1, 9)
    order, other = (np.lexsort(a.round(4).T) for a in (ours, expected))
    np.testing.assert_allclose(ours[order], expected[other], atol=1e-5)


def test_what_a_cut_says_of_a_vertex_fits_together():
    values = noise(4, 16, 8, 8)
    found = cut_of(values)
    assert len(found.rows) == 2 and found.first_vertex[-1] == len(found.names) == len(found.share)
    assert found.triangles.max() < np.diff(found.first_vertex).max()
    place, axis = unpacked(found.names // 3), found.names % 3
    np.testing.assert_allclose(found.positions, place + found.share[:, None] * np.eye(3)[axis])
    blocks = np.random.default_rng(0).permutation(list(np.ndindex(2, 1, 1)))  # as cut_of holds them
    for end, step in ((found.near, 0), (found.far, 1)):
        slot, inner = np.divmod(end, 512)
        voxel = 8 * blocks[slot] + np.stack(np.unravel_index(inner, (8, 8, 8)), -1)
        assert np.array_equal(voxel - 8, place + step * np.eye(3, dtype=int)[axis])


def test_a_case_and_its_triangles_cut_off_exactly_the_inside_corners():
    table, counts = triangle_table()
    for case in range(256):
        inside = [bool(case >> c & 1) for c in range(8)]
        used = set(table[case, : counts[case]].ravel().tolist())
        assert used == {e for e, (a, b, _) in enumerate(EDGES.tolist()) if inside[a] != inside[b]}
    assert counts[0] == counts[255] == 0 and counts.max() == 5


def test_a_ball_has_its_area_and_its_volume_on_the_right_side():
    grid = np.stack(np.meshgrid(*[np.arange(24.0)] * 3, indexing="ij"), -1) - 11.6
    vertices, triangles = surface(np.linalg.norm(grid, axis=-1) - 8)
    a, b, c = (vertices[triangles[:, i]] - 11.6 for i in range(3))
    assert 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() == pytest.approx(4 * np.pi * 64, rel=0.01)
    assert np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6 == pytest.approx(4 / 3 * np.pi * 512, rel=0.01)


def test_no_cell_with_an_unknown_corner_has_any_surface():
    values = np.broadcast_to(np.arange(8.0)[:, None, None] - 3.5, (8, 8, 8)).copy()
    values[3, 4, 4] = np.nan
    vertices, triangles = surface(values)
    middles = vertices[triangles].mean(1)
    np.testing.assert_allclose(vertices[:, 0], 3.5)
    assert not ((np.abs(middles[:, 1:] - 4) < 1).all(1)).any()
    area = 0.5 * np.linalg.norm(
        np.cross(*(vertices[triangles[:, i]] - vertices[triangles[:, 0]] for i in (1, 2))), axis=1
    )
    assert area.sum() == pytest.approx(49 - 4)


def test_places_are_packed_and_unpacked_below_zero_too_and_keep_their_order():
    places = np.array([[0, 0, 0], [-1, 5, -70000], [500000, -500000, 3]])
    assert np.array_equal(unpacked(packed(places)), places)
    some = np.random.default_rng(0).integers(-3, 4, (50, 3))
    assert np.array_equal(some[np.argsort(packed(some), kind="stable")], some[np.lexsort(some.T[::-1])])


def test_a_surface_that_outgrows_its_first_memory_is_whole():
    """Of 27 blocks of noise: more corners and more vertices than there is room for at first."""
    values = np.ones((24, 24, 24))
    values[1:23, 1:23, 1:23] = noise(5, 22, 22, 22)
    found = cut_of(values)
    assert len(found.rows) == 27 and 3 * len(found.triangles) > 49152 and len(found.names) > 8192
    _, triangles = surface(values)
    edges = np.concatenate([triangles[:, [i, (i + 1) % 3]] for i in range(3)])
    assert np.array_equal(np.unique(edges, axis=0), np.unique(edges[:, ::-1], axis=0))
    place, axis = unpacked(found.names // 3), found.names % 3
    np.testing.assert_allclose(found.positions, place + found.share[:, None] * np.eye(3)[axis])
