"""Weights of the loss terms, and the constants inside them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from lightdepth.errors import InputError
from lightdepth.ranges import BELOW_ONE, SHARE, Range, at_least, checked

SPACES = ("log", "encoded", "linear")
GAINS = ("free", "one")


@dataclass(frozen=True)
@checked
class LossConfig:
    """Weights of the loss terms, and the constants inside them; the defaults are measured on synthetic colons."""

    photometric: Annotated[float, at_least(0)] = 1.0
    """Weight of the main term of the loss: the difference between the light that is seen and that which the predicted
    distance would give (the rendered light). A larger one makes distance follow brightness more closely; 0 leaves it
    out."""
    space: Literal["log", "encoded", "linear"] = "log"
    """What the photometric term compares: "log", the log of brightness (the largest of R, G and B); "encoded", RGB as
    the camera wrote it; "linear", RGB in proportion to light. With the last two the albedo (the wall's colour) has to
    fit as well."""
    gain: Literal["free", "one"] = "free"
    """Factor between rendered and seen light: "free" fits one to each image (by the median), so that only the shape of
    distance is learnt; "one" takes 1, so that brightness must give the scale of distance too, for which
    --model.network.output has to be free."""
    ssim: Annotated[float, at_least(0)] = 0.0
    """Weight of how much rendered and seen RGB differ in structure (structural similarity, SSIM), compared in windows
    of 5 x 5 pixels; 0 leaves it out. A larger one follows the edges and the texture of the image more closely."""
    saturated: Annotated[float, at_least(0)] = 0.3
    """Weight of the term on saturated pixels (see `white`), which counts only what is rendered darker than seen, as if
    the rendered image were clipped at white too; 0 leaves it out. A larger one pulls wall that is too bright to measure
    nearer to the camera."""
    specular: Annotated[float, at_least(0)] = 0.0
    """Weight of the term on highlights (small saturated patches, see `highlight_size`), where the wall faces the light;
    0 leaves it out. A larger one turns the wall there more towards the camera."""
    highlight_size: Annotated[float, SHARE] = 0.005
    """Largest patch of saturated pixels that counts as a highlight for `specular`, as a share, in [0, 1], of the
    image's pixels inside the mask. A larger one takes near wall that is clipped for highlights too; 1 leaves size
    out."""
    highlight_contrast: Annotated[float, SHARE] = 0.1
    """Least difference in brightness, in [0, 1], between such a patch and the wall around it, from which it counts as a
    highlight for `specular`. A larger one leaves fewer of them; 0 does not look around."""
    facing: Annotated[float, at_least(0)] = 2.0
    """Weight of the term against wall that is seen nearly edge-on (cosine between its normal and the line of sight
    below `cosine_floor`); 0 leaves it out. A larger one turns such wall more towards the camera."""
    smoothness: Annotated[float, at_least(0)] = 50.0
    """Weight of how much the surface bends (second differences of log distance), counted less at edges of brightness;
    it means the same at every image size. A larger one makes smoother surfaces; 0 leaves it out."""
    chroma: Annotated[float, at_least(0)] = 1.0
    """Weight of the difference in hue and saturation between the predicted albedo (the wall's own colour) and the
    image; 0 leaves it out. A larger one keeps the albedo's colours closer to the image's."""
    albedo: Annotated[float, at_least(0)] = 0.0
    """Weight of the changes of the predicted albedo (the wall's own colour) from pixel to pixel; 0 leaves it out. A
    larger one makes the albedo more even."""
    self_supervised: Annotated[float, at_least(0)] = 1.0
    """Factor on the weights from photometric to albedo, whose terms need no truth; 0 leaves them out. A larger one
    gives them more weight against `supervised`; without that it changes next to nothing."""
    supervised: Annotated[float, at_least(0)] = 0.0
    """Weight of the term that compares with true distance, up to one factor per image; at 0, truth is not read for it.
    A larger one gives truth more weight against the terms that need none."""
    uncertainty: Annotated[float, at_least(0)] = 0.0
    """Weight of the term that teaches the uncertainty head how large the error against true distance is; 0 leaves it
    out, and nothing but that head learns from it. A larger one changes little, as AdamW evens out the size of
    gradients."""
    reflectance: Annotated[float | None, BELOW_ONE] = 0.6
    """Share of light, in [0, 1), that the wall reflects onto other wall, when images are rendered; null takes the value
    calibrated for each image, 0 renders direct light alone. A larger one renders more indirect light."""
    cosine_exponent: Annotated[float, at_least(0, up_to=100)] = 0.5
    """Exponent of the cosine of the angle at which light meets the wall, in rendered light: 1 is a matt (Lambert's)
    wall; at 0 the angle counts for nothing. A larger one renders slanted wall darker."""
    cosine_floor: Annotated[float, BELOW_ONE] = 0.03
    """Least cosine of the angle at which light meets the wall, below 1: what is more slanted is rendered as
    if it had this one, and `facing` counts it. A larger one renders edge-on wall brighter and makes more of it
    count."""
    ambient: Annotated[float, at_least(0)] = 0.0
    """Light that is rendered on every pixel besides the wall's, such as stray light in the lens, as a share of the
    image's mean rendered light; 0 for none. A larger one takes more of the light in dark parts for stray light, and so
    puts them farther away."""
    shoulder: Annotated[float, Range(0.2, 1)] = 1.0
    """Brightness of a pixel, from .2 to 1, above which the camera is taken to compress bright light; this is undone
    before images are compared. A higher one undoes less, and 1 nothing."""
    huber: Annotated[float, at_least(0)] = 0.05
    """Difference between rendered and seen light below which the photometric and saturated terms grow with its square,
    and above which they grow in proportion to it; 0 is proportion throughout (L1). Its unit is that of `space`: natural
    log of brightness, or values in [0, 1]. A larger one makes small differences count less against large ones."""
    white: Annotated[float, SHARE] = 0.97
    """Brightness (the largest of R, G and B), in [0, 1], from which a pixel counts as saturated and is left to the
    terms `saturated` and, in highlights, `specular`. A higher one leaves fewer pixels to them, and more to the
    photometric term."""
    bounces: Annotated[int, at_least(0, up_to=1000)] = 3
    """Number of times that reflected light is passed on to other wall, in rendered light; it matters only where
    `reflectance` is above 0. More are more exact and take longer."""
    pool: Annotated[int, at_least(1, up_to=10_000)] = 8
    """Side of the squares of the image that light each other in the indirect light, pixels, in images of up to 128
    rows; in larger ones it grows with their height. A larger one is coarser and faster."""

    def __post_init__(self) -> None:
        for what, value, allowed in (("space", self.space, SPACES), ("gain", self.gain, GAINS)):
            if value not in allowed:
                raise InputError(f"loss {what}", f"{value!r} is not known", f"expected one of {', '.join(allowed)}")


TERMS = ("photometric", "ssim", "saturated", "specular", "facing", "smoothness", "chroma", "albedo")
"""The terms that need no truth."""
