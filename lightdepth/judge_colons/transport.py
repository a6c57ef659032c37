"""Light from the lamps to the lens: straight, by way of other wall (paths drawn at random), and mirrored by the film.

The wall scatters by a Lambertian lobe under a film of water, which mirrors by a GGX lobe:

    f(i, o) = rho / pi · (1 - F(i)) (1 - F(o))  +  D G F / (4 cos_i cos_o)

    E(x) = sum over lamps, where one is seen, of I cos / |x - P|²   +   E_indirect(x)
    L(x) = f E

E_indirect is the mean over paths that leave x by the cosine law: at each wall that a path meets, one lamp is asked
(next event), and the path goes on with the probability of the largest channel of rho (Russian roulette). On the way
walls are Lambertian with reflectance rho: what the film mirrors of light that comes from other wall is scattered evenly
instead, which keeps the energy and spares the caustics. As the lens sees it, the film mirrors other wall too
(`mirrored`).

The indirect irradiance varies slowly. It is found at places spread over the image and read in between by those nearest
in place and direction of the wall.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from lightdepth import native
from lightdepth.judge_colons.lamps import Lamp
from lightdepth.judge_colons.skin import Skin
from lightdepth.judge_colons.wall import Mesh

F0 = 0.025
"""Share of light that a film of water mirrors straight on."""
_LIFT_MM = 5e-3  # rays start so far off the wall
_LONGEST = 64  # bounces


@dataclass(frozen=True, eq=False)
class Hits:
    """Where rays meet the wall, (n, ...) float32: distance [mm] (infinite where none does), point, geometric and
    shading normal towards where the ray came from, reflectance (n, 3), slopes of the film (n, 2)."""

    distance: np.ndarray
    point: np.ndarray
    facet: np.ndarray
    normal: np.ndarray
    reflectance: np.ndarray
    slopes: np.ndarray

    @property
    def met(self) -> np.ndarray:
        met: np.ndarray = np.isfinite(self.distance)
        return met

    def at(self, chosen: np.ndarray) -> Hits:
        """The chosen of them, by index or mask."""
        return Hits(*(getattr(self, name)[chosen] for name in self.__dataclass_fields__))

    @property
    def lifted(self) -> np.ndarray:
        result: np.ndarray = self.point + _LIFT_MM * self.facet
        return result


class Scene:
    """A mesh under a skin that rays are cast at (Embree)."""

    def __init__(self, mesh: Mesh, skin: Skin) -> None:
        self._core = native.open3d().core
        self._scene = native.open3d().t.geometry.RaycastingScene()
        tensor = self._core.Tensor
        self._scene.add_triangles(
            tensor(np.ascontiguousarray(mesh.vertices)), tensor(np.ascontiguousarray(mesh.triangles))
        )
        self.mesh, self.skin = mesh, skin

    def cast(self, origins: np.ndarray, directions: np.ndarray) -> Hits:
        """The first wall along unit directions (n, 3) from origins (n, 3)."""
        rays = np.concatenate([origins, directions], -1).astype(np.float32)
        found = self._scene.cast_rays(self._core.Tensor(rays))
        distance = found["t_hit"].numpy()
        met = np.isfinite(distance)
        uv = np.where(met[:, None], found["primitive_uvs"].numpy(), 0)
        corners = self.mesh.triangles[np.where(met, found["primitive_ids"].numpy(), 0)]
        weights = np.stack([1 - uv.sum(-1), uv[:, 0], uv[:, 1]], -1).astype(np.float32)

        def mixed(values: np.ndarray) -> np.ndarray:
            return np.asarray(sum(weights[:, k, None] * values[corners[:, k]] for k in range(3)))

        facet = _unit(found["primitive_normals"].numpy())
        facet = facet * np.where((facet * rays[:, 3:]).sum(-1) > 0, -1, 1)[:, None].astype(np.float32)
        normal = _unit(mixed(self.mesh.normals))
        normal = normal * np.where((normal * facet).sum(-1) < 0, -1, 1)[:, None].astype(np.float32)
        places = mixed(self.mesh.places)
        rho = np.minimum(self.skin.looked_up(self.skin.reflectance, places) * mixed(self.mesh.tints), 0.97)
        point = rays[:, :3] + np.where(met, distance, 0)[:, None] * rays[:, 3:]
        return Hits(distance, point, facet, normal, rho, self.skin.looked_up(self.skin.slopes, places))

    def seen(self, origins: np.ndarray, targets: np.ndarray) -> np.ndarray:
        """Whether nothing lies between origins (n, 3) and targets (n, 3)."""
        rays = np.concatenate([origins, targets - origins], -1).astype(np.float32)
        return ~np.asarray(self._scene.test_occlusions(self._core.Tensor(rays), tnear=0.0, tfar=1 - 1e-4).numpy())

    def clearance(self, points: np.ndarray) -> np.ndarray:
        """Distance (n,) [mm] of points (n, 3) from the wall."""
        return np.asarray(self._scene.compute_distance(self._core.Tensor(points.astype(np.float32))).numpy())


@dataclass(frozen=True, eq=False)
class Lit:
    """Lamps in the world, carried by a camera of this pose (4, 4)."""

    lamps: Sequence[Lamp]
    world_from_cam: np.ndarray

    def place(self, lamp: Lamp) -> np.ndarray:
        return np.asarray(self.world_from_cam[:3, :3] @ lamp.position + self.world_from_cam[:3, 3], np.float32)

    def falls(self, scene: Scene, hits: Hits, lamp: Lamp) -> tuple[np.ndarray, np.ndarray]:
        """Irradiance (n,) by one lamp on a wall that faces it, shadows included, and unit directions to it (n, 3)."""
        off = self.place(lamp) - hits.point
        square = np.square(off).sum(-1)
        towards = off / np.sqrt(square)[:, None]
        in_camera = -towards @ self.world_from_cam[:3, :3].astype(np.float32)
        faces = ((towards * hits.facet).sum(-1) > 0) & hits.met
        arrives = np.zeros(len(off), np.float32)
        asked = np.flatnonzero(faces)
        open_ = asked[scene.seen(hits.lifted[asked], np.broadcast_to(self.place(lamp), (len(asked), 3)))]
        arrives[open_] = (lamp.shone(in_camera[open_]) / square[open_]).astype(np.float32)
        return arrives, towards


def direct(scene: Scene, hits: Hits, lit: Lit) -> np.ndarray:
    """Irradiance (n,) straight from the lamps, of a Lambertian wall."""
    total = np.zeros(len(hits.distance), np.float32)
    for lamp in lit.lamps:
        arrives, towards = lit.falls(scene, hits, lamp)
        total += arrives * np.maximum((towards * hits.normal).sum(-1), 0)
    return total


def indirect(scene: Scene, hits: Hits, lit: Lit, rng: np.random.Generator, side: int = 12) -> np.ndarray:
    """Irradiance (n, 3) by way of other wall, the mean of side² paths whose first directions are stratified."""
    total = np.zeros((len(hits.distance), 3), np.float64)
    cells = (np.stack(np.meshgrid(np.arange(side), np.arange(side)), -1).reshape(-1, 2)) / side
    count, step = len(hits.distance), max(1, 60_000 // side**2)
    for start in range(0, count, step):
        chosen = np.arange(start, min(start + step, count))
        drawn = cells[None] + rng.random((len(chosen), len(cells), 2)) / side
        row = np.repeat(chosen, len(cells))
        away = _by_cosine(hits.normal[row], drawn.reshape(-1, 2))
        came = incoming(scene, hits.lifted[row], away, lit, rng)
        below = (away * hits.facet[row]).sum(-1) <= 0
        came[below] = 0
        total[chosen] = np.pi * came.reshape(len(chosen), len(cells), 3).mean(1)
    return total


def incoming(scene: Scene, origins: np.ndarray, away: np.ndarray, lit: Lit, rng: np.random.Generator) -> np.ndarray:
    """An estimate (n, 3) of the radiance that comes from unit directions `away` (n, 3), one path each."""
    total = np.zeros((len(away), 3))
    alive, carried = np.arange(len(away)), np.ones((len(away), 3))
    for _ in range(_LONGEST):
        hits = scene.cast(origins, away)
        kept = hits.met
        hits, alive, carried = hits.at(kept), alive[kept], carried[kept]
        if not len(alive):
            break
        total[alive] += carried * hits.reflectance / np.pi * _asked(scene, hits, lit, rng)[:, None]
        carried = carried * hits.reflectance
        goes_on = carried.max(-1).clip(0, 1)
        kept = rng.random(len(alive)) < goes_on
        hits, alive = hits.at(kept), alive[kept]
        carried = carried[kept] / goes_on[kept, None]
        away = _by_cosine(hits.normal, rng.random((len(alive), 2)))
        inside = (away * hits.facet).sum(-1) > 0
        hits, alive, carried, away = hits.at(inside), alive[inside], carried[inside], away[inside]
        origins = hits.lifted
    return total


def _asked(scene: Scene, hits: Hits, lit: Lit, rng: np.random.Generator) -> np.ndarray:
    """Irradiance (n,) from the lamps, each point asking one of them at random."""
    which = rng.integers(len(lit.lamps), size=len(hits.distance))
    found = np.zeros(len(which), np.float32)
    for i, lamp in enumerate(lit.lamps):
        mine = np.flatnonzero(which == i)
        arrives, towards = lit.falls(scene, hits.at(mine), lamp)
        found[mine] = len(lit.lamps) * arrives * np.maximum((towards * hits.normal[mine]).sum(-1), 0)
    return found


def spread_over(known: Hits, values: np.ndarray, asked: Hits, turn_mm: float = 6.0) -> np.ndarray:
    """Values (n, c) known at some hits read at others (m, c): of the nearest eight, weighted by nearness in place and,
    `turn_mm` to the radian, in direction of the wall."""
    tree = cKDTree(np.concatenate([known.point, turn_mm * known.normal], -1))
    off, row = tree.query(np.concatenate([asked.point, turn_mm * asked.normal], -1), k=min(8, len(values)))
    off, row = off.reshape(len(off), -1), row.reshape(len(row), -1)
    weight = 1 / (np.square(off) + (0.35 * off[:, -1:]) ** 2 + 1e-6)
    return np.asarray((weight[..., None] * values[row]).sum(1) / weight.sum(1, keepdims=True))


def fresnel(cosine: np.ndarray) -> np.ndarray:
    """Schlick's share of light that is mirrored."""
    return np.asarray(F0 + (1 - F0) * (1 - np.clip(cosine, 0, 1)) ** 5)


