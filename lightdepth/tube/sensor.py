"""What an endoscope does to the light that it receives: lens, exposure, response, processor.

Notation: linear images (B, 3, H, W), L the radiance with gain 1; codes in [0, 1]. In order: motion and focus blur,
vignetting cos^k psi, veiling glare L + g (mean - L), exposure, blooming of what is above white, colour cast, response
v^(1/gamma), contrast, shoulder, noise, sharpening, rounding to 8 bits, JPEG.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from kornia.filters import gaussian_blur2d
from torch import Tensor

from lightdepth.photometry import bent, encode
from lightdepth.ranges import BELOW_ONE, SHARE, Range, at_least, checked, ends_of


@dataclass(frozen=True)
@checked
class SensorConfig:
    """Light and camera of one endoscope; pairs are the ends of a uniform range. (0, 0) switches an effect off where
    nothing else is said; everything from cosine_exponent on is off."""

    gamma: Annotated[tuple[float, float], ends_of(Range(0.1, 10))] = (2.0, 2.6)
    """Ends of the range of the exponent gamma of the camera's response: light v, in [0, 1], becomes the code
    v^(1/gamma). A larger one brightens dark parts more."""
    mu: Annotated[tuple[float, float], ends_of(at_least(0, up_to=100))] = (2.2, 3.4)
    """Ends of the range of the exponent mu of the light's spread exp(-mu (1 - cos psi)), psi the angle from its axis.
    A larger one makes a narrower light."""
    light_offset: Annotated[float, at_least(0, up_to=1000)] = 2.0
    """Root mean square of the distance by which the light sits beside the camera, mm, drawn for each endoscope. A
    larger one puts lamps farther from the camera."""
    reflectance: Annotated[tuple[float, float], ends_of(BELOW_ONE)] = (0.0, 0.7)
    """Ends of the range of the wall's reflectance: the share of the light falling on it that it reflects onto other
    wall. A larger one makes more indirect light."""
    specular: Annotated[tuple[float, float], ends_of(at_least(0))] = (0.0, 0.5)
    """Ends of the range of a factor on the strength of highlights (mirrored light of the lamp). A larger one makes
    brighter highlights; (0, 0) makes none."""
    bright_share: Annotated[tuple[float, float], ends_of(SHARE)] = (0.03, 0.2)
    """Ends of the range of the share of an image's pixels that reach full brightness under auto exposure. A larger one
    makes brighter images."""
    shoulder: Annotated[tuple[float, float], ends_of(SHARE)] = (0.75, 1.0)
    """Ends of the range of the code value (brightness as stored), in [0, 1], from which the tone curve flattens towards
    white, drawn for each colon. A larger one flattens less of the curve; (1, 1) none of it."""
    noise: Annotated[tuple[float, float], ends_of(SHARE)] = (0.003, 0.012)
    """Ends of the range of the standard deviation of the noise that does not depend on the light, in code values
    (brightness as stored, in [0, 1]). A larger one makes noisier images."""
    exposure: Annotated[tuple[float, float], ends_of(at_least(0, up_to=10))] = (0.1, 0.1)
    """Ends of the range of the standard deviation of the log of the exposure from frame to frame (0.1 is about 10 %). A
    larger one makes brightness jump more."""
    cosine_exponent: Annotated[tuple[float, float], ends_of(at_least(0, up_to=100))] = (1.0, 1.0)
    """Ends of the range of the exponent on the cosine between the wall's normal and the direction to the lamp: 1 is a
    matt wall (Lambert); rough walls have less, satin ones more. A larger one makes slanted wall darker."""
    gloss: Annotated[tuple[float, float], ends_of(at_least(0))] = (60.0, 60.0)
    """Ends of the range of the exponent of the lobe of highlights (as in Phong's model). A larger one makes smaller,
    sharper highlights."""
    roughness: Annotated[tuple[float, float], ends_of(at_least(0, up_to=100))] = (0.1, 0.1)
    """Ends of the range of the slope, a ratio of height to length, of bumps about a millimetre wide that break up
    highlights. A larger one scatters highlights more."""
    sparkle: Annotated[tuple[float, float], ends_of(at_least(0, up_to=100))] = (0.0, 0.0)
    """Ends of the range of the slope, a ratio of height to length, of relief tenths of a millimetre wide. A larger one
    breaks highlights into more sparks; (0, 0) has no such relief."""
    vignetting: Annotated[tuple[float, float], ends_of(at_least(0, up_to=100))] = (0.0, 0.0)
    """Ends of the range of the exponent k of vignetting: the lens darkens by cos^k of the angle from its axis; (0, 0)
    is none. A larger one makes darker corners."""
    glare: Annotated[tuple[float, float], ends_of(SHARE)] = (0.0, 0.0)
    """Ends of the range of the share of the light that the lens spreads over the rest of the image. A larger one veils
    dark parts more; (0, 0) makes none."""
    bloom: Annotated[tuple[float, float], ends_of(SHARE)] = (0.0, 0.0)
    """Ends of the range of the share of the light above white that spills over to the pixels around. A larger one makes
    brighter halos around saturated spots; (0, 0) makes none."""
    motion: Annotated[tuple[float, float], ends_of(SHARE)] = (0.0, 0.0)
    """Ends of the range of the length of motion blur (median over an image's pixels, on average over images), as a
    share of the image height. A larger one blurs more; (0, 0) makes none."""
    defocus: Annotated[tuple[float, float], ends_of(SHARE)] = (0.0, 0.0)
    """Ends of the range of the sigma (radius) of the defocus blur, as a share of the image height. A larger one blurs
    more; (0, 0) makes none."""
    cast: Annotated[tuple[float, float], ends_of(at_least(0, up_to=10))] = (0.0, 0.0)
    """Ends of the range of the standard deviation of the log of each colour channel's gain (0.06 is about 6 %). A
    larger one makes stronger colour casts; (0, 0) makes none."""
    contrast: Annotated[tuple[float, float], ends_of(Range(-1, 1))] = (0.0, 0.0)
    """Ends of the range of a factor, from -1 to 1, on an S-shaped bend of the tone curve; 0 leaves it, below 0 flattens
    it. A larger one makes more contrast."""
    shot_noise: Annotated[tuple[float, float], ends_of(SHARE)] = (0.0, 0.0)
    """Ends of the range of the standard deviation, at white, of the noise that grows with the root of the light, as a
    share of white. A larger one makes noisier images; (0, 0) makes none."""
    sharpen: Annotated[tuple[float, float], ends_of(at_least(0, up_to=100))] = (0.0, 0.0)
    """Ends of the range of the weight with which the processor adds fine detail back (unsharp masking); (0, 0) is none.
    A larger one makes harder edges."""
    jpeg: Annotated[tuple[int, int], ends_of(Range(0, 100))] = (100, 100)
    """Ends of the range of the JPEG quality, a number from 0 to 100, with colour at half resolution; at 100 images are
    not compressed. A higher one leaves fewer artefacts."""


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
    linear: Tensor,
    seen: Tensor,
    ray_z: Tensor,
    flow: Tensor | None,
    sensor: Sensor,
    rng: np.random.Generator,
    owns: Sequence[np.random.Generator],
) -> np.ndarray:
    """Linear radiance (B, 3, H, W) to images (B, H, W, 3) float32; pixels outside seen (B, H, W) are black.

    ray_z (H, W) is cos psi; flow (B, H, W, 2) in pixels during the exposure, or None. `rng` draws exposure and read
    noise, one of `owns` for each view what came later.
    """
    height, inside = seen.shape[1], seen[:, None]
    if flow is not None:
        linear = _moved(linear, flow)
    if sensor.defocus > 0:
        linear = _blurred(linear, inside, sensor.defocus * height)
    if sensor.vignetting > 0:
        linear = linear * ray_z.clamp(min=0) ** sensor.vignetting
    if sensor.glare > 0:
        mean = (linear * inside).sum((2, 3), keepdim=True) / inside.sum((2, 3), keepdim=True).clamp(min=1)
        veil = 0.5 * _blurred(linear, inside, 0.15 * height) + 0.5 * mean
        linear = linear + sensor.glare * (veil - linear)

    # Auto exposure on the brightest channel.
    target = quantiles(linear.amax(1), seen, 1 - sensor.bright_share)
    exposure, noise = _draws(seen, sensor, rng)
    pixels = linear * (exposure / target.clamp(min=1e-12))
    if sensor.bloom > 0:
        over = (pixels - 1).clamp(0, 20) * inside
        spill = _blurred(over, None, 0.006 * height) + _blurred(over, None, 0.02 * height)
        pixels = pixels + sensor.bloom / 2 * spill
    if sensor.shot_noise > 0:
        pixels = pixels + sensor.shot_noise * pixels.clamp(min=0).sqrt() * on_pixels(
            seen, lambda view, count: owns[view].standard_normal((count, 3))
        )
    if min(sensor.cast) < 1:
        pixels = pixels * torch.tensor(sensor.cast, device=pixels.device, dtype=pixels.dtype).reshape(1, 3, 1, 1)
    code = encode(pixels, sensor.gamma)
    if sensor.contrast != 0:
        mid = code.clamp(0, 1)
        code = code + sensor.contrast * mid * (1 - mid) * (2 * mid - 1)
    image = (bent(code, sensor.shoulder) + noise) * inside
    if sensor.sharpen > 0:
        image = image + sensor.sharpen * (image - _blurred(image, inside, 0.006 * height))
    image = (image.clamp(0, 1) * 255).round() / 255 * inside
    images = image.permute(0, 2, 3, 1).cpu().numpy()
    if sensor.jpeg < 100:
        images = np.stack([_compressed(one, sensor.jpeg) for one in images]) * seen.cpu().numpy()[..., None]
    return images


def quantiles(values: Tensor, seen: Tensor, share: float) -> Tensor:
    """The quantile (B, 1, 1, 1) of each of values (B, H, W) inside seen, 0 where nothing is."""
    found = values.new_zeros(len(values), 1, 1, 1)
    for view, (one, inside) in enumerate(zip(values, seen, strict=True)):
        chosen = one[inside]
        if len(chosen):
            at = share * (len(chosen) - 1)
            low = int(at)
            below, above = (chosen.kthvalue(min(k, len(chosen) - 1) + 1).values for k in (low, low + 1))
            found[view] = torch.lerp(below, above, at - low)
    return found


def on_pixels(seen: Tensor, draw: Callable[[int, int], np.ndarray]) -> Tensor:
    """What draw(view, count) gives, (count, 3), for the pixels of each view inside seen: (B, 3, H, W)."""
    drawn = np.zeros((*seen.shape, 3), np.float32)
    for view, inside in enumerate(seen.cpu().numpy()):
        if inside.any():
            drawn[view, inside] = draw(view, int(inside.sum()))
    return torch.from_numpy(drawn).to(seen.device).permute(0, 3, 1, 2)


def _draws(seen: Tensor, sensor: Sensor, rng: np.random.Generator) -> tuple[Tensor, Tensor]:
    """Exposure (B, 1, 1, 1) and read noise (B, 3, H, W): one view's after the other's, whatever the batch."""
    exposure = torch.ones(len(seen), 1, 1, 1)

    def draw(view: int, count: int) -> np.ndarray:
        exposure[view] = float(np.exp(rng.normal(0, sensor.exposure)))
        return rng.normal(0, sensor.noise, (count, 3))

    noise = on_pixels(seen, draw)
    return exposure.to(seen.device), noise


def _blurred(image: Tensor, seen: Tensor | None, sigma: float) -> Tensor:
    """Gaussian blur of (B, C, H, W), normalised inside `seen` (B, 1, H, W); wide ones at a reduced size."""
    whole = image.shape[-2:]
    small = max(1, int(sigma / 3))
    size = 2 * round(4 * sigma / small) + 1

    def smooth(values: Tensor) -> Tensor:
        if small > 1:
            values = F.interpolate(values, [-(-n // small) for n in whole], mode="area")
        values = gaussian_blur2d(values, size, (sigma / small, sigma / small), "replicate")
        return F.interpolate(values, whole, mode="bilinear", align_corners=False) if small > 1 else values

    if seen is None:
        return smooth(image)
    weighted = smooth(torch.cat([image * seen, seen.to(image.dtype)], 1))
    return weighted[:, :-1] / weighted[:, -1:].clamp(min=1e-3)


def _moved(linear: Tensor, flow: Tensor, poses: int = 7) -> Tensor:
    """The mean over the exposure, from the middle frame's flow (B, H, W, 2)."""
    height, width = linear.shape[-2:]
    per_pixel = torch.tensor([2 / width, 2 / height], device=linear.device)
    rows, columns = (torch.arange(n, device=linear.device) + 0.5 for n in (height, width))
    grid = torch.stack(torch.meshgrid(columns, rows, indexing="xy"), -1) * per_pixel - 1
    total = torch.zeros_like(linear)
    for part in torch.linspace(-0.5, 0.5, poses).tolist():
        at = grid + part * flow * per_pixel
        total += F.grid_sample(linear, at, mode="bilinear", padding_mode="border", align_corners=False)
    return total / poses


def _compressed(image: np.ndarray, quality: int) -> np.ndarray:
    options = [cv2.IMWRITE_JPEG_QUALITY, quality]  # OpenCV halves the chroma of colour images
    packed = cv2.imencode(".jpg", np.round(image[..., ::-1] * 255).astype(np.uint8), options)[1]
    unpacked = cv2.imdecode(packed, cv2.IMREAD_COLOR)
    assert unpacked is not None
    return unpacked[..., ::-1].astype(np.float32) / 255
