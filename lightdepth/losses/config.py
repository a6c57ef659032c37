"""Weights of the loss terms, and the constants inside them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from lightdepth.errors import InputError

SPACES = ("log", "encoded", "linear")
GAINS = ("free", "one")


@dataclass(frozen=True)
class LossConfig:
    """Weights of the loss terms, and the constants inside them; the defaults are measured on synthetic colons."""

    photometric: float = 1.0
    """Weight of the difference between rendered and seen light. A larger one follows the light more closely."""
    space: Literal["log", "encoded", "linear"] = "log"
    """What is compared: "log" brightness, "encoded" RGB as the camera wrote it, or "linear" RGB."""
    gain: Literal["free", "one"] = "free"
    """Whether the gain is "free" (each image's median log ratio is taken out) or "one" (as calibrated: distance gets
    its scale)."""
    ssim: float = 0.0
    """Weight of the structural dissimilarity of rendered and seen RGB. A larger one follows the image's structure
    more closely."""
    saturated: float = 0.3
    """Weight of the one-sided term on saturated pixels, which must not be rendered darker than white. A larger one
    pulls such wall nearer."""
    specular: float = 0.0
    """Weight of the term by which "a highlight faces the light". A larger one turns the wall under highlights more
    towards the lamp."""
    facing: float = 2.0
    """Weight of the term against grazing surfaces, whose cosine is below `cosine_floor`. A larger one turns such wall
    more towards the viewer."""
    smoothness: float = 50.0
    """Weight of the edge-aware second differences of log distance, at 112 rows. A larger one makes smoother
    surfaces."""
    chroma: float = 1.0
    """Weight of the difference of the albedo's hue and saturation from the image's. A larger one keeps the albedo's
    colours closer to it."""
    albedo: float = 0.0
    """Weight of the albedo's own smoothness. A larger one makes smoother albedo."""
    self_supervised: float = 1.0
    """Weight of all terms that need no truth, together. A larger one counts them for more against those with
    truth."""
    supervised: float = 0.0
    """Weight of the terms that compare with true distance; at 0, truth is never read for them. A larger one counts
    truth for more."""
    uncertainty: float = 0.0
    """Weight of the uncertainty head's likelihood of the true error; no other weights of the network learn from it. A
    larger one makes that head learn faster."""
    reflectance: float | None = 0.6
    """Share of the light that the wall throws back, for the indirect light; null takes each image's calibrated value.
    A larger one renders more indirect light."""
    cosine_exponent: float = 0.5
    """Exponent q of cos^q in the rendered light; the cosine is weaker in endoscopes than Lambert's 1. A larger one
    renders slanted wall darker."""
    cosine_floor: float = 0.03
    """Least cosine between wall and light that is rendered; a smaller one counts as grazing, which `facing` weighs. A
    larger one renders grazing wall brighter."""
    ambient: float = 0.0
    """Light on every pixel that is not the wall's, such as stray light in the lens, as a share of the mean light that
    is rendered. A larger one explains dark parts by stray light."""
    shoulder: float = 1.0
    """Code value, in [0, 1], from which the camera's tone curve bends; seen images are straightened from there. A
    higher one straightens less, and 1 nothing."""
    huber: float = 0.05
    """Residual, in the units of `space`, at which the photometric term turns from square to linear; 0 is L1. A larger
    one weighs small residuals less against large ones."""
    white: float = 0.97
    """Brightness, in [0, 1], from which a pixel counts as saturated. A higher one counts fewer pixels."""
    bounces: int = 3
    """Number of bounces of the indirect light from wall to wall. More are more exact and take longer."""
    pool: int = 8
    """Side of an element of the indirect light, pixels, in images of up to 128 rows; it is more in larger ones. A
    larger one is coarser and faster."""

    def __post_init__(self) -> None:
        for what, value, allowed in (("space", self.space, SPACES), ("gain", self.gain, GAINS)):
            if value not in allowed:
                raise InputError(f"loss {what}", f"{value!r} is not known", f"expected one of {', '.join(allowed)}")
        negative = [
            name for name in (*TERMS, "self_supervised", "supervised", "uncertainty") if getattr(self, name) < 0
        ]
        if negative or self.huber < 0:
            raise InputError(f"loss {', '.join(negative) or 'huber'}", "below 0", "expected weights of at least 0")
        if self.ambient < 0 or not 0.2 <= self.shoulder <= 1:
            raise InputError(
                "loss", f"ambient {self.ambient}, shoulder {self.shoulder}", "expected at least 0, and .2 to 1"
            )


TERMS = ("photometric", "ssim", "saturated", "specular", "facing", "smoothness", "chroma", "albedo")
"""The terms that need no truth."""
