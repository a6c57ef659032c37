"""A synthetic colon that can be looked at: ray casting, and the light of lightdepth.photometry with what it leaves out.
Many views at once, on the CPU or a GPU.

A view has: direct light from a spot beside the camera, light from the wall to the wall (radiosity between patches of
the whole tube with true occlusion: not the approximation that the losses use), highlights on wet and rough wall, and
what lightdepth.tube.sensor makes of it. Lengths in millimetres; patches are a coarse grid over (s, phi). Every effect
beyond the first colons' draws from a generator of its own: on or off, the rest stays the same (but a wall of another
circumference needs another sheet of paint). All draws are NumPy's, so that a seed gives the same colon and the same
noise on every device, up to rounding.

Notation of tensors: B views, P pixels inside the mask, N patches; vectors (B, 3, P). A place (B, P, 2) on the wall is
(phi, s), each from -1 to 1, which samples every map over (s, phi) whatever its size (lightdepth.tube.wall).
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Annotated

import cv2
import numpy as np
import torch
from torch import Tensor

from lightdepth.camera import CameraModel
from lightdepth.photometry import LightTerms, PhotometricCalibration, irradiance
from lightdepth.ranges import SHARE, at_least, checked
from lightdepth.tube.casting import Caster, EmbreeCaster, make_caster
from lightdepth.tube.exchange import ExchangeConfig, Patches, draw_exchange, exchanged
from lightdepth.tube.film import FilmConfig, cover, fine_relief
from lightdepth.tube.path import PathConfig, image_flow
from lightdepth.tube.polyps import tinted
from lightdepth.tube.sensor import SensorConfig, draw_sensor, expose
from lightdepth.tube.shape import ShapeConfig, TubeShape, make_shape, smooth_noise
from lightdepth.tube.texture import TextureConfig, make_texture
from lightdepth.tube.wall import WallMap, place_of


@dataclass(frozen=True)
@checked
class TubeConfig:
    shape: ShapeConfig = field(default_factory=ShapeConfig)
    """Ranges of the shape of a colon (of two ends, a value between is drawn for each)."""
    texture: TextureConfig = field(default_factory=TextureConfig)
    """Ranges of what is painted on the wall of a colon (of two ends, a value between is drawn for each)."""
    sensor: SensorConfig = field(default_factory=SensorConfig)
    """Ranges of the light and the camera of an endoscope (of two ends, a value between is drawn for each)."""
    film: FilmConfig = field(default_factory=FilmConfig)
    """Ranges of what lies on the wall of a colon: mucus, bubbles, stool (of two ends, a value between is drawn for
    each)."""
    path: PathConfig = field(default_factory=PathConfig)
    """How the endoscope moves through the colon."""
    patch: Annotated[float, at_least(0.2, up_to=1000)] = 3.5
    """Length along the tube, mm, of the patches of wall that exchange light. A larger one makes coarser indirect light
    in less time."""
    exchange: ExchangeConfig = field(default_factory=ExchangeConfig)
    """How light between patches of wall is computed."""
    least_cosine: Annotated[float, SHARE] = 0.0
    """Least cosine between the wall's normal, interpolated over its mesh, and the direction to the camera; normals
    turned farther away, at the edges of folds, are turned back to it. A larger one turns more of them; 0 leaves all as
    they are."""


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
class RenderedView:
    """image (H, W, 3) encoded, in [0, 1]; distance (H, W) along the ray, 0 where no wall was met; normals (H, W, 3) in
    camera axes."""

    image: np.ndarray
    distance: np.ndarray
    normals: np.ndarray


class Tube:
    """One colon and one endoscope in it, drawn from `config` by `rng`; looked at on `device`."""

    def __init__(
        self,
        config: TubeConfig,
        rng: np.random.Generator,
        light: PhotometricCalibration | None = None,
        device: torch.device | str = "cpu",
    ):
        self.device = torch.device(device)
        film_rng, surface_rng, sensor_rng, tint_rng = rng.spawn(4)
        self.shape: TubeShape = self._make_shape(config.shape, rng)
        rings, spokes = self.shape.vertices.shape[:2]
        circumference = 2 * np.pi * float(self.shape.radius.mean())
        albedo = self._make_texture(rings * self.shape.step, circumference, config.texture, rng)
        albedo = tinted(albedo, self.shape.polyps, self.shape.radius, spokes, self.shape.step, tint_rng)
        self.albedo, self.film = cover(albedo, config.texture.resolution, config.film, film_rng)
        bumps = np.stack([smooth_noise((rings * 2, spokes * 2), (0.9, 0.9), rng) for _ in range(2)], -1)
        sensor = config.sensor
        self.light = _draw_light(sensor, rng)
        if light is not None:
            self.light = replace(light, reflectance=light.reflectance or self.light.reflectance)
        self.specular = rng.uniform(*sensor.specular)
        self.sensor = draw_sensor(sensor, self.light.gamma, rng, sensor_rng)
        self.cosine_exponent = surface_rng.uniform(*sensor.cosine_exponent)
        self.gloss, self.roughness = surface_rng.uniform(*sensor.gloss), surface_rng.uniform(*sensor.roughness)
        self.sparkle = surface_rng.uniform(*sensor.sparkle)
        self._relief = self._tensor(fine_relief(surface_rng).transpose(2, 0, 1)) if self.sparkle > 0 else None
        self._caster: Caster = make_caster(self.shape.vertices.reshape(-1, 3), self.shape.faces, self.device)
        self._least_cosine, self._patch = config.least_cosine, config.patch
        self._paint, self._bumps, self._normals = map(self._map, (self.albedo, bumps, self.shape.normals))
        self._wet = None if self.film.wet is None else self._map(self.film.wet)
        self._domes = None if self.film.slopes is None else self._map(self.film.slopes)
        self._exchange = draw_exchange(config.exchange, rng)
        self._patches, self._factors, self._tint = self._make_patches()

    _make_shape = staticmethod(make_shape)
    _make_texture = staticmethod(make_texture)
    _expose = staticmethod(expose)

    def reshaped(self, shape: TubeShape) -> Tube:
        """The same paint and endoscope on a wall of another shape, of as many rings and spokes."""
        other = copy(self)
        vars(other).pop("_on_cpu", None)
        other.shape, other._normals = shape, self._map(shape.normals)
        other._caster = make_caster(shape.vertices.reshape(-1, 3), shape.faces, self.device)
        other._patches, other._factors, other._tint = other._make_patches()
        return other

    def view(
        self, world_from_cam: np.ndarray, camera: CameraModel, mask: np.ndarray, rng: np.random.Generator
    ) -> RenderedView:
        """What the endoscope sees from a pose (4, 4) [mm]; pixels outside mask (H, W) are black."""
        return self.views(world_from_cam[None], camera, mask, rng)[0]

    def views(
        self, world_from_cam: np.ndarray, camera: CameraModel, mask: np.ndarray, rng: np.random.Generator
    ) -> list[RenderedView]:
        """What the endoscope sees from poses (B, 4, 4) [mm], as one batch: what `view` would give one by one."""
        count = len(world_from_cam)
        owns = rng.spawn(count)
        every_ray, rays_valid = camera.rays()
        wanted = mask & rays_valid
        cam_from_world = self._tensor(world_from_cam[:, :3, :3].transpose(0, 2, 1))
        origin = self._tensor(world_from_cam[:, :3, 3:])
        directions = self._tensor(every_ray[wanted] @ world_from_cam[:, :3, :3].transpose(0, 2, 1))
        rays = self._tensor(every_ray[wanted].T[None])
        hit = self._caster.cast(origin.mT.expand_as(directions).reshape(-1, 3), directions.reshape(-1, 3))
        t, face, uv = (part.reshape(count, -1, *part.shape[1:]).to(self.device) for part in hit)
        met = t.isfinite()
        t = torch.where(met, t, 1.0)
        place = place_of(torch.where(met, face, 0), uv, self.shape.vertices.shape[:2])
        normals = cam_from_world @ _unit(self._normals.at(place))
        if self._least_cosine > 0:
            lacking = (self._least_cosine + (normals * rays).sum(1, keepdim=True)).clamp(min=0)
            normals = _unit(normals - lacking * rays)
        linear = self._shade(t, normals, rays, place, cam_from_world, origin)

        def image(values: Tensor) -> Tensor:
            """(B, C, P) -> (B, C, H, W), 0 where no wall was met."""
            whole = values.new_zeros((*values.shape[:2], mask.size))
            return whole.index_copy_(2, inside, values * met[:, None]).view(*values.shape[:2], *mask.shape)

        inside = torch.as_tensor(np.flatnonzero(wanted), device=self.device)
        distance = image(t[:, None])[:, 0]
        flow = image_flow(distance, camera, self.sensor.motion, owns) if self.sensor.motion > 0 else None
        ray_z = self._tensor(every_ray[..., 2])
        images = self._expose(image(linear), distance > 0, ray_z, flow, self.sensor, rng, owns)
        parts = (images, distance.cpu().numpy(), image(normals).permute(0, 2, 3, 1).cpu().numpy())
        return [RenderedView(*(np.ascontiguousarray(part[i]) for part in parts)) for i in range(count)]

    def distance_to_wall(self, points: np.ndarray) -> np.ndarray:
        """Exact distance (n,) [mm] from points (n, 3) to the mesh."""
        return self._on_cpu.distance(points)

    @cached_property
    def _on_cpu(self) -> EmbreeCaster:
        if isinstance(self._caster, EmbreeCaster):
            return self._caster
        return EmbreeCaster(self.shape.vertices.reshape(-1, 3), self.shape.faces)

    def _tensor(self, array: np.ndarray) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(array, np.float32)).to(self.device)

    def _map(self, array: np.ndarray) -> WallMap:
        return WallMap.of(self._tensor(array.reshape(*array.shape[:2], -1))[None])

    def _shade(
        self, t: Tensor, normals: Tensor, rays: Tensor, place: Tensor, cam_from_world: Tensor, origin: Tensor
    ) -> Tensor:
        """Linear RGB (B, 3, P) with gain 1, at distances t (B, P) along rays (1, 3, P), seen from origin (B, 3, 1) with
        rotation cam_from_world (B, 3, 3)."""
        direct = self._direct(t, normals, rays)[:, None]
        linear = self._paint.at(place) * (direct + self._indirect(cam_from_world, origin).at(place))
        if self.specular > 0:
            linear = linear + self._highlights(t, normals, rays, place, cam_from_world)[:, None]
        return linear

    def _highlights(self, t: Tensor, normals: Tensor, rays: Tensor, place: Tensor, cam_from_world: Tensor) -> Tensor:
        """White light (B, P) that the wet surface mirrors back."""
        rings, spokes = self.shape.vertices.shape[:2]
        ring, spoke = (place[..., 1] + 1) / 2 * (rings - 1), (place[..., 0] + 1) / 2 * spokes
        row = (ring + 1e-3).long().clamp(0, rings - 1)
        # Towards the closed end the grid's cells shrink to a point: keep the bumps from becoming spokes there.
        mean = float(self.shape.radius.mean())
        flat = (self._tensor(self.shape.radius)[row] / mean - 0.3).clamp(0, 0.7) / 0.7
        gloss: Tensor | float = self.gloss
        strength: Tensor | float = self.specular
        rough: Tensor | float = self.roughness
        if self._wet is not None:  # mucus is smoother and shines more than the wall
            wet = self._wet.at(place)[:, 0]
            gloss, strength, rough = gloss * (1 + wet), strength * (0.7 + wet), rough * (1 - 0.4 * wet)
        slopes = (rough * flat)[:, None] * self._bumps.at(place)
        tilted = torch.cat([normals[:, :2] + slopes, normals[:, 2:]], 1)
        if self._relief is not None or self._domes is not None:
            fine = torch.zeros_like(slopes)
            if self._relief is not None:
                texel, size = 0.15, self._relief.shape[1]
                u = (ring * (self.shape.step / texel)).round().long() % size
                v = (spoke * (2 * np.pi * mean / spokes / texel)).round().long() % size
                # Relief smaller than a pixel is averaged away.
                unresolved = 0.02 * t / texel
                depth = self.sparkle * flat / (1 + unresolved**2).sqrt()
                fine = depth[:, None] * self._relief[:, u, v].transpose(0, 1)
            if self._domes is not None:
                fine = fine + self._domes.at(place)
            along_s = cam_from_world @ self._tensor(self.shape.frames[:, 0].T)[:, row].transpose(0, 1)
            along_phi = torch.linalg.cross(along_s, normals, dim=1)
            tilted = tilted + fine[:, :1] * along_s + fine[:, 1:] * along_phi
        lobe = (-rays * _unit(tilted)).sum(1).clamp(0, 1) ** gloss
        return strength * lobe * self._direct(t, -rays, rays) * 4

    def _direct(self, t: Tensor, normals: Tensor, rays: Tensor) -> Tensor:
        """(B, P) of t (B, P), normals and rays (B or 1, 3, P)."""
        light = LightTerms(*(term.to(self.device) for term in self.light.terms()))
        parts = t[:, None, None], normals[:, :, None], rays[:, :, None]
        return irradiance(*parts, light, self.cosine_exponent)[:, 0, 0]

    def _make_patches(self) -> tuple[Patches, Tensor, Tensor]:
        """The patches, their form factors, and the share of each colour (N, 3) that they reflect."""
        mesh, size = self.shape.vertices.shape[:2], self._patch * self._exchange.coarser
        n_s, n_phi = max(8, round(mesh[0] * self.shape.step / size)), max(8, round(22 / self._exchange.coarser))
        # Each (s, phi) of the coarse grid once: the column at the seam is the first again.
        phi, s = np.meshgrid(np.arange(n_phi) * 2 / n_phi - 1, np.linspace(-1, 1, n_s))
        place = self._tensor(np.stack([phi, s], -1).reshape(1, -1, 2))
        points = self._map(self.shape.vertices).at(place)[0].T
        normals = _unit(self._normals.at(place))[0].T
        grid = points.reshape(n_s, n_phi, 3)
        along_s = torch.gradient(grid, dim=0)[0]
        wrapped = torch.cat([grid[:, -1:], grid, grid[:, :1]], 1)
        areas = torch.linalg.cross(along_s, (wrapped[:, 2:] - wrapped[:, :-2]) / 2).norm(dim=-1).flatten()
        patches = Patches((n_s, n_phi), points, normals, areas)
        mean_albedo = cv2.resize(self.albedo, (n_phi, n_s), interpolation=cv2.INTER_AREA).reshape(-1, 3)
        tint = self.light.reflectance * self._tensor(mean_albedo)
        return patches, exchanged(self._exchange.form, patches, self._caster, mesh), tint

    def _indirect(self, cam_from_world: Tensor, origin: Tensor) -> WallMap:
        """Light from the wall on every patch: rho K E summed over the bounces, per view and colour."""
        patches, count = self._patches, len(origin)
        if self.light.reflectance == 0:
            return WallMap.of(torch.zeros((count, *patches.grid, 3), device=self.device))
        in_cam = cam_from_world @ (patches.points.T - origin)
        t = in_cam.norm(dim=1).clamp(min=1e-6)
        lamp = origin + cam_from_world.mT @ self._tensor(np.asarray(self.light.position_mm))[:, None]
        ends = patches.lifted.expand(count, -1, -1)
        dark = self._caster.blocked(lamp.mT.expand_as(ends).reshape(-1, 3), ends.reshape(-1, 3)).to(self.device)
        direct = self._direct(t, cam_from_world @ patches.normals.T, in_cam / t[:, None])
        source = (direct * ~dark.reshape(count, -1))[..., None]
        total = source
        for _ in range(self._exchange.bounces):
            bounced = self._factors @ (self._tint * total)
            total = source + bounced
        return WallMap.of(bounced.reshape(count, *patches.grid, 3))


def _unit(vectors: Tensor) -> Tensor:
    """Of vectors (B, 3, P); 0 stays 0."""
    return vectors / vectors.square().sum(1, keepdim=True).sqrt().clamp(min=1e-9)


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
