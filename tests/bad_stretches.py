"""Synthetic colonoscopy as it really is: good stretches with stretches of blur, cover and wall between them.

Truth of what is worth training on is what lies outside the bad stretches. Bad frames are rendered where the camera
really was: it goes on moving while it sees nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter, gaussian_filter1d
from scipy.spatial.transform import Rotation

from lightdepth.camera import CameraModel, Pinhole
from lightdepth.frame import Frame
from lightdepth.tube import TextureConfig, Tube, TubeConfig, camera_path, octagon

KINDS = ("motion blur", "defocus", "darkness", "stool", "fluid", "wall")


@dataclass(frozen=True)
class Stretches:
    """frames, and for each the kind of bad stretch it belongs to; "" for frames that are worth training on."""

    frames: list[Frame]
    kinds: list[str]

    @property
    def good(self) -> np.ndarray:
        return np.array([kind == "" for kind in self.kinds])


def schedule(
    count: int, rng: np.random.Generator, good: tuple[int, int] = (10, 24), bad: tuple[int, int] = (5, 12)
) -> list[str]:
    """Good and bad stretches in turn, lengths uniform in the ranges; every kind comes before one comes again."""
    kinds: list[str] = []
    order = [k for _ in range(count) for k in rng.permutation(KINDS)]
    while len(kinds) < count:
        kinds += [""] * int(rng.integers(good[0], good[1] + 1))
        kinds += [str(order.pop())] * int(rng.integers(bad[0], bad[1] + 1))
    return kinds[:count]


def bad_stretches(
    seed: int,
    camera: CameraModel,
    count: int = 120,
    speed: float = 1.5,
    config: TubeConfig | None = None,
    kinds: list[str] | None = None,
) -> Stretches:
    """A colon drawn from `seed`, seen at `speed` mm a frame, with bad stretches."""
    rng = np.random.default_rng(seed)
    travel = speed * (count - 1)
    config = config or TubeConfig(texture=TextureConfig(resolution=0.2))
    config = replace(config, shape=replace(config.shape, length=max(config.shape.length, travel + 75.0)))
    tube, mask = Tube(config, rng), octagon(camera)
    kinds = kinds or schedule(count, rng)
    poses = camera_path(tube.shape, count, travel, rng)
    turns = gaussian_filter1d(rng.standard_normal((count, 3)), 3, axis=0)  # a hand is not a rail
    poses[:, :3, :3] = poses[:, :3, :3] @ Rotation.from_rotvec(0.25 * turns).as_matrix()
    frames, drawn = [], _Bad(rng, camera, mask)
    for i, (pose, kind) in enumerate(zip(poses, kinds, strict=True)):
        if i == 0 or kinds[i - 1] != kind:
            drawn.start()
        pose = at_wall(tube, pose, drawn) if kind == "wall" else pose
        view = tube.view(pose, camera, mask, rng)
        image = drawn.spoilt(view.image, kind, tube.sensor.noise)
        frames.append(Frame(f"{i:06d}", image, camera, replace(tube.light, gain=1.0), mask, time=i / 8))
    return Stretches(frames, list(kinds))


def at_wall(tube: Tube, pose: np.ndarray, drawn: _Bad) -> np.ndarray:
    """The pose with the camera turned aside and moved on until the wall is a few millimetres away."""
    turned = pose.copy()
    turned[:3, :3] = pose[:3, :3] @ Rotation.from_rotvec(drawn.aside).as_matrix()
    probe = Pinhole(3, 3, 60.0, 60.0, 1.5, 1.5)
    distance = tube.view(turned, probe, np.ones((3, 3), bool), np.random.default_rng(0)).distance[1, 1]
    turned[:3, 3] += (float(distance) - drawn.gap) * turned[:3, 2]
    return turned


class _Bad:
    """What the bad stretch at hand looks like. Sizes are shares of the image's width."""

    def __init__(self, rng: np.random.Generator, camera: CameraModel, mask: np.ndarray):
        self.rng, self.camera, self.mask = rng, camera, mask
        self.start()

    def start(self) -> None:
        rng = self.rng
        self.length, self.defocus = rng.uniform(0.04, 0.16), rng.uniform(0.006, 0.025)
        self.gap = rng.uniform(1.5, 3.0)  # mm
        angle, self.direction = rng.uniform(0, 2 * np.pi, 2)
        self.aside = rng.uniform(1.2, 1.6) * np.array([np.cos(angle), np.sin(angle), 0])
        self.cover = rng.uniform(0.8, 1.0)
        self.fields = self._noise(0.12), self._noise(0.12)
        self.grains = self._noise(0.02), self._noise(0.02)  # so near the lens nothing is in focus
        self.flow = rng.uniform(0.2, 0.6)  # radians a frame: what flows does not keep its shape
        self.drift = rng.uniform(-0.08, 0.08, 2)
        self.time = 0

    def _noise(self, scale: float) -> np.ndarray:
        """Smooth noise (2 H, 2 W) of unit deviation, which wraps around."""
        sigma = scale * self.camera.width
        shape = (2 * self.camera.height, 2 * self.camera.width)
        noise = gaussian_filter(self.rng.standard_normal(shape).astype(np.float32), sigma, mode="wrap")
        return noise / noise.std()

    def _here(self, fields: tuple[np.ndarray, np.ndarray], flow: float) -> np.ndarray:
        field = np.cos(flow * self.time) * fields[0] + np.sin(flow * self.time) * fields[1]
        moved = np.rint(self.time * self.drift[::-1] * self.camera.width).astype(int)
        return np.roll(field, tuple(moved), (0, 1))[: self.camera.height, : self.camera.width]

    def spoilt(self, image: np.ndarray, kind: str, noise: float) -> np.ndarray:
        if kind == "":
            return image
        self.time += 1
        width = self.camera.width
        if kind == "motion blur":
            image = cv2.filter2D(image, -1, _line(self.length * width, self.direction + self.rng.normal(0, 0.4)))
        elif kind == "defocus":
            image = cv2.GaussianBlur(image, (0, 0), self.defocus * width)
        elif kind == "wall":  # nearer than the lens can focus, and too bright
            image = cv2.GaussianBlur(1.4 * image, (0, 0), 0.009 * width)
        else:
            image = self._covered(image, kind)
        image = image + self.rng.normal(0, noise, image.shape)
        image = np.round(np.clip(image, 0, 1) * 255) / 255
        return np.where(self.mask[..., None], image, 0).astype(np.float32)

    def _covered(self, image: np.ndarray, kind: str) -> np.ndarray:
        field, grain = self._here(self.fields, self.flow), self._here(self.grains, 2 * self.flow)
        edge = np.quantile(field[self.mask], 1 - self.cover)
        alpha = (1 / (1 + np.exp(-(field - edge) / 0.06)))[..., None]
        colors = {"darkness": (0.03, 0.01, 0.01), "stool": (0.45, 0.3, 0.1), "fluid": (0.85, 0.8, 0.6)}
        shade = {"darkness": 0.1, "stool": 0.15, "fluid": 0.05}[kind]
        cover = np.array(colors[kind]) * (1 + shade * (0.7 * field + 0.5 * (kind == "stool") * grain))[..., None]
        return (1 - alpha) * cv2.GaussianBlur(image, (0, 0), 0.006 * self.camera.width) + alpha * cover


def _line(length: float, angle: float) -> np.ndarray:
    """The kernel of a motion along a line, length in pixels."""
    size = int(np.ceil(length)) | 1
    kernel = np.zeros((size, size), np.float32)
    middle, half = size // 2, length / 2
    step = np.array([np.cos(angle), np.sin(angle)]) * half
    ends = [tuple(int(v) for v in np.rint((middle + sign * step) * 16)) for sign in (-1, 1)]
    cv2.line(kernel, ends[0], ends[1], 1.0, 1, cv2.LINE_AA, shift=4)
    return kernel / kernel.sum()
