"""What an endoscope does to the light that it receives: lens, exposure, response, processor.

Notation: linear images (H, W, 3), L the radiance with gain 1; codes in [0, 1]. In order: motion and focus blur,
vignetting cos^k psi, veiling glare L + g (mean - L), exposure, blooming of what is above white, colour cast, response
v^(1/gamma), contrast, shoulder, noise, sharpening, rounding to 8 bits, JPEG.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch

from lightdepth.photometry import encode


@dataclass(frozen=True)
class SensorConfig:
    """Light and camera of one endoscope; pairs are the ends of a uniform range. (0, 0) switches an effect off where
    nothing else is said; everything from cosine_exponent on is off."""

    gamma: tuple[float, float] = (2.0, 2.6)
    mu: tuple[float, float] = (2.2, 3.4)
    light_offset: float = 2.0  # mm, deviation of the light's position sideways
    reflectance: tuple[float, float] = (0.0, 0.7)
    specular: tuple[float, float] = (0.0, 0.5)
    bright_share: tuple[float, float] = (0.03, 0.2)  # share of pixels that auto exposure lets saturate
    shoulder: tuple[float, float] = (0.75, 1.0)  # code value at which the tone curve starts to bend
    noise: tuple[float, float] = (0.003, 0.012)  # deviation in code values
    exposure: tuple[float, float] = (0.1, 0.1)  # deviation of log gain from frame to frame
    cosine_exponent: tuple[float, float] = (
        1.0,
        1.0,
    )  # 1 is Lambert; rough walls have less, satin ones more (Minnaert: 2k - 1)
    gloss: tuple[float, float] = (60.0, 60.0)  # exponent of the highlights' lobe
    roughness: tuple[float, float] = (0.1, 0.1)  # slopes that break up the highlights
    sparkle: tuple[float, float] = (0.0, 0.0)  # slopes of the finest relief, tenths of a millimetre
    vignetting: tuple[float, float] = (0.0, 0.0)  # exponent k
    glare: tuple[float, float] = (0.0, 0.0)  # share of the light that the lens spreads over the whole image
    bloom: tuple[float, float] = (0.0, 0.0)  # share of what is above white that spills over
    motion: tuple[float, float] = (0.0, 0.0)  # median length of motion blur, share of the image height
    defocus: tuple[float, float] = (0.0, 0.0)  # sigma, share of the image height
    cast: tuple[float, float] = (0.0, 0.0)  # deviation of the white balance, log
    contrast: tuple[float, float] = (0.0, 0.0)  # of the tone curve's S, -1 to 1
    shot_noise: tuple[float, float] = (0.0, 0.0)  # deviation at linear white; falls with the root of the light
    sharpen: tuple[float, float] = (0.0, 0.0)  # weight of unsharp masking
    jpeg: tuple[int, int] = (100, 100)  # quality with halved chroma; 100 is none


@dataclass(frozen=True)
class Sensor:
    """One endoscope's camera: see SensorConfig."""

    gamma: float
    bright_share: float
    shoulder: float
    noise: float
    exposure: float
    vignetting: float
    glare: float
    bloom: float
    motion: float
    defocus: float
    cast: tuple[float, float, float]
    contrast: float
    shot_noise: float
    sharpen: float
    jpeg: int


def draw_sensor(config: SensorConfig, gamma: float, rng: np.random.Generator, own: np.random.Generator) -> Sensor:
    """The camera of one endoscope; `rng` draws exposure, shoulder and noise, `own` what came later."""
    bright_share, shoulder, noise = (
        rng.uniform(*ends) for ends in (config.bright_share, config.shoulder, config.noise)
    )
    deviation = own.uniform(*config.cast)
    cast = np.exp(deviation * own.standard_normal(3))
    return Sensor(
        gamma=gamma,
        bright_share=bright_share,
        shoulder=shoulder,
        noise=noise,
        exposure=own.uniform(*config.exposure),
        vignetting=own.uniform(*config.vignetting),
        glare=own.uniform(*config.glare),
        bloom=own.uniform(*config.bloom),
        motion=own.uniform(*config.motion),
        defocus=own.uniform(*config.defocus),
        cast=tuple(cast / cast.max()),
        contrast=own.uniform(*config.contrast),
        shot_noise=own.uniform(*config.shot_noise),
        sharpen=own.uniform(*config.sharpen),
        jpeg=int(own.integers(config.jpeg[0], config.jpeg[1] + 1)),
    )


