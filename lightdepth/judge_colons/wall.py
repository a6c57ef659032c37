"""The wall of a colon as a triangle mesh: a bent lumen with haustra, folds that lean, narrowings and polyps.

The centre line c(s) bends by smooth curvature, with one flexure. Its cross-section has three corners, where the taeniae
run; between folds it bulges. A fold k is a crescent of height h_k over an arc of phi, whose lip leans along the line,
so that it hides what lies behind it:

    x(s, phi) = c(s) + (R(s, phi) - sum_k h_k A_k(phi) G_k(s)) e(s, phi) + sum_k lean_k h_k A_k G_k t(s)

with e the direction from the centre line and t its tangent. The lumen ends in a cap at either side: light is lost
nowhere. Polyps are closed bodies of their own that stand in the wall.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

STEP_MM = 0.5
AROUND = 224
"""Vertices around the lumen."""
LENGTH_MM = 230.0


@dataclass(frozen=True, eq=False)
class Mesh:
    """Vertices (n, 3) float32 [mm] with unit normals (n, 3), a place (n, 2) in the skin's picture, in [0, 1], and a
    tint (n, 3) of it; triangles (m, 3) uint32."""

    vertices: np.ndarray
    normals: np.ndarray
    places: np.ndarray
    tints: np.ndarray
    triangles: np.ndarray


@dataclass(frozen=True, eq=False)
class CentreLine:
    """Points (n, 3) [mm] every STEP_MM, and unit vectors (n, 3) along it and, twice, across it, turning least."""

    points: np.ndarray
    along: np.ndarray
    side: np.ndarray
    up: np.ndarray

    def at(self, s: float) -> tuple[np.ndarray, np.ndarray]:
        """The point at arc length s, and the axes (3, 3) there, in columns: side, up, along."""
        i = min(max(s / STEP_MM, 0.0), len(self.points) - 1.001)
        k, f = int(i), i - int(i)
        mixed = [(1 - f) * a[k] + f * a[k + 1] for a in (self.points, self.side, self.up, self.along)]
        axes = np.stack(mixed[1:], 1)
        return mixed[0], axes / np.linalg.norm(axes, axis=0)


@dataclass(frozen=True, eq=False)
class Colon:
    """A wall, its centre line, and the radius (n,) [mm] of the free lumen along this."""

    mesh: Mesh
    line: CentreLine
    free: np.ndarray


def centre_line(rng: np.random.Generator, radius: float, length: float = LENGTH_MM) -> CentreLine:
    """Curvature drawn smooth, never so strong that a lumen of this radius folds over itself; one flexure."""
    count = round(length / STEP_MM) + 1
    s = np.arange(count) * STEP_MM
    curvature = np.zeros((count, 2))
    for axis in range(2):
        for period in (60.0, 110.0, 190.0):
            size = rng.normal() * 0.0055
            curvature[:, axis] += size * np.sin(2 * np.pi * s / period + rng.uniform(0, 2 * np.pi))
    middle, width, angle = rng.uniform(0.55, 0.8) * length, rng.uniform(14, 20), rng.uniform(0, 2 * np.pi)
    sharp = rng.uniform(0.7, 1.4) / (width * np.sqrt(2 * np.pi))  # radians that it turns by, over its length
    curvature += sharp * np.exp(-0.5 * ((s - middle) / width) ** 2)[:, None] * [np.cos(angle), np.sin(angle)]
    size = np.linalg.norm(curvature, axis=1, keepdims=True)
    most = 0.6 / (1.25 * radius)
    curvature *= most * np.tanh(size / most) / np.maximum(size, 1e-9)
    frame, frames = np.eye(3), []
    for a, b in curvature:
        frames.append(frame)
        turn = STEP_MM * (a * frame[:, 0] + b * frame[:, 1])
        along = frame[:, 2] + turn
        along /= np.linalg.norm(along)
        side = frame[:, 0] - along * (frame[:, 0] @ along)
        side /= np.linalg.norm(side)
        frame = np.stack([side, np.cross(along, side), along], 1)
    axes = np.stack(frames)
    points = np.cumsum(STEP_MM * axes[:, :, 2], 0)
    return CentreLine(points, axes[:, :, 2], axes[:, :, 0], axes[:, :, 1])


def _folds(
    rng: np.random.Generator, radius: np.ndarray, s: np.ndarray, phi: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """How far the folds reach inwards, and along the line, (n, m) [mm] each, and where they stand (k,) [mm]."""
    inwards, forward = np.zeros((2, len(s), len(phi)))
    places: list[float] = []
    middle, turn = rng.uniform(10, 18), rng.uniform(0, 2 * np.pi)
    hiding = rng.integers(3, 7)
    while middle < s[-1] - 8:
        hides = len(places) == hiding
        local = float(np.interp(middle, s, radius))
        height = local * (rng.uniform(0.52, 0.66) if hides else rng.uniform(0.12, 0.46))
        half = rng.uniform(1.1, 1.6) if hides or rng.random() < 0.6 else rng.uniform(2.4, 3.6)
        centre = turn + rng.integers(3) * 2 * np.pi / 3 + rng.normal() * 0.25
        off = np.abs(np.angle(np.exp(1j * (phi - centre))))
        arc = 0.5 * (1 + np.cos(np.pi * np.clip(off / half, 0, 1))) if half < np.pi else 0.7 + 0.3 * np.cos(off)
        wave = rng.normal() * 1.8 * np.sin(phi + rng.uniform(0, 6.3)) + rng.normal() * 0.7 * np.sin(3 * phi + centre)
        thick = rng.uniform(1.3, 2.6)
        across = (s[:, None] - middle - wave) / thick
        ridge = np.exp(-(np.abs(across) ** rng.uniform(1.3, 2.2))) * arc
        inwards += height * ridge
        forward += height * ridge**2 * rng.uniform(0.35, 0.6) * (1 if hides else rng.choice([-0.6, 0.2, 0.7]))
        places.append(middle)
        middle += rng.uniform(9, 24)
    return inwards, forward, np.array(places)


def _smooth(rng: np.random.Generator, s: np.ndarray, phi: np.ndarray, length: float) -> np.ndarray:
    """A random smooth field (n, m) of deviation 1 whose bumps have about this length [mm], periodic in phi."""
    field = np.zeros((len(s), len(phi)))
    for _ in range(14):
        around = int(rng.integers(0, max(2, round(110 / length))))
        waves = rng.normal() * 2 * np.pi / (2 * length)
        field += np.sin(waves * s[:, None] + around * phi + rng.uniform(0, 2 * np.pi))
    return np.asarray(field / np.sqrt(7))


def make_wall(rng: np.random.Generator) -> Colon:
    """A colon, drawn by `rng`."""
    radius = rng.uniform(13, 23)
    line = centre_line(rng, radius)
    s = np.arange(len(line.points)) * STEP_MM
    phi = np.linspace(0, 2 * np.pi, AROUND + 1)
    along = np.full(len(s), radius)
    for _ in range(2):  # narrowings
        depth, width = rng.uniform(0.15, 0.42), rng.uniform(6, 16)
        along = along * (1 - depth * np.exp(-0.5 * ((s - rng.uniform(0.2, 0.9) * s[-1]) / width) ** 2))
    along = along * (1 + 0.08 * np.sin(2 * np.pi * s / rng.uniform(50, 90) + rng.uniform(0, 6.3)))
    inwards, forward, places = _folds(rng, along, s, phi)
    twist = rng.uniform(0, 2 * np.pi) + 0.004 * s * rng.normal()
    corners = 1 + rng.uniform(0.03, 0.09) * np.cos(3 * (phi - twist[:, None]))
    gap = np.abs(s[:, None] - places).min(1)  # haustra bulge between folds
    bulge = rng.uniform(0.5, 2.0) * np.tanh(gap / 4)[:, None]
    reach = along[:, None] * corners + bulge
    reach = reach + 0.45 * _smooth(rng, s, phi, 12) + 0.12 * _smooth(rng, s, phi, 4)
    reach = np.maximum(reach - inwards, 0.16 * along[:, None])
    end = np.minimum(s, s[-1] - s) / (0.8 * radius)
    reach = reach * np.sqrt(np.clip(1 - (1 - np.clip(end, 0, 1)) ** 2, 0, 1))[:, None]
    outward = np.cos(phi)[None, :, None] * line.side[:, None] + np.sin(phi)[None, :, None] * line.up[:, None]
    vertices = line.points[:, None] + reach[..., None] * outward + forward[..., None] * line.along[:, None]
    places_of = np.stack(np.broadcast_arrays(s[:, None] / s[-1], phi / (2 * np.pi)), -1)
    mesh = _grid(vertices, places_of)
    bodies = [_polyp(rng, mesh, len(s), radius) for _ in range(int(rng.integers(2, 6)))]
    return Colon(_joined([mesh, *bodies]), line, reach[:, :-1].min(1))


def _grid(vertices: np.ndarray, places: np.ndarray) -> Mesh:
    """A mesh of a grid (n, m, 3) whose last column lies on its first; normals face the lumen."""
    rows, columns = vertices.shape[:2]
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    triangles = np.concatenate([np.stack(t, -1).reshape(-1, 3) for t in ((a, b, c), (a, c, d))])
    flat = vertices.reshape(-1, 3)
    normals = _summed(flat, triangles).reshape(rows, columns, 3)
    normals[:, 0] += normals[:, -1]
    normals[:, -1] = normals[:, 0]
    return Mesh(flat, _unit(normals.reshape(-1, 3)), places.reshape(-1, 2), np.ones((len(flat), 3)), triangles)


def _summed(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    corner = vertices[triangles]
    flat = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    summed = np.zeros(vertices.shape)
    for k in range(3):
        for axis in range(3):
            summed[:, axis] += np.bincount(triangles[:, k], flat[:, axis], len(vertices))
    return summed


def _unit(vectors: np.ndarray) -> np.ndarray:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12))


def _polyp(rng: np.random.Generator, wall: Mesh, rows: int, radius: float) -> Mesh:
    """A sessile or stalked body, standing in the wall with its foot."""
    row = int(rng.uniform(0.12, 0.9) * rows)
    at = row * (AROUND + 1) + int(rng.integers(AROUND))
    foot, axis = wall.vertices[at], wall.normals[at]
    size = rng.uniform(0.09, 0.22) * radius
    stalked = rng.random() < 0.35
    side = _unit(np.cross(axis, [0.3, 0.5, 0.8]))
    theta, angle = np.linspace(0, np.pi, 40)[:, None], np.linspace(0, 2 * np.pi, 64)[None]
    lobes = 1 + 0.07 * np.cos(3 * angle + rng.uniform(0, 6.3)) * np.sin(theta) ** 2
    lobes = lobes + 0.05 * np.sin(5 * theta + 2 * angle + rng.uniform(0, 6.3)) * np.sin(theta) ** 2
    flat = rng.uniform(0.65, 1.0)
    out = size * lobes * np.sin(theta)
    up = size * (flat * lobes * np.cos(theta))
    lift = size * (rng.uniform(0.9, 1.4) if stalked else rng.uniform(0.05, 0.35))
    if stalked:  # the lower half is drawn out into a stalk
        lower = np.clip(-np.cos(theta), 0, 1)
        out = out * (1 - 0.62 * lower**0.5)
        up = up - 1.4 * size * lower**1.5
    points = foot + (lift + up)[..., None] * axis
    points = points + (out * np.cos(angle))[..., None] * side + (out * np.sin(angle))[..., None] * np.cross(axis, side)
    here = wall.places[at] + 0.02 * np.stack(np.broadcast_arrays(np.cos(theta), np.sin(angle) * np.sin(theta)), -1)
    body = _grid(points, np.clip(here, 0.001, 0.999))
    outwards = np.einsum("ij,ij->i", body.normals, body.vertices - body.vertices.mean(0)).sum() > 0
    normals, triangles = (body.normals, body.triangles) if outwards else (-body.normals, body.triangles[:, ::-1])
    tint = np.array([1.06, rng.uniform(0.72, 0.92), rng.uniform(0.72, 0.92)])
    return Mesh(body.vertices, normals, body.places, np.broadcast_to(tint, normals.shape), triangles)


def _joined(parts: list[Mesh]) -> Mesh:
    offsets = np.cumsum([0, *(len(p.vertices) for p in parts)])

    def all_of(name: str) -> np.ndarray:
        return np.concatenate([getattr(part, name) for part in parts]).astype(np.float32)

    triangles = np.concatenate([p.triangles + o for p, o in zip(parts, offsets, strict=False)]).astype(np.uint32)
    return Mesh(all_of("vertices"), all_of("normals"), all_of("places"), all_of("tints"), triangles)
