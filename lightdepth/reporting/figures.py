"""Pictures: arrays in, RGB images or PNG bytes out. No display is needed; meshes are drawn by ray casting."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from lightdepth import native

GOOD, BAD, KEPT = (0, 200, 80), (235, 40, 40), (255, 170, 0)
UNSURE = 0.3
"""Predicted standard deviation of log distance from which on a pixel is yellow."""
PLAIN = (0.82, 0.8, 0.78)
"""of a surface that is shown without its colour"""


def png(image: np.ndarray) -> bytes:
    """PNG of an RGB image (H, W, 3), uint8 or float in [0, 1]."""
    done, data = cv2.imencode(".png", cv2.cvtColor(_eight_bits(image), cv2.COLOR_RGB2BGR))
    assert done
    return data.tobytes()


def jpeg(image: np.ndarray, quality: int = 88) -> bytes:
    """JPEG of an RGB image (H, W, 3), uint8 or float in [0, 1]: of an image or a surface, a fifth of the PNG's size."""
    image = cv2.cvtColor(_eight_bits(image), cv2.COLOR_RGB2BGR)
    done, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    assert done
    return data.tobytes()


def webp(image: np.ndarray, quality: int = 88) -> bytes:
    """WebP of an RGB image (H, W, 3), or of one that is clear in places (H, W, 4), uint8 or float in [0, 1]: as small
    as a JPEG, and the page shows where it is clear."""
    image = _eight_bits(image)
    image = cv2.cvtColor(image, cv2.COLOR_RGB2BGR if image.shape[-1] == 3 else cv2.COLOR_RGBA2BGRA)
    done, data = cv2.imencode(".webp", image, [cv2.IMWRITE_WEBP_QUALITY, quality])
    assert done
    return data.tobytes()


def _eight_bits(image: np.ndarray) -> np.ndarray:
    if image.dtype == np.uint8:
        return image
    found: np.ndarray = np.rint(np.clip(image, 0, 1) * 255).astype(np.uint8)
    return found


def thumbnail(image: np.ndarray, width: int) -> np.ndarray:
    """An RGB image (H, W, 3) at another width, as uint8."""
    image = _eight_bits(image)
    height = max(1, round(image.shape[0] * width / image.shape[1]))
    return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)


def colored_distance(
    distance: np.ndarray, valid: np.ndarray, near_far: tuple[float, float] | None = None
) -> np.ndarray:
    """Log distance as colours (H, W, 3) uint8: yellow near, violet far, black where invalid. The range is the valid
    pixels' 1st to 99th percentile unless given."""
    valid = valid & (distance > 0) & np.isfinite(distance)
    if not valid.any():
        return np.zeros((*distance.shape, 3), np.uint8)
    log = np.log(np.where(valid, distance, 1))
    low, high = np.log(near_far) if near_far else np.quantile(log[valid], (0.01, 0.99))
    level = 255 * (1 - np.clip((log - low) / max(high - low, 1e-6), 0, 1))
    colors = _viridis(level)
    return np.where(valid[..., None], colors, 0).astype(np.uint8)


def _viridis(level: np.ndarray) -> np.ndarray:
    """RGB uint8 of levels (h, w) from 0, violet, to 255, yellow."""
    return cv2.cvtColor(cv2.applyColorMap(level.astype(np.uint8), cv2.COLORMAP_VIRIDIS), cv2.COLOR_BGR2RGB)


def level_colors(shares: np.ndarray) -> np.ndarray:
    """Colours (n, 3) in [0, 1] of shares (n,) in [0, 1]: violet low, yellow high."""
    found: np.ndarray = _viridis(np.rint(255 * np.clip(shares, 0, 1))[:, None])[:, 0] / 255
    return found