def matt_lobe(rho: np.ndarray, to_light: np.ndarray, to_lens: np.ndarray) -> np.ndarray:
    """The Lambertian lobe (n, c) under the film, of reflectance (n, c); cosines (n,)."""
    return np.asarray(rho / np.pi * ((1 - fresnel(to_light)) * (1 - fresnel(to_lens)))[:, None])


def film_lobe(normal: np.ndarray, towards: np.ndarray, lens: np.ndarray, roughness: float) -> np.ndarray:
    """GGX (n,) of the film with this normal, for unit directions to the light and to the lens (n, 3) each."""
    half = _unit(towards + lens)
    to_light, to_lens, tilt = ((normal * v).sum(-1) for v in (towards, lens, half))
    a2 = roughness**2
    peak = a2 / (np.pi * np.square(np.clip(tilt, 0, 1) ** 2 * (a2 - 1) + 1))
    i, o = np.maximum(to_light, 1e-4), np.maximum(to_lens, 1e-4)
    visible = 0.5 / (o * np.sqrt(a2 + (1 - a2) * i * i) + i * np.sqrt(a2 + (1 - a2) * o * o))
    found = peak * visible * fresnel((half * lens).sum(-1))
    return np.asarray(np.where((to_light > 0) & (to_lens > 0), found, 0))


