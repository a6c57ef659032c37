"""Photographs of printed boards under known lamps, made by code that shares nothing with the fit of the light.

Lenses, rays, poses and shading are written out here; of OpenCV only the drawing of a charuco board is used.
Millimetres, camera axes x right, y down, z into the scene; pixels have their first centre at (0.5, 0.5).
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

WHITE, BLACK = 0.9, 0.05  # albedos of paper and print


@dataclass(frozen=True)
class Lens:
    """fisheye: r = f theta (1 + k theta²); else r = f tan theta."""

    width: int = 640
    height: int = 480
    focal: float = 380.0
    fisheye: bool = False
    k: float = 0.0

    def rays(self, subpixels: int) -> np.ndarray:
        """(H s, W s, 3) unit rays through the middles of the parts of pixels."""
        u = (np.arange(self.width * subpixels) + 0.5) / subpixels - self.width / 2
        v = (np.arange(self.height * subpixels) + 0.5) / subpixels - self.height / 2
        x, y = np.meshgrid(u, v)
        r = np.hypot(x, y)
        if self.fisheye:
            theta = np.linspace(0, 1.5, 4000)
            angle = np.interp(r, self.focal * theta * (1 + self.k * theta**2), theta)
        else:
            angle = np.arctan(r / self.focal)
        side = np.sin(angle) / np.where(r > 0, r, 1)
        return np.stack([x * side, y * side, np.cos(angle)], -1)

    def file(self) -> dict[str, object]:
        model, more = ("OPENCV_FISHEYE", [self.k, 0.0, 0.0, 0.0]) if self.fisheye else ("PINHOLE", [])
        middle = [self.width / 2, self.height / 2]
        params = [self.focal, self.focal, *middle, *more]
        return {"model": model, "width": self.width, "height": self.height, "params": params}


@dataclass(frozen=True)
class Lamp:
    place: tuple[float, float, float] = (2.5, -1.0, -0.5)
    share: float = 1.0
    tilt: tuple[float, float] = (0.0, 0.0)
    """of its axis, radians to the right and down"""
    mu: float = 1.5
    bare: bool = False
    """Whether it shines as a bare LED does, with the square of the cosine, in the place of exp(-mu (1 - cosine))"""


@dataclass(frozen=True)
class Scene:
    """A board and the camera that photographs it."""

    lens: Lens = Lens()
    lamps: tuple[Lamp, ...] = (Lamp(),)
    squares: tuple[int, int] = (9, 7)
    square: float = 4.0
    marker: float = 3.0
    charuco: bool = True
    gamma: float = 2.2
    vignetting: float = 0.0
    """exponent of the cosine by which the lens darkens to its side"""
    gloss: float = 0.0
    """mirrored light of the paper, over what it scatters"""
    noise: float = 1.0
    """times that of a usual sensor: 8000 electrons at white, 12 of them read noise"""
    ambient: float = 0.0
    """light of the room, as a share of the lamp's at 20 mm"""
    shoulder: bool = False
    """whether the tone curve bends above two thirds"""
    video: bool = False
    """whether edges are sharpened and the picture is packed as a JPEG of quality 85"""
    seed: int = 0


