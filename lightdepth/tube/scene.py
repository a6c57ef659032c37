"""A synthetic colon that can be looked at: ray casting, and the light of lightdepth.photometry with what it leaves out.

A view has: direct light from a spot beside the camera, light from the wall to the wall (radiosity between patches of
the whole tube with true occlusion: not the approximation that the losses use), highlights on wet and rough wall, and
what lightdepth.tube.sensor makes of it. Lengths in millimetres; images (H, W, 3); patches are a coarse grid over
(s, phi). Every effect beyond the first colons' draws from a generator of its own: on or off, the rest stays the same
(but a wall of another circumference needs another sheet of paint).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import cv2
import numpy as np
import torch

from lightdepth import native
from lightdepth.camera import CameraModel
from lightdepth.photometry import PhotometricCalibration, irradiance
from lightdepth.radiosity import form_factors
from lightdepth.tube.film import FilmConfig, cover, fine_relief
from lightdepth.tube.path import PathConfig, image_flow
from lightdepth.tube.polyps import tinted
from lightdepth.tube.sensor import SensorConfig, draw_sensor, expose
from lightdepth.tube.shape import ShapeConfig, TubeShape, make_shape, smooth_noise
from lightdepth.tube.texture import TextureConfig, make_texture


@dataclass(frozen=True)
class TubeConfig:
    shape: ShapeConfig = field(default_factory=ShapeConfig)
    texture: TextureConfig = field(default_factory=TextureConfig)
    sensor: SensorConfig = field(default_factory=SensorConfig)
    film: FilmConfig = field(default_factory=FilmConfig)
    path: PathConfig = field(default_factory=PathConfig)
    patch: float = 3.5  # mm along s, of the patches that light each other
    least_cosine: float = 0.0  # normals interpolated across a fold's edge may look away: no further than this; 0 as is


def realistic() -> TubeConfig:
    """Colons with every effect, over ranges whose brightness behaves as in real frames and beyond on both sides
    (lightdepth.tube.exponents): what networks are trained on."""
    return TubeConfig(
        ShapeConfig(
            length=180.0,
            bend=(0.1, 1.4),
            fold_spacing=(10.0, 28.0),
            fold_depth=(0.12, 0.45),
            bump=(0.01, 0.06),
            crescent=(0.2, 1.0),
            waviness=(0.3, 1.8),
            taeniae=(0.0, 0.12),
            polyps=(0, 4),
        ),
        TextureConfig(
            hue=(-0.01, 0.055),
            saturation=(0.45, 0.8),
            value=(0.0, 0.15),
            vessels=(5, 40),
            vessel_width=(0.15, 0.6),
            vessel_value=(0.0, 0.3),
            vessel_strength=(0.2, 1.0),
            blotches=(0.0, 0.25),
            speckle=(0.0, 0.03),
        ),
        SensorConfig(
            gamma=(1.7, 2.6),
            mu=(1.3, 3.6),
            reflectance=(0.0, 0.7),
            specular=(0.0, 0.5),
            bright_share=(0.01, 0.35),
            shoulder=(0.7, 1.0),
            exposure=(0.05, 0.2),
            cosine_exponent=(0.8, 1.15),
            gloss=(30.0, 200.0),
            roughness=(0.02, 0.12),
            sparkle=(0.0, 0.3),
            vignetting=(0.0, 0.4),
            glare=(0.0, 0.06),
            bloom=(0.0, 0.15),
            motion=(0.0, 0.008),
            defocus=(0.0, 0.003),
            cast=(0.0, 0.06),
            contrast=(-0.1, 0.3),
            shot_noise=(0.0, 0.02),
            sharpen=(0.0, 0.6),
            jpeg=(60, 100),
        ),
        FilmConfig(mucus=(0.0, 0.35), bubbles=(0, 4), stool=(0, 12)),
        patch=4.4,
        least_cosine=0.08,
    )


def cavity() -> TubeConfig:
    """Hollows of any form, looked at from anywhere in any direction, under any light: what keeps a network that is
    taught by colons from taking every place for one. Walls, texture and sensor are those of `realistic`."""
    base = realistic()
    shape = ShapeConfig(
        length=110.0,
        radius=(8.0, 28.0),
        bend=(0.0, 1.6),
        fold_spacing=(10.0, 45.0),
        fold_depth=(0.0, 0.3),
        fold_width=(1.6, 6.0),
        bump=(0.06, 0.22),
        crescent=(0.5, 1.0),
        waviness=(0.3, 2.5),
        polyps=(0, 4),
    )
    path = PathConfig(sway=0.26, turned=(0.2, 1.6))
    return replace(base, shape=shape, path=path, sensor=replace(base.sensor, mu=(0.0, 3.6), gamma=(1.4, 2.6)))


@dataclass(frozen=True)
class View:
    """image (H, W, 3) encoded, in [0, 1]; distance (H, W) along the ray, 0 where no wall was met; normals (H, W, 3) in
    camera axes."""

    image: np.ndarray
    distance: np.ndarray
    normals: np.ndarray


class Tube:
    """One colon and one endoscope in it, drawn from `config` by `rng`."""

    def __init__(self, config: TubeConfig, rng: np.random.Generator, light: PhotometricCalibration | None = None):
        o3d = native.open3d()
        film_rng, surface_rng, sensor_rng, tint_rng = rng.spawn(4)
        self.shape: TubeShape = self._make_shape(config.shape, rng)
        rings, spokes = self.shape.vertices.shape[:2]
        circumference = 2 * np.pi * float(self.shape.radius.mean())
        albedo = self._make_texture(rings * self.shape.step, circumference, config.texture, rng)
        albedo = tinted(albedo, self.shape.polyps, self.shape.radius, spokes, self.shape.step, tint_rng)
        self.albedo, self.film = cover(albedo, config.texture.resolution, config.film, film_rng)
        self._bumps = [smooth_noise((rings * 2, spokes * 2), (0.9, 0.9), rng).astype(np.float32) for _ in range(2)]
        sensor = config.sensor
        self.light = _draw_light(sensor, rng)
        if light is not None:
            self.light = replace(light, reflectance=light.reflectance or self.light.reflectance)
        self.specular = rng.uniform(*sensor.specular)
        self.sensor = draw_sensor(sensor, self.light.gamma, rng, sensor_rng)
        self.cosine_exponent = surface_rng.uniform(*sensor.cosine_exponent)
        self.gloss, self.roughness = surface_rng.uniform(*sensor.gloss), surface_rng.uniform(*sensor.roughness)
        self.sparkle = surface_rng.uniform(*sensor.sparkle)
        self._relief = fine_relief(surface_rng) if self.sparkle > 0 else None
        self._scene = o3d.t.geometry.RaycastingScene(nthreads=1)
        self._tensor = lambda array: o3d.core.Tensor(np.ascontiguousarray(array, np.float32))
        self._scene.add_triangles(
            self._tensor(self.shape.vertices.reshape(-1, 3)), o3d.core.Tensor(self.shape.faces.astype(np.uint32))
        )
        self._least_cosine, self._patch = config.least_cosine, config.patch
        self._patches = self._make_patches()

    _make_shape = staticmethod(make_shape)
    _make_texture = staticmethod(make_texture)
    _expose = staticmethod(expose)

    def view(self, world_from_cam: np.ndarray, camera: CameraModel, mask: np.ndarray, rng: np.random.Generator) -> View:
        """What the endoscope sees from a pose (4, 4) [mm]; pixels outside mask (H, W) are black."""
        (own,) = rng.spawn(1)
        rays, rays_valid = camera.rays()
        wanted = mask & rays_valid
        directions = rays[wanted] @ world_from_cam[:3, :3].T
        origin = np.broadcast_to(world_from_cam[:3, 3], directions.shape)
        hit = self._scene.cast_rays(self._tensor(np.concatenate([origin, directions], -1)))
        t = hit["t_hit"].numpy()
        met = np.isfinite(t)
        ring, spoke = self._grid_position(hit["primitive_ids"].numpy()[met], hit["primitive_uvs"].numpy()[met])
        normals = _bilinear(self.shape.normals.astype(np.float32), ring, spoke)
        normals = normals / np.linalg.norm(normals, axis=-1, keepdims=True).clip(min=1e-9) @ world_from_cam[:3, :3]
        rows, columns = wanted.nonzero()
        index = (rows[met], columns[met])
        if self._least_cosine > 0:
            lacking = (self._least_cosine + (normals * rays[index]).sum(-1)).clip(min=0)
            normals = normals - lacking[:, None] * rays[index]
            normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
        distance = np.zeros(mask.shape, np.float32)
        distance[index] = t[met]
        all_normals = np.zeros((*mask.shape, 3), np.float32)
        all_normals[index] = normals
        linear = np.zeros((*mask.shape, 3))
        linear[index] = self._shade(t[met], normals, rays[index], ring, spoke, world_from_cam)
        flow = image_flow(distance, camera, self.sensor.motion, own) if self.sensor.motion > 0 else None
        image = self._expose(linear, distance > 0, rays[..., 2], flow, self.sensor, rng, own)
        return View(image, distance, all_normals)

    def distance_to_wall(self, points: np.ndarray) -> np.ndarray:
        """Exact distance (n,) [mm] from points (n, 3) to the mesh."""
        return self._scene.compute_distance(self._tensor(points)).numpy()

    def _grid_position(self, faces: np.ndarray, uvs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Continuous (ring, spoke) of hits; the spoke may reach the number of spokes, which is spoke 0 again."""
        spokes = self.shape.vertices.shape[1]
        cell, second = faces // 2, faces % 2 == 1
        i, j = (cell // spokes).astype(np.float32), (cell % spokes).astype(np.float32)
        w1, w2 = uvs[:, 0], uvs[:, 1]
        # Triangles (a, b, c) and (b, d, c) of a cell with a (0, 0), b (0, 1), c (1, 0), d (1, 1) as (ring, spoke).
        ring = i + np.where(second, w1 + w2, w2)
        spoke = j + np.where(second, 1 - w2, w1)
        return ring, spoke

    def _shade(
        self,
        t: np.ndarray,
        normals: np.ndarray,
        rays: np.ndarray,
        ring: np.ndarray,
        spoke: np.ndarray,
        world_from_cam: np.ndarray,
    ) -> np.ndarray:
        """Linear RGB (n, 3) with gain 1."""
        albedo = _bilinear(self.albedo, *self._to_map(ring, spoke, self.albedo))
        direct = self._direct(t, normals, rays)
        indirect = _bilinear(self._indirect(world_from_cam), *self._to_map(ring, spoke, self._patches.grid))
        linear = albedo * (direct[:, None] + indirect)
        if self.specular > 0:
            linear = linear + self._highlights(t, normals, rays, ring, spoke, world_from_cam)[:, None]
        return linear

    def _highlights(
        self,
        t: np.ndarray,
        normals: np.ndarray,
        rays: np.ndarray,
        ring: np.ndarray,
        spoke: np.ndarray,
        world_from_cam: np.ndarray,
    ) -> np.ndarray:
        """White light (n,) that the wet surface mirrors back."""
        slopes = [_bilinear(b[..., None], *self._to_map(ring, spoke, b))[:, 0] for b in self._bumps]
        # Towards the closed end the grid's cells shrink to a point: keep the bumps from becoming spokes there.
        row = np.clip(ring.astype(int), 0, len(self.shape.radius) - 1)
        flat = np.clip(self.shape.radius[row] / self.shape.radius.mean() - 0.3, 0, 0.7) / 0.7
        gloss: np.ndarray | float = self.gloss
        strength: np.ndarray | float = self.specular
        rough: np.ndarray | float = self.roughness
        film = self.film
        if film.wet is not None:  # mucus is smoother and shines more than the wall
            wet = _bilinear(film.wet[..., None], *self._to_map(ring, spoke, film.wet))[:, 0]
            gloss, strength, rough = gloss * (1 + wet), strength * (0.7 + wet), rough * (1 - 0.4 * wet)
        slopes = [slope * flat for slope in slopes]
        tilted = normals + (rough * np.stack([slopes[0], slopes[1], np.zeros_like(slopes[0])], 0)).T
        if self._relief is not None or film.slopes is not None:
            fine = np.zeros((len(t), 2), np.float32)
            if self._relief is not None:
                texels, spokes = 0.15, self.shape.vertices.shape[1]
                place = np.stack([ring * self.shape.step, spoke * 2 * np.pi * self.shape.radius.mean() / spokes], -1)
                u, v = np.round(place / texels).astype(int).T % len(self._relief)
                # Relief smaller than a pixel is averaged away.
                unresolved = 0.02 * t / texels
                fine += (self.sparkle * flat / np.sqrt(1 + unresolved**2))[:, None] * self._relief[u, v]
            if film.slopes is not None:
                fine += _bilinear(film.slopes, *self._to_map(ring, spoke, film.slopes))
            along_s = self.shape.frames[row, 0] @ world_from_cam[:3, :3]
            along_phi = np.cross(along_s, normals)
            tilted = tilted + fine[:, :1] * along_s + fine[:, 1:] * along_phi
        tilted /= np.linalg.norm(tilted, axis=-1, keepdims=True)
        lobe = np.clip((-rays * tilted).sum(-1), 0, 1) ** gloss
        return strength * lobe * self._direct(t, -rays, rays) * 4

    def _direct(self, t: np.ndarray, normals: np.ndarray, rays: np.ndarray) -> np.ndarray:
        def image(array: np.ndarray) -> torch.Tensor:
            return torch.from_numpy(np.ascontiguousarray(array.reshape(len(t), -1).T))[None, :, None, :].double()

        light = self.light.terms(torch.float64)
        return irradiance(image(t), image(normals), image(rays), light, self.cosine_exponent).numpy().ravel()

    def _to_map(self, ring: np.ndarray, spoke: np.ndarray, array: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mesh grid position -> position on another map over (s, phi)."""
        rings, spokes = self.shape.vertices.shape[:2]
        return ring * (array.shape[0] - 1) / (rings - 1), spoke * array.shape[1] / spokes

    def _make_patches(self) -> _Patches:
        rings, spokes = self.shape.vertices.shape[:2]
        n_s, n_phi = max(8, round(rings * self.shape.step / self._patch)), 22
        r = np.linspace(0, rings - 1, n_s)
        p = np.arange(n_phi) * spokes / n_phi
        ring, spoke = (a.ravel() for a in np.meshgrid(r, p, indexing="ij"))
        points = _bilinear(self.shape.vertices.astype(np.float32), ring, spoke)
        normals = _bilinear(self.shape.normals.astype(np.float32), ring, spoke)
        normals /= np.linalg.norm(normals, axis=-1, keepdims=True).clip(min=1e-9)
        grid = points.reshape(n_s, n_phi, 3)
        along_s = np.gradient(grid, axis=0)
        wrapped = np.concatenate([grid[:, -1:], grid, grid[:, :1]], 1)
        areas = np.linalg.norm(np.cross(along_s, (wrapped[:, 2:] - wrapped[:, :-2]) / 2), axis=-1).ravel()
        kernel = form_factors(
            *(torch.from_numpy(np.ascontiguousarray(a))[None].float() for a in (points, normals, areas))
        )
        factors = kernel[0].double().numpy()  # double, so that no bounce has to convert it
        # A patch cannot light what it does not see.
        i, j = np.nonzero(np.triu(factors + factors.T) > 1e-6)
        lifted = points + 0.4 * normals
        blocked = self._blocked(lifted[i], lifted[j])
        factors[i[blocked], j[blocked]] = factors[j[blocked], i[blocked]] = 0
        mean_albedo = cv2.resize(self.albedo, (n_phi, n_s), interpolation=cv2.INTER_AREA).reshape(-1, 3)
        return _Patches(np.zeros((n_s, n_phi)), points, normals, lifted, factors, mean_albedo)

    def _blocked(self, start: np.ndarray, end: np.ndarray) -> np.ndarray:
        rays = np.concatenate([start, end - start], -1)
        return self._scene.test_occlusions(self._tensor(rays), tnear=0.0, tfar=1.0).numpy()

    def _indirect(self, world_from_cam: np.ndarray) -> np.ndarray:
        """Light from the wall on every patch (n_s, n_phi, 3) float32: rho K E summed over the bounces, per colour."""
        patches = self._patches
        rotation, origin = world_from_cam[:3, :3], world_from_cam[:3, 3]
        in_cam = (patches.points - origin) @ rotation
        t = np.linalg.norm(in_cam, axis=-1).clip(min=1e-6)
        source = origin + rotation @ np.asarray(self.light.position_mm)
        lit = ~self._blocked(np.broadcast_to(source, patches.lifted.shape), patches.lifted)
        direct = self._direct(t, patches.normals @ rotation, in_cam / t[:, None]) * lit
        if self.light.reflectance == 0:
            return np.zeros((*patches.grid.shape, 3), np.float32)
        tint = self.light.reflectance * patches.albedo
        total = direct[:, None] * np.ones(3)
        for _ in range(6):
            bounced = patches.factors @ (tint * total)
            total = direct[:, None] + bounced
        return bounced.reshape(*patches.grid.shape, 3).astype(np.float32)


@dataclass(frozen=True)
class _Patches:
    grid: np.ndarray  # (n_s, n_phi), only its shape matters
    points: np.ndarray
    normals: np.ndarray
    lifted: np.ndarray
    factors: np.ndarray
    albedo: np.ndarray


def _draw_light(sensor: SensorConfig, rng: np.random.Generator) -> PhotometricCalibration:
    offset = rng.normal(0, sensor.light_offset / np.sqrt(2), 2)
    tilt = rng.normal(0, 0.03, 2)
    return PhotometricCalibration(
        gamma=rng.uniform(*sensor.gamma),
        mu=rng.uniform(*sensor.mu),
        position_mm=(float(offset[0]), float(offset[1]), 0.0),
        direction=(float(tilt[0]), float(tilt[1]), 1.0),
        reflectance=rng.uniform(*sensor.reflectance),
        source="published",
    )


def _bilinear(array: np.ndarray, row: np.ndarray, column: np.ndarray) -> np.ndarray:
    """Samples (n, C) of a map (R, C', C) at continuous rows and columns; columns wrap."""
    rows, columns = array.shape[:2]
    r0 = np.clip(np.floor(row).astype(int), 0, rows - 2)
    fr = np.clip(row - r0, 0, 1)[:, None].astype(np.float32)
    c0 = np.floor(column).astype(int)
    fc = (column - c0)[:, None].astype(np.float32)
    c0, c1 = c0 % columns, (c0 + 1) % columns
    flat = array.reshape(rows * columns, -1)
    first, second = r0 * columns + c0, r0 * columns + c1
    upper = flat.take(first, 0) * (1 - fc) + flat.take(second, 0) * fc
    lower = flat.take(first + columns, 0) * (1 - fc) + flat.take(second + columns, 0) * fc
    return upper * (1 - fr) + lower * fr
