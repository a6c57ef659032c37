"""A synthetic colon that can be looked at: ray casting, and the light of lightdepth.photometry with what it leaves out.

A view has: direct light from a spot beside the camera, light from the wall to the wall (radiosity between patches of
the whole tube with true occlusion: not the approximation that the losses use), highlights, a tone curve, clipping,
noise. Lengths in millimetres; images (H, W, 3); patches are a coarse grid over (s, phi).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import cv2
import numpy as np
import torch

from lightdepth import native
from lightdepth.camera import CameraModel
from lightdepth.photometry import PhotometricCalibration, encode, irradiance
from lightdepth.radiosity import form_factors
from lightdepth.tube.shape import ShapeConfig, TubeShape, make_shape, smooth_noise
from lightdepth.tube.texture import TextureConfig, make_texture


@dataclass(frozen=True)
class SensorConfig:
    """Light and camera of one endoscope; pairs are the ends of a uniform range."""

    gamma: tuple[float, float] = (2.0, 2.6)
    mu: tuple[float, float] = (2.2, 3.4)
    light_offset: float = 2.0  # mm, deviation of the light's position sideways
    reflectance: tuple[float, float] = (0.0, 0.7)
    specular: tuple[float, float] = (0.0, 0.5)
    bright_share: tuple[float, float] = (0.03, 0.2)  # share of pixels that auto exposure lets saturate
    shoulder: tuple[float, float] = (0.75, 1.0)  # code value at which the tone curve starts to bend
    noise: tuple[float, float] = (0.003, 0.012)  # deviation in code values


@dataclass(frozen=True)
class TubeConfig:
    shape: ShapeConfig = field(default_factory=ShapeConfig)
    texture: TextureConfig = field(default_factory=TextureConfig)
    sensor: SensorConfig = field(default_factory=SensorConfig)


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
        self.shape: TubeShape = make_shape(config.shape, rng)
        rings, spokes = self.shape.vertices.shape[:2]
        circumference = 2 * np.pi * float(self.shape.radius.mean())
        self.albedo = make_texture(rings * self.shape.step, circumference, config.texture, rng)
        self._bumps = [smooth_noise((rings * 2, spokes * 2), (0.9, 0.9), rng).astype(np.float32) for _ in range(2)]
        sensor = config.sensor
        self.light = _draw_light(sensor, rng)
        if light is not None:
            self.light = replace(light, reflectance=light.reflectance or self.light.reflectance)
        self.specular = rng.uniform(*sensor.specular)
        self.bright_share = rng.uniform(*sensor.bright_share)
        self.shoulder = rng.uniform(*sensor.shoulder)
        self.noise = rng.uniform(*sensor.noise)
        self._scene = o3d.t.geometry.RaycastingScene(nthreads=1)
        self._tensor = lambda array: o3d.core.Tensor(np.ascontiguousarray(array, np.float32))
        self._scene.add_triangles(
            self._tensor(self.shape.vertices.reshape(-1, 3)), o3d.core.Tensor(self.shape.faces.astype(np.uint32))
        )
        self._patches = self._make_patches()

    def view(self, world_from_cam: np.ndarray, camera: CameraModel, mask: np.ndarray, rng: np.random.Generator) -> View:
        """What the endoscope sees from a pose (4, 4) [mm]; pixels outside mask (H, W) are black."""
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
        linear = self._shade(t[met], normals, rays[index], ring, spoke, world_from_cam)

        # Auto exposure on the brightest channel, then the response, its shoulder and the sensor.
        target = np.quantile(linear.max(-1), 1 - self.bright_share) if len(linear) else 1.0
        gain = float(np.exp(rng.normal(0, 0.1))) / max(target, 1e-12)
        code = encode(torch.from_numpy(gain * linear), self.light.gamma).numpy()
        bend = max(1 - self.shoulder, 1e-3)
        excess = np.clip(code - self.shoulder, 0, None)
        code = np.where(excess > 0, self.shoulder + bend * (1.15 - 1.15 * np.exp(-excess / bend)), code)
        code = code + rng.normal(0, self.noise, code.shape)

        image = np.zeros((camera.height, camera.width, 3), np.float32)
        image[index] = np.round(np.clip(code, 0, 1) * 255) / 255
        distance = np.zeros(mask.shape, np.float32)
        distance[index] = t[met]
        all_normals = np.zeros((*mask.shape, 3), np.float32)
        all_normals[index] = normals
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
            slopes = [_bilinear(b[..., None], *self._to_map(ring, spoke, b))[:, 0] for b in self._bumps]
            # Towards the closed end the grid's cells shrink to a point: keep the bumps from becoming spokes there.
            row = np.clip(ring.astype(int), 0, len(self.shape.radius) - 1)
            flat = np.clip(self.shape.radius[row] / self.shape.radius.mean() - 0.3, 0, 0.7) / 0.7
            slopes = [slope * flat for slope in slopes]
            tilted = normals + 0.10 * np.stack([slopes[0], slopes[1], np.zeros_like(slopes[0])], -1)
            tilted /= np.linalg.norm(tilted, axis=-1, keepdims=True)
            lobe = np.clip((-rays * tilted).sum(-1), 0, 1) ** 60
            linear = linear + (self.specular * lobe * self._direct(t, -rays, rays) * 4)[:, None]
        return linear

    def _direct(self, t: np.ndarray, normals: np.ndarray, rays: np.ndarray) -> np.ndarray:
        def image(array: np.ndarray) -> torch.Tensor:
            return torch.from_numpy(np.ascontiguousarray(array.reshape(len(t), -1).T))[None, :, None, :].double()

        light = self.light.terms(torch.float64)
        return irradiance(image(t), image(normals), image(rays), light).numpy().ravel()

    def _to_map(self, ring: np.ndarray, spoke: np.ndarray, array: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mesh grid position -> position on another map over (s, phi)."""
        rings, spokes = self.shape.vertices.shape[:2]
        return ring * (array.shape[0] - 1) / (rings - 1), spoke * array.shape[1] / spokes

    def _make_patches(self) -> _Patches:
        rings, spokes = self.shape.vertices.shape[:2]
        n_s, n_phi = max(8, round(rings * self.shape.step / 3.5)), 22
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
        factors = kernel[0].numpy()
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
    upper = array[r0, c0] * (1 - fc) + array[r0, c1] * fc
    lower = array[r0 + 1, c0] * (1 - fc) + array[r0 + 1, c1] * fc
    return upper * (1 - fr) + lower * fr