def texture(scene: Scene, part: int = 60) -> np.ndarray:
    """Albedo of the board, `part` samples a square, with half a square of paper around it."""
    across, down = scene.squares
    if scene.charuco:
        words = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
        board = cv2.aruco.CharucoBoard(scene.squares, scene.square, scene.marker, words)
        drawn = board.generateImage((across * part, down * part), marginSize=0)
    else:
        row, column = np.indices((down * part, across * part)) // part
        drawn = np.where((row + column) % 2 == 0, 0, 255).astype(np.uint8)
    drawn = cv2.copyMakeBorder(drawn, *[part // 2] * 4, cv2.BORDER_CONSTANT, value=255)
    return (BLACK + (WHITE - BLACK) * drawn / 255.0).astype(np.float32)


def turned(about: np.ndarray) -> np.ndarray:
    return cv2.Rodrigues(about.astype(float))[0]


def poses(scene: Scene, count: int, rng: np.random.Generator, near: float = 12.0, far: float = 40.0) -> list[tuple]:
    """Rotations and translations: from near to far, tilted by 5 to 45 degrees to any side, somewhat off the middle."""
    across, down = scene.squares
    middle = np.array([across, down, 0]) * scene.square / 2
    found = []
    for distance in np.geomspace(near, far, count):
        side, tilt = rng.uniform(0, 2 * np.pi), np.deg2rad(rng.uniform(5, 45))
        rotation = turned(tilt * np.array([np.cos(side), np.sin(side), 0])) @ turned(
            np.array([0, 0, rng.uniform(-np.pi, np.pi)])
        )
        place = np.array([*rng.uniform(-0.2, 0.2, 2) * distance, distance])
        found.append((rotation, place - rotation @ middle))
    return found


def photograph(scene: Scene, rotation: np.ndarray, shift: np.ndarray, rng: np.random.Generator, subpixels: int = 2):
    """(H, W, 3) uint8."""
    rays, part = scene.lens.rays(subpixels), 60
    normal = rotation[:, 2] * -np.sign(rotation[:, 2] @ shift)
    reach = (normal @ shift) / (rays @ normal)
    x = rays * reach[..., None]
    on_board = (x - shift) @ rotation
    drawn = texture(scene, part)
    column, row = ((on_board[..., i] / scene.square + 0.5) * part - 0.5 for i in (0, 1))
    albedo = cv2.remap(
        drawn, column.astype(np.float32), row.astype(np.float32), cv2.INTER_LINEAR, borderValue=0.02
    ).astype(float)
    seen, light = (reach > 0) & np.isfinite(reach), 0.0
    for lamp in scene.lamps:
        to_lamp = np.array(lamp.place) - x
        far = np.linalg.norm(to_lamp, axis=-1)
        to_lamp = to_lamp / far[..., None]
        axis = np.array([*lamp.tilt, 1.0]) / np.linalg.norm([*lamp.tilt, 1.0])
        along = -(to_lamp @ axis)
        spread = np.clip(along, 0, 1) ** 2 if lamp.bare else np.exp(-lamp.mu * (1 - along))
        beam = lamp.share * spread / far**2
        half = to_lamp - rays
        half = half / np.linalg.norm(half, axis=-1, keepdims=True)
        mirrored = scene.gloss * np.clip(half @ normal, 0, 1) ** 60
        light = light + beam * np.clip(to_lamp @ normal, 0, None) * (albedo + mirrored)
    light = np.where(seen, light + scene.ambient * albedo / 400, 0) * rays[..., 2] ** scene.vignetting
    height, width = scene.lens.height, scene.lens.width
    light = light.reshape(height, subpixels, width, subpixels).mean((1, 3))
    light = cv2.GaussianBlur(light, (0, 0), 0.6)
    exposed = light / np.quantile(light[light > 0.2 * light.max()], 0.95) * rng.uniform(0.45, 0.65)
    electrons = 8000 * np.clip(exposed, 0, None)[..., None].repeat(3, -1)
    spread = scene.noise * np.sqrt(electrons + 12**2)
    noisy = np.clip((electrons + spread * rng.standard_normal(electrons.shape)) / 8000, 0, 1)
    code = noisy ** (1 / scene.gamma)
    if scene.shoulder:
        code = np.where(code > 0.67, 0.67 + 0.25 * (1 - np.exp(-(code - 0.67) / 0.25)), code)
    if scene.video:
        code = np.clip(code + 0.5 * (code - cv2.GaussianBlur(code, (0, 0), 1.2)), 0, 1)
    image = np.rint(255 * code).astype(np.uint8)
    return cv2.imdecode(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 85])[1], 1) if scene.video else image


def write_frames(
    scene: Scene, folder: Path, count: int = 12, near: float = 12.0, far: float = 40.0, placed=None
) -> Path:
    """A folder of frames as the program reads it."""
    rng = np.random.default_rng(scene.seed)
    (folder / "frames").mkdir(parents=True)
    for i, (rotation, shift) in enumerate(placed or poses(scene, count, rng, near, far)):
        image = photograph(scene, rotation, shift, rng)
        assert cv2.imwrite(str(folder / "frames" / f"{i:04d}.png"), image[..., ::-1])
    (folder / "camera.json").write_text(json.dumps(scene.lens.file()), encoding="utf-8")
    return folder