def expose(
    linear: np.ndarray,
    seen: np.ndarray,
    ray_z: np.ndarray,
    flow: np.ndarray | None,
    sensor: Sensor,
    rng: np.random.Generator,
    own: np.random.Generator,
) -> np.ndarray:
    """Linear radiance (H, W, 3) to the image (H, W, 3) float32; pixels outside seen (H, W) are black.

    ray_z (H, W) is cos psi; flow (H, W, 2) in pixels during the exposure, or None. `rng` draws exposure and read
    noise, `own` what came later.
    """
    if not seen.any():
        return np.zeros((*seen.shape, 3), np.float32)
    height = seen.shape[0]
    if flow is not None:
        linear = _moved(linear, flow)
    if sensor.defocus > 0:
        linear = _blurred(linear, seen, sensor.defocus * height)
    if sensor.vignetting > 0:
        linear = linear * (ray_z.clip(min=0) ** sensor.vignetting)[..., None]
    if sensor.glare > 0:
        veil = 0.5 * _blurred(linear, seen, 0.15 * height) + 0.5 * linear[seen].mean(0)
        linear = linear + sensor.glare * (veil - linear)

    # Auto exposure on the brightest channel.
    pixels = linear[seen]
    target = np.quantile(pixels.max(-1), 1 - sensor.bright_share)
    gain = float(np.exp(rng.normal(0, sensor.exposure))) / max(target, 1e-12)
    pixels = gain * pixels
    if sensor.bloom > 0:
        over = np.zeros_like(linear)
        over[seen] = np.clip(pixels - 1, 0, 20)
        spill = _blurred(over, None, 0.006 * height) + _blurred(over, None, 0.02 * height)
        pixels = pixels + sensor.bloom / 2 * spill[seen]
    if sensor.shot_noise > 0:
        pixels = pixels + sensor.shot_noise * np.sqrt(pixels) * own.standard_normal(pixels.shape)
    if min(sensor.cast) < 1:
        pixels = pixels * sensor.cast
    code = encode(torch.from_numpy(pixels), sensor.gamma).numpy()
    if sensor.contrast != 0:
        inside = code.clip(0, 1)
        code = code + sensor.contrast * inside * (1 - inside) * (2 * inside - 1)
    bend = max(1 - sensor.shoulder, 1e-3)
    excess = np.clip(code - sensor.shoulder, 0, None)
    code = np.where(excess > 0, sensor.shoulder + bend * (1.15 - 1.15 * np.exp(-excess / bend)), code)
    code = code + rng.normal(0, sensor.noise, code.shape)

    image = np.zeros((*seen.shape, 3))
    image[seen] = code
    if sensor.sharpen > 0:
        image += sensor.sharpen * (image - _blurred(image, seen, 0.006 * height))
    image = np.round(np.clip(image, 0, 1) * 255) / 255
    if sensor.jpeg < 100:
        image = _compressed(image, sensor.jpeg)
    image[~seen] = 0
    return image.astype(np.float32)


def _blurred(image: np.ndarray, seen: np.ndarray | None, sigma: float) -> np.ndarray:
    """Gaussian blur, normalised inside `seen`; wide ones at a reduced size."""
    small = max(1, int(sigma / 3))
    size = (-(-image.shape[1] // small), -(-image.shape[0] // small))
    whole = image.shape[1::-1]

    def smooth(array: np.ndarray) -> np.ndarray:
        if small > 1:
            array = cv2.resize(array, size, interpolation=cv2.INTER_AREA)
        array = cv2.GaussianBlur(array, (0, 0), sigma / small, borderType=cv2.BORDER_REPLICATE)
        return cv2.resize(array, whole, interpolation=cv2.INTER_LINEAR) if small > 1 else array

    image = image.astype(np.float32)
    if seen is None:
        return smooth(image)
    weight = seen.astype(np.float32)
    return smooth(image * weight[..., None]) / smooth(weight).clip(min=1e-3)[..., None]


def _moved(linear: np.ndarray, flow: np.ndarray, poses: int = 7) -> np.ndarray:
    """The mean over the exposure, from the middle frame's flow (H, W, 2)."""
    grid = np.stack(np.meshgrid(np.arange(linear.shape[1]), np.arange(linear.shape[0])), -1).astype(np.float32)
    image, total = linear.astype(np.float32), np.zeros(linear.shape, np.float32)
    for part in np.linspace(-0.5, 0.5, poses):
        at = grid + np.float32(part) * flow
        total += cv2.remap(image, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return total / poses


def _compressed(image: np.ndarray, quality: int) -> np.ndarray:
    options = [cv2.IMWRITE_JPEG_QUALITY, quality]  # OpenCV halves the chroma of colour images
    packed = cv2.imencode(".jpg", (image[..., ::-1] * 255).astype(np.uint8), options)[1]
    unpacked = cv2.imdecode(packed, cv2.IMREAD_COLOR)
    assert unpacked is not None
    return unpacked[..., ::-1].astype(np.float32) / 255