def film_normal(hits: Hits) -> np.ndarray:
    """The normal (n, 3) of the rippled film."""
    side = _unit(np.cross(hits.normal, np.array([0.31, 0.64, 0.70], np.float32)))
    across = np.cross(hits.normal, side)
    return _unit(hits.normal + hits.slopes[:, :1] * side + hits.slopes[:, 1:] * across)


def mirrored(scene: Scene, hits: Hits, lens: np.ndarray, lit: Lit, rng: np.random.Generator) -> np.ndarray:
    """Radiance (n, 3) of other wall that the film mirrors into unit directions `lens` (n, 3), one path each, drawn by
    the normals that are visible in GGX's lobe, so that its weight is at most 1."""
    normal = film_normal(hits)
    half = _facet_seen(normal, lens, scene.skin.roughness, rng)
    away = _unit(2 * (half * lens).sum(-1, keepdims=True) * half - lens)
    cosine = (normal * away).sum(-1)
    fine = (cosine > 0) & ((hits.facet * away).sum(-1) > 0) & hits.met
    found = np.zeros((len(lens), 3))
    found[fine] = incoming(scene, hits.lifted[fine], away[fine], lit, rng)
    a2, i = scene.skin.roughness**2, np.maximum(cosine, 1e-4)
    shadowed = 2 * i / (i + np.sqrt(a2 + (1 - a2) * i * i))
    return np.asarray(found * (fresnel((half * lens).sum(-1)) * shadowed)[:, None])


