"""The twelve colons by which networks are judged, fixed before any was tuned on them. Six bounce light strongly.

A colon is its number's and its row's alone: what the row leaves open is drawn by the seed. A change that makes other
pictures of them raises VERSION, and figures of two versions are not comparable.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from lightdepth.camera import CameraModel
from lightdepth.frame import Frame
from lightdepth.judge_colons.endoscope import Exposure, LensKind, Sensor, draw_way, exposed, image_circle, make_lens
from lightdepth.judge_colons.lamps import Lamp, draw_lamps, measured_light, vignetting
from lightdepth.judge_colons.skin import make_skin
from lightdepth.judge_colons.transport import (
    Hits,
    Lit,
    Scene,
    film_lobe,
    film_normal,
    indirect,
    matt_lobe,
    mirrored,
    spread_over,
)
from lightdepth.judge_colons.wall import make_wall

VERSION = 1
STRONG = 0.4
"""Reflectance above which a colon bounces light strongly."""
_EVERY = 4  # pixels between the places where indirect light is found
_FINE = 2  # rays a pixel, each way


@dataclass(frozen=True)
class JudgeColon:
    """One of the twelve. `reflectance` is that of the wall's brightest channel, in the mean."""

    name: str
    seed: int
    reflectance: float
    exposure: Exposure
    lens: LensKind
    gamma: float
    size: tuple[int, int]
    frames: int = 12

    @property
    def strong(self) -> bool:
        return self.reflectance > STRONG


JUDGE_COLONS = (
    JudgeColon("judge01", 901, 0.10, "even", "plain", 2.2, (160, 128)),
    JudgeColon("judge02", 902, 0.16, "clipped", "fisheye", 1.0, (144, 120)),
    JudgeColon("judge03", 903, 0.22, "dark", "barrel", 2.2, (160, 120)),
    JudgeColon("judge04", 904, 0.28, "bright", "circle", 1.8, (144, 120)),
    JudgeColon("judge05", 905, 0.34, "clipped", "barrel", 2.4, (160, 128)),
    JudgeColon("judge06", 906, 0.40, "even", "narrow", 1.0, (128, 96)),
    JudgeColon("judge07", 907, 0.48, "bright", "plain", 2.2, (128, 96)),
    JudgeColon("judge08", 908, 0.56, "dark", "fisheye", 2.4, (160, 128)),
    JudgeColon("judge09", 909, 0.64, "clipped", "circle", 2.2, (144, 120)),
    JudgeColon("judge10", 930, 0.72, "even", "barrel", 1.8, (160, 120)),
    JudgeColon("judge11", 911, 0.81, "clipped", "narrow", 2.2, (128, 96)),
    JudgeColon("judge12", 912, 0.90, "bright", "fisheye", 1.0, (144, 120)),
)


@dataclass(frozen=True, eq=False)
class JudgeFrame:
    """A frame with its truth, and the wall's reflectance (H, W, 3) in it."""

    frame: Frame
    reflectance: np.ndarray


@dataclass(frozen=True, eq=False)
class _View:
    """Linear radiance (H, W, 3), true distance (H, W) [mm] and reflectance (H, W, 3)."""

    radiance: np.ndarray
    distance: np.ndarray
    reflectance: np.ndarray