def signed_colors(level: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Errors (H, W), of which -1 and 1 have the full colour, as colours (H, W, 3) uint8: white right, red above 0, blue
    below, grey where nothing is known."""
    level = np.clip(level, -1, 1)[..., None]
    red, blue = np.array([200, 20, 20]), np.array([20, 60, 200])
    colors = np.where(level > 0, 255 + level * (red - 255.0), 255 - level * (blue - 255.0))
    return np.where(known[..., None], colors, 120).astype(np.uint8)


def uncertainty_colors(sigma: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Standard deviations of log distance (H, W) as colours (H, W, 3) uint8: violet sure, yellow unsure, black where
    nothing is known."""
    known = valid & np.isfinite(sigma)
    level = np.where(known, sigma, 0) / UNSURE
    colors = np.rint(255 * level_colors(level.ravel())).reshape(*level.shape, 3)
    return np.where(known[..., None], colors, 0).astype(np.uint8)


def normal_colors(normals: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Unit normals (H, W, 3) in camera axes as colours uint8: red to the right, green up, blue towards the camera;
    black where there is none."""
    known = valid & np.isfinite(normals).all(-1)
    colors = 127.5 * (1 + np.where(known[..., None], normals, 0) * [1, -1, -1])
    return np.where(known[..., None], np.rint(colors), 0).astype(np.uint8)


def marked_points(
    image: np.ndarray, groups: Sequence[tuple[np.ndarray, tuple[int, int, int]]], width: int = 480
) -> np.ndarray:
    """The image with dots at pixels (n, 2) of each group in its colour."""
    small = thumbnail(image, width)
    scale = width / image.shape[1]
    for pixels, color in groups:
        for u, v in pixels * scale:
            cv2.circle(small, (round((u - 0.5) * 16), round((v - 0.5) * 16)), 2 * 16, color, -1, cv2.LINE_AA, shift=4)
    return small


def side_by_side(images: Sequence[np.ndarray], gap: int = 6) -> np.ndarray:
    """Images of one height in a row, with white between them."""
    height = min(image.shape[0] for image in images)
    cells = []
    for image in images:
        if image.shape[0] != height:
            image = cv2.resize(image, (round(image.shape[1] * height / image.shape[0]), height))
        cells += [image, np.full((height, gap, 3), 255, np.uint8)]
    return np.concatenate(cells[:-1], 1)


def contact_sheet(
    pictures: Sequence[np.ndarray],
    labels: Sequence[str],
    colors: Sequence[tuple[int, int, int]] | None = None,
    columns: int = 8,
    width: int = 160,
) -> np.ndarray:
    """Pictures (h, w, 3) as thumbnails in rows on white, each framed in its colour with its label beneath."""
    small = [thumbnail(picture, width) for picture in pictures]
    height = max(picture.shape[0] for picture in small)
    edge, text, gap = 3, 16, 6
    cell_height, cell_width = height + 2 * edge + text + gap, width + 2 * edge + gap
    columns = min(columns, len(small))
    sheet = np.full((-(-len(small) // columns) * cell_height + gap, columns * cell_width + gap, 3), 255, np.uint8)
    for i, (picture, label) in enumerate(zip(small, labels, strict=True)):
        top, left = gap + i // columns * cell_height, gap + i % columns * cell_width
        bottom, right = top + picture.shape[0] + 2 * edge, left + width + 2 * edge
        sheet[top:bottom, left:right] = (190, 190, 190) if colors is None else colors[i]
        sheet[top + edge : bottom - edge, left + edge : right - edge] = picture
        where = (left + edge, bottom + text - 4)
        cv2.putText(sheet[:, :right], label, where, cv2.FONT_HERSHEY_SIMPLEX, 0.36, (60, 60, 60), 1, cv2.LINE_AA)
    return sheet


def chart(size: tuple[float, float] = (6.4, 3.0)) -> tuple[Any, Any]:
    """A matplotlib figure and axes that need no display."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    axes.spines[["top", "right"]].set_visible(False)
    return figure, axes


class Chart(bytes):
    """A PNG of lines and words on white, and of no image: a page that is dark shows it light on dark."""

    @property
    def width(self) -> int:
        """In pixels, as the PNG's header has it."""
        return int.from_bytes(self[16:20], "big")


def chart_png(figure: Any) -> Chart:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return Chart(buffer.getvalue())


@dataclass(frozen=True)
class MeshView:
    """What each pixel of a picture of a mesh sees, to be coloured in one way and another."""

    met: np.ndarray
    """(H, W) bool, whether a ray meets the mesh"""
    corners: np.ndarray
    """(k, 3), the vertices of the triangle that each of these k rays meets"""
    weights: np.ndarray
    """(k, 3), of the corners"""
    shade: np.ndarray
    """(k,), of light that comes from the camera"""

    @classmethod
    def of(
        cls,
        vertices: np.ndarray,
        triangles: np.ndarray,
        size: tuple[int, int] = (640, 480),
        origin: np.ndarray | None = None,
        axes: np.ndarray | None = None,
        focal: float = 0.6,
    ) -> MeshView:
        """Of a mesh (vertices (n, 3), triangles (m, 3)) in a picture of `size` (W, H).

        From outside, obliquely, in parallel projection, unless `origin` (3,) and `axes` (3, 3; rows right, down,
        forward) put a pinhole of focal length `focal` times the width at a place of their own.
        """
        width, height = size
        if not len(triangles):
            return cls(np.zeros((height, width), bool), np.zeros((0, 3), int), np.zeros((0, 3)), np.zeros(0))
        # Rays are cast in single precision: near nought, and neither tiny nor huge, wherever the map lies.
        low, high = vertices.min(0), vertices.max(0)
        middle, extent = (low + high) / 2, float((high - low).max()) or 1.0
        vertices = (vertices - middle) / extent
        o3d = native.open3d()
        scene = o3d.t.geometry.RaycastingScene()
        scene.add_triangles(o3d.core.Tensor(vertices.astype(np.float32)), o3d.core.Tensor(triangles.astype(np.uint32)))
        u, v = np.meshgrid((np.arange(width) + 0.5) / width - 0.5, ((np.arange(height) + 0.5) - height / 2) / width)
        if origin is None or axes is None:
            origins, directions = _outside(vertices, u, v, height / width)
        else:
            directions = np.stack([u / focal, v / focal, np.ones_like(u)], -1) @ axes
            directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
            origins = np.broadcast_to((origin - middle) / extent, directions.shape)
        hit = scene.cast_rays(o3d.core.Tensor(np.concatenate([origins, directions], -1).astype(np.float32)))
        met = np.isfinite(hit["t_hit"].numpy())
        weights = hit["primitive_uvs"].numpy()[met]
        weights = np.concatenate([1 - weights.sum(-1, keepdims=True), weights], -1)
        shade = 0.35 + 0.65 * np.abs((hit["primitive_normals"].numpy()[met] * directions[met]).sum(-1))
        return cls(met, triangles[hit["primitive_ids"].numpy()[met]], weights, shade)

    def picture(self, colors: np.ndarray | None = None) -> np.ndarray:
        """(H, W, 3) uint8 on white, from colours (n, 3) in [0, 1] of the vertices; of the shape alone without them."""
        picture = np.full((*self.met.shape, 3), 255, np.uint8)
        color = PLAIN if colors is None else np.einsum("kci,kc->ki", colors[self.corners], self.weights)
        picture[self.met] = np.rint(255 * np.clip(color * self.shade[:, None], 0, 1))
        return picture

    def cutout(self, colors: np.ndarray | None = None) -> np.ndarray:
        """The same (H, W, 4), clear where there is no surface: for pages, which are light or dark."""
        return np.dstack([self.picture(colors), 255 * self.met.astype(np.uint8)])


def _outside(vertices: np.ndarray, u: np.ndarray, v: np.ndarray, aspect: float) -> tuple[np.ndarray, np.ndarray]:
    """Parallel rays onto the mesh's broad side, a little from above."""
    sample = vertices[:: max(1, len(vertices) // 20000)]
    middle = sample.mean(0)
    sample = sample - middle
    right, down, forward = outside_axes(vertices)
    place = sample @ np.stack([right, down, forward]).T
    low, high = np.quantile(place, (0.001, 0.999), axis=0)
    middle = middle + (low + high)[:2] / 2 @ np.stack([right, down])
    extent = 1.05 * max((high - low)[0], (high - low)[1] / aspect)
    behind = 2 * float(np.abs(place[:, 2]).max()) + 0.1  # of a flat mesh too the rays begin before it
    origins = middle + extent * (u[..., None] * right + v[..., None] * down) - behind * forward
    return origins, np.broadcast_to(forward, origins.shape)


def outside_axes(vertices: np.ndarray) -> np.ndarray:
    """Axes (3, 3; rows right, down, forward) of a look at the broad side of vertices (n, 3), a little from above."""
    sample = vertices[:: max(1, len(vertices) // 20000)]
    axes = np.linalg.svd(sample - sample.mean(0), full_matrices=False)[2]
    axes *= np.sign(axes[range(3), np.abs(axes).argmax(1)])[:, None]  # else rounding decides which side is seen
    long, across, thin = axes
    forward = thin + 0.45 * across
    forward /= np.linalg.norm(forward)
    return np.stack([long, np.cross(forward, long), forward])
