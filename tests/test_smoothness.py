"""The share of edges at which a mesh turns sharply: on meshes whose turns are known, and against trimesh."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from densify.evaluation.errors import TrueSurface, pooled, surface_errors
from densify.evaluation.smoothness import Edges, edges


def sheet(height: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A grid of unit squares, each of two triangles, over heights (h, w)."""
    rows, columns = height.shape
    y, x = np.mgrid[:rows, :columns]
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]
    triangles = np.concatenate([np.stack(t, -1).reshape(-1, 3) for t in ((a, b, c), (b, d, c))])
    return np.stack([x, y, height], -1).reshape(-1, 3).astype(float), triangles


def test_a_fold_turns_at_its_own_edges_and_only_where_it_is_sharper_than_thirty_degrees():
    away = np.abs(np.arange(11.0) - 5)[None].repeat(4, 0)  # from the fold along the middle column
    for degrees, sharp in ((28, 0), (32, 3)):
        found = edges(*sheet(np.tan(np.radians(degrees / 2)) * away))
        assert found == Edges(sharp, 30 + 27 + 20)  # across squares, and between them along both axes


def test_turns_are_those_of_trimesh():
    rng = np.random.default_rng(0)
    vertices, triangles = sheet(rng.normal(0, 0.4, (9, 12)))
    angles = trimesh.Trimesh(vertices, triangles, process=False).face_adjacency_angles
    assert edges(vertices, triangles) == Edges(int((angles > np.radians(30)).sum()), len(angles))
    assert 0.1 < edges(vertices, triangles).share < 0.9


def test_a_triangle_without_area_and_an_edge_with_one_face_do_not_count():
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [2, 0, 0]])
    assert edges(vertices, np.array([[0, 1, 2], [1, 0, 3]])) == Edges(0, 0)
    assert edges(vertices, np.zeros((0, 3), int)).share is None


def test_the_share_of_maps_together_is_over_all_of_their_edges_and_a_cloud_has_none():
    wavy, flat = sheet(2.0 * (np.indices((6, 6)).sum(0) % 2)), sheet(np.zeros((20, 20)))
    truth = TrueSurface(flat[0], "")
    both = [surface_errors(vertices, truth, triangles) for vertices, triangles in (wavy, flat)]
    one, two = (edges(*mesh) for mesh in (wavy, flat))
    share = pooled(both).summary((1.0,)).sharp_edges
    assert share == pytest.approx((one.sharp + two.sharp) / (one.all + two.all)) and 0 < share < one.share
    assert surface_errors(wavy[0], truth).summary((1.0,)).sharp_edges is None
