"""Weights of the loss terms, and the constants inside them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from lightdepth.errors import InputError

SPACES = ("log", "encoded", "linear")
GAINS = ("free", "one")


@dataclass(frozen=True)
class LossConfig:
    """Weights of the terms and the constants inside them; the defaults are measured on synthetic colons with texture.

    Args:
        photometric: weight of the rendered against the seen light.
        space: what is compared: "log" brightness, "encoded" RGB as the camera wrote it, or "linear" RGB.
        gain: "free" (each image's median log ratio is taken out) or "one" (as calibrated: distance gets its scale).
        ssim: weight of the structural dissimilarity of rendered and seen RGB.
        saturated: weight of the one-sided term on saturated pixels.
        specular: weight of "a highlight faces the light".
        facing: weight of the term against grazing surfaces.
        smoothness: weight of the edge-aware second differences, at 112 rows.
        chroma: weight of the albedo's hue and saturation.
        albedo: weight of the albedo's own smoothness.
        self_supervised: weight of all of the above together.
        supervised: weight of the terms that compare with true distance (0: truth is never read for them).
        uncertainty: weight of the uncertainty head's likelihood of the true error; no other weights learn from it.
        reflectance: of the wall, for the indirect light; null takes each image's calibrated value.
        cosine_exponent: q of cos^q; the cosine is weaker in endoscopes than Lambert's 1.
        cosine_floor: cosines below are rendered as this.
        ambient: light on every pixel that is not the wall's, such as stray light in the lens, as a share of the mean
            light that is rendered.
        shoulder: code from which the camera's tone curve bends; seen images are straightened from there. 1 is none.
        huber: where the photometric term turns from square to linear, in its space; 0 is L1.
        white: brightness from which a pixel counts as saturated.
        bounces: of the indirect light.
        pool: pixels per side of an element of the indirect light, in images of up to 128 rows; more in larger ones.
    """

    photometric: float = 1.0
    space: Literal["log", "encoded", "linear"] = "log"
    gain: Literal["free", "one"] = "free"
    ssim: float = 0.0
    saturated: float = 0.3
    specular: float = 0.0
    facing: float = 2.0
    smoothness: float = 50.0
    chroma: float = 1.0
    albedo: float = 0.0
    self_supervised: float = 1.0
    supervised: float = 0.0
    uncertainty: float = 0.0
    reflectance: float | None = 0.6
    cosine_exponent: float = 0.5
    cosine_floor: float = 0.03
    ambient: float = 0.0
    shoulder: float = 1.0
    huber: float = 0.05
    white: float = 0.97
    bounces: int = 3
    pool: int = 8

    def __post_init__(self) -> None:
        for what, value, allowed in (("space", self.space, SPACES), ("gain", self.gain, GAINS)):
            if value not in allowed:
                raise InputError(f"loss {what} {value!r}; expected one of {', '.join(allowed)}")
        negative = [
            name for name in (*TERMS, "self_supervised", "supervised", "uncertainty") if getattr(self, name) < 0
        ]
        if negative or self.huber < 0:
            raise InputError(f"loss {', '.join(negative) or 'huber'} below 0; expected weights of at least 0")
        if self.ambient < 0 or not 0.2 <= self.shoulder <= 1:
            raise InputError(f"loss ambient {self.ambient}, shoulder {self.shoulder}; expected at least 0, and .2 to 1")


TERMS = ("photometric", "ssim", "saturated", "specular", "facing", "smoothness", "chroma", "albedo")
"""The terms that need no truth."""