def _facet_seen(normal: np.ndarray, lens: np.ndarray, alpha: float, rng: np.random.Generator) -> np.ndarray:
    """Facets' normals (n, 3) as the lens sees them in GGX's lobe (Heitz 2018)."""
    x, y = _across(normal)
    v = np.stack([(lens * x).sum(-1), (lens * y).sum(-1), np.maximum((lens * normal).sum(-1), 1e-3)], -1)
    stretched = _unit(v * [alpha, alpha, 1.0])
    t1 = _unit(np.stack([-stretched[:, 1], stretched[:, 0], np.full(len(v), 1e-9)], -1))
    t2 = np.cross(stretched, t1)
    r, turn = np.sqrt(rng.random(len(v))), 2 * np.pi * rng.random(len(v))
    a, b, s = r * np.cos(turn), r * np.sin(turn), 0.5 * (1 + stretched[:, 2])
    b = (1 - s) * np.sqrt(np.maximum(1 - a * a, 0)) + s * b
    c = np.sqrt(np.maximum(1 - a * a - b * b, 0))
    found = a[:, None] * t1 + b[:, None] * t2 + c[:, None] * stretched
    local = _unit(np.stack([alpha * found[:, 0], alpha * found[:, 1], np.maximum(found[:, 2], 1e-6)], -1))
    return np.asarray(local[:, :1] * x + local[:, 1:2] * y + local[:, 2:] * normal)


def _across(normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors (n, 3) across each normal (n, 3)."""
    least = np.abs(normal[:, :1]) < 0.8
    x = _unit(np.cross(normal, np.where(least, [[1.0, 0, 0]], [[0, 1.0, 0]])))
    return x, np.cross(normal, x)


def _by_cosine(normal: np.ndarray, drawn: np.ndarray) -> np.ndarray:
    """Unit directions (n, 3) about normals (n, 3) by the cosine law, from numbers (n, 2) in [0, 1)."""
    x, y = _across(normal)
    radius, turn = np.sqrt(drawn[:, :1]), 2 * np.pi * drawn[:, 1:]
    up = np.sqrt(np.maximum(1 - drawn[:, :1], 0))
    found = radius * np.cos(turn) * x + radius * np.sin(turn) * y + up * normal
    return np.asarray(found, np.float32)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12))