def judge_frames(
    colon: JudgeColon,
    progress: Callable[[], None] = lambda: None,
    quality: int = 10,
    lamps: Sequence[Lamp] | None = None,
) -> list[JudgeFrame]:
    """The frames of a colon; `quality`² paths are drawn for each place where indirect light is found. Lamps that are
    given take the place of those that are drawn, and leave wall, lens and way as they are."""
    rng = np.random.default_rng([VERSION, colon.seed])
    wall = make_wall(rng)
    scene = Scene(wall.mesh, make_skin(rng, colon.reflectance))
    camera = make_lens(colon.lens, *colon.size, rng)
    drawn, vignette = draw_lamps(rng), float(rng.uniform(0.0, 1.6))
    lamps = drawn if lamps is None else lamps
    sensor = Sensor(
        colon.exposure,
        colon.gamma,
        blur=float(rng.uniform(0.3, 0.8)),
        electrons=float(10 ** rng.uniform(3.0, 4.0)),
        reading=float(10 ** rng.uniform(-3.3, -2.7)),
    )
    poses = draw_way(rng, wall, scene, colon.frames)
    views = []
    for pose in poses:
        views.append(seen_by(scene, camera, Lit(lamps, pose), vignette, rng, quality))
        progress()
    circle, (rays, valid) = image_circle(colon.lens, camera), camera.rays()
    inside: np.ndarray = valid if circle is None else circle & valid
    images, gain = exposed([v.radiance for v in views], inside, sensor, rng)
    light = measured_light(lamps, rays[inside], vignette, colon.gamma)
    light = replace(light, gain=gain / np.pi)
    mask = None if inside.all() else inside
    return [
        JudgeFrame(
            Frame(
                name=f"{i:06d}",
                image=image,
                camera=camera,
                light=light,
                mask=mask,
                time=i / 5,
                true_distance=np.where(inside, view.distance, 0).astype(np.float32),
                true_world_from_cam=pose,
            ),
            np.where(inside[..., None], view.reflectance, 0).astype(np.float32),
        )
        for i, (image, view, pose) in enumerate(zip(images, views, poses, strict=True))
    ]


def seen_by(
    scene: Scene, camera: CameraModel, lit: Lit, vignette: float, rng: np.random.Generator, quality: int
) -> _View:
    """What the lens sees. Radiance is the mean over a pixel; distance and reflectance are those of its centre."""
    height, width = camera.height, camera.width
    hits = _through(scene, camera, lit)
    far = np.where(hits.met, hits.distance, 0).reshape(height, width)
    rho = np.where(hits.met[:, None], hits.reflectance, 0).reshape(height, width, 3)
    chosen = np.zeros((height, width), bool)
    chosen[_EVERY // 2 :: _EVERY, _EVERY // 2 :: _EVERY] = True
    known = hits.at(np.flatnonzero(chosen.ravel() & hits.met))
    bounced = indirect(scene, known, lit, rng, quality)
    fine = camera.resized(_FINE * width, _FINE * height)
    points, lens = _through(scene, fine, lit), _to_lens(fine, lit)
    light = np.zeros((len(lens), 3))
    met = np.flatnonzero(points.met)
    points, lens = points.at(met), lens[met]
    around = spread_over(known, bounced, points)
    light[met] = _leaving(scene, points, lens, lit, around)
    light = light.reshape(height, _FINE, width, _FINE, 3).mean((1, 3))
    mirror = np.zeros((height * width, 3))
    met = np.flatnonzero(hits.met)
    mirror[met] = mirrored(scene, hits.at(met), _to_lens(camera, lit)[met], lit, rng)
    soft = cv2.GaussianBlur(mirror.reshape(height, width, 3), (0, 0), 0.8)
    through = vignetting(camera.rays()[0], vignette)[..., None]
    return _View(through * (light + soft), far, rho)


def _through(scene: Scene, camera: CameraModel, lit: Lit) -> Hits:
    """What each pixel's ray meets, (H W, ...)."""
    centre = lit.world_from_cam[:3, 3].astype(np.float32)
    away = -_to_lens(camera, lit)
    return scene.cast(np.broadcast_to(centre, away.shape), away)


def _to_lens(camera: CameraModel, lit: Lit) -> np.ndarray:
    """Unit directions (H W, 3) in the world, against each pixel's ray."""
    rays = camera.rays()[0].reshape(-1, 3)
    return np.asarray(-(rays @ lit.world_from_cam[:3, :3].T), np.float32)


def _leaving(scene: Scene, hits: Hits, lens: np.ndarray, lit: Lit, bounced: np.ndarray) -> np.ndarray:
    """Radiance (n, 3) towards the lens: of the lamps and of indirect irradiance `bounced` (n, 3)."""
    to_lens = (lens * hits.normal).sum(-1)
    film = film_normal(hits)
    total = matt_lobe(hits.reflectance, np.full(len(lens), 0.5), to_lens) * bounced
    for lamp in lit.lamps:
        arrives, towards = lit.falls(scene, hits, lamp)
        cosine = np.maximum((towards * hits.normal).sum(-1), 0)
        lobe = matt_lobe(hits.reflectance, cosine, to_lens)
        lobe = lobe + film_lobe(film, towards, lens, scene.skin.roughness)[:, None]
        total += lobe * (arrives * cosine)[:, None]
    return np.asarray(total)
