"""Pictures are what they say, and need no display."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import trimesh

from lightdepth.reporting.figures import (
    BAD,
    GOOD,
    UNSURE,
    MeshView,
    chart,
    chart_png,
    colored_distance,
    contact_sheet,
    marked_points,
    normal_colors,
    png,
    side_by_side,
    signed_colors,
    thumbnail,
    uncertainty_colors,
    webp,
)


def decoded(data: bytes) -> np.ndarray:
    return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]


def test_a_png_is_the_image_in_rgb():
    image = np.random.default_rng(0).integers(0, 256, (5, 7, 3)).astype(np.uint8)
    np.testing.assert_array_equal(decoded(png(image)), image)
    np.testing.assert_array_equal(decoded(png(image / 255.0)), image)
    assert (decoded(png(np.full((2, 2, 3), 1.7))) == 255).all()  # clipped, not wrapped


@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
def test_a_thumbnail_keeps_aspect_and_brightness(dtype):
    image = np.full((60, 90, 3), 0.4 if dtype == np.float32 else 102, dtype)
    small = thumbnail(image, 30)
    assert small.shape == (20, 30, 3) and small.dtype == np.uint8 and (small == 102).all()
    assert thumbnail(image[:1], 10).shape == (1, 10, 3)


def test_near_is_bright_far_is_dark_and_unknown_is_black():
    distance = np.tile(np.linspace(5, 50, 40), (10, 1)).astype(np.float32)
    valid = np.ones_like(distance, bool)
    valid[0] = False
    distance[1], distance[2] = np.nan, 0
    picture = colored_distance(distance, valid)
    assert not picture[:3].any()
    grey = picture[5].astype(float).sum(-1)
    assert grey[0] > 2 * grey[-1] and (np.diff(grey[::8]) < 0).all()
    assert picture[5, 0, 0] > 200 and picture[5, 0, 2] < 100  # yellow
    assert not colored_distance(distance, np.zeros_like(valid)).any()


def test_a_given_range_makes_pictures_comparable():
    near, far = (np.full((4, 4), d, np.float32) for d in (10.0, 40.0))
    all_valid = np.ones((4, 4), bool)
    one, two = (colored_distance(d, all_valid, (5, 50)) for d in (near, far))
    assert not np.array_equal(one, two)
    assert np.array_equal(one, colored_distance(near, all_valid, (5, 50)))


def test_points_are_drawn_at_their_pixels_in_their_colours():
    image = np.zeros((100, 200, 3), np.float32)
    picture = marked_points(image, [(np.array([[50.5, 50.5]]), GOOD), (np.array([[150.5, 20.5]]), BAD)], width=200)
    assert tuple(picture[50, 50]) == GOOD and tuple(picture[20, 150]) == BAD
    assert (picture.any(-1)).sum() < 80
    assert tuple(marked_points(image, [(np.array([[50.5, 50.5]]), GOOD)], width=400)[100, 100]) == GOOD
    assert not marked_points(image, [(np.zeros((0, 2)), GOOD)]).any()


def test_images_in_a_row_have_one_height_and_white_between():
    row = side_by_side([np.zeros((20, 10, 3), np.uint8), np.zeros((40, 40, 3), np.uint8)], gap=6)
    assert row.shape == (20, 10 + 6 + 20, 3)
    assert (row[:, 10:16] == 255).all() and not row[:, :10].any() and not row[:, 16:].any()


def test_a_mesh_is_seen_from_outside_and_from_a_place_of_its_own():
    mesh = trimesh.creation.icosphere(3, 2.0)
    vertices, triangles = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    colors = np.tile([1.0, 0.2, 0.2], (len(vertices), 1))
    outside = MeshView.of(vertices, triangles, (80, 60)).picture(colors)
    assert (outside[0, 0] == 255).all() and outside[30, 40, 0] > 1.5 * outside[30, 40, 1]
    shape = MeshView.of(vertices, triangles, (80, 60)).picture()
    assert shape[30, 40].min() > 100 and np.ptp(shape[30, 40].astype(int)) < 16 and (shape[0, 0] == 255).all()
    inside = MeshView.of(vertices, triangles, (80, 60), np.zeros(3), np.eye(3)).picture(colors)
    assert not (inside == 255).all(-1).any()
    away = MeshView.of(vertices, triangles, (80, 60), np.array([0, 0, 10.0]), np.eye(3)).picture(colors)
    assert (away == 255).all()


@pytest.mark.parametrize(("size", "away"), [(1e-9, 0.0), (1.0, 1e6), (1e9, 0.0), (1e-3, 1e4)])
def test_a_mesh_looks_the_same_whatever_the_unit_of_its_map_and_wherever_that_lies(size, away):
    mesh = trimesh.creation.icosphere(3, 2.0)
    vertices, triangles = np.asarray(mesh.vertices) * [3, 2, 1], np.asarray(mesh.faces)
    for place in ({}, {"origin": np.array([0, 0.1, -8.0]), "axes": np.eye(3)}):
        moved = {"origin": place["origin"] * size + away, "axes": place["axes"]} if place else {}
        usual = MeshView.of(vertices, triangles, (80, 60), **place).picture()
        seen = MeshView.of(vertices * size + away, triangles, (80, 60), **moved).picture()
        assert (np.abs(seen.astype(int) - usual) > 12).any(-1).mean() < 0.02


def test_a_single_triangle_is_seen_whole():
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 0.7, 0]])
    seen = (MeshView.of(corners, np.array([[0, 1, 2]]), (80, 60)).picture() < 255).any(-1)
    assert 0.15 < seen.mean() < 0.6
    assert not (seen[0].any() or seen[-1].any() or seen[:, 0].any() or seen[:, -1].any())


def test_a_mesh_of_nothing_is_a_white_picture():
    empty = np.zeros((0, 3))
    assert (MeshView.of(empty, empty.astype(int), (8, 6)).picture(empty) == 255).all()


def test_a_cutout_is_clear_where_there_is_no_surface_and_a_webp_keeps_that():
    mesh = trimesh.creation.icosphere(3, 2.0)
    view = MeshView.of(np.asarray(mesh.vertices), np.asarray(mesh.faces), (80, 60))
    cut = view.cutout()
    assert cut.shape == (60, 80, 4) and np.array_equal(cut[..., :3], view.picture())
    assert np.array_equal(cut[..., 3] > 0, view.met) and 0.2 < view.met.mean() < 0.9
    read = cv2.imdecode(np.frombuffer(webp(cut), np.uint8), cv2.IMREAD_UNCHANGED)
    assert np.array_equal(read[..., 3], cut[..., 3])
    assert np.abs(read[30, 40, :3].astype(int) - cut[30, 40, 2::-1]).max() < 12
    assert len(webp(cut)) < len(png(cut[..., :3])) / 2


def test_errors_are_white_where_right_red_above_blue_below_and_grey_where_unknown():
    colors = signed_colors(np.array([[0.0, 1.0, -5.0, 0.0]]), np.array([[True, True, True, False]]))[0].tolist()
    assert colors == [[255, 255, 255], [200, 20, 20], [20, 60, 200], [120, 120, 120]]


def test_the_uncertainty_is_yellow_where_it_is_large_violet_where_small_and_black_where_nothing_is_known():
    doubt, valid = np.zeros((20, 30), np.float32), np.ones((20, 30), bool)
    doubt[:, 15:], doubt[1, 1], valid[0] = UNSURE, np.nan, False
    colors = uncertainty_colors(doubt, valid).astype(int)
    violet, yellow = colors[10, 5], colors[10, 20]
    assert violet[2] > violet[1] and yellow[0] > 200 and yellow[1] > 200 and yellow[2] < 80
    assert not colors[0].any() and not colors[1, 1].any()


def test_normals_are_blue_towards_the_camera_red_to_the_right_and_green_up():
    normals = np.array([[[0, 0, -1.0], [1, 0, 0], [0, -1, 0], [0, 0, -1]]])
    colors = normal_colors(normals, np.array([[True, True, True, False]]))[0].astype(int)
    assert [color.argmax() for color in colors[:3]] == [2, 0, 1] and not colors[3].any()
    assert colors[0, 2] == 255 and abs(colors[0, 0] - 128) <= 1


def test_a_chart_needs_no_display(monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    figure, axes = chart((2.0, 1.0))
    axes.plot([1, 2, 3])
    assert decoded(chart_png(figure)).shape == (110, 220, 3)


def test_a_contact_sheet_has_rows_of_framed_thumbnails_with_labels():
    pictures = [np.full((40, 80, 3), 0.1 * i) for i in range(5)]
    sheet = contact_sheet(pictures, [str(i) for i in range(5)], [GOOD, BAD, GOOD, GOOD, BAD], columns=3, width=60)
    one = contact_sheet(pictures[:1], ["0"], columns=3, width=60)
    assert sheet.shape[1] == 3 * (one.shape[1] - 6) + 6 and sheet.shape[0] == 2 * (one.shape[0] - 6) + 6
    for color, count in ((GOOD, 3), (BAD, 2)):
        assert (sheet == color).all(-1).sum() == count * (66 * 36 - 60 * 30)
    assert (one == 190).all(-1).any() and not (sheet[-4:, -60:] != 255).any()  # the last cell of the last row is empty
    assert (one[46:58] < 120).any()  # the label
