"""Image formation under a light that travels with the camera (LightDepth; spot light of Modrzejewski 2020).

Notation: d distance from the camera centre to the surface, r unit viewing ray, x = d r; P light position, D its unit
direction, l = (x - P) / |x - P|, mu its spread; n unit normal, cos = n · (-l); rho albedo in [0, 1]; gain g.
Radiance is linear; `encode` applies the response of gamma, `bent` the tone curve's shoulder. Images are (B, C, H, W),
light terms (B, 1, 1, 1).

    linear = g · (rho · (exp(-mu (1 - D · l)) · cos^q / |x - P|²  +  indirect) + ambient)
    image  = min(bent(linear^(1/gamma)), 1)

1/pi and the light's radiance are absorbed by the unit of d: with gain 1, a white wall that faces the light on its axis
is exactly white at distance 1.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from lightdepth.errors import InputError
from lightdepth.geometry import length

DEFAULT_GAMMA, DEFAULT_MU = 2.2, 2.767


@dataclass(frozen=True)
class MeasuredLamps:
    """The lamps that a light consists of, and how well their place is known, where it was measured.

    `positions_mm` in camera axes; `shares` of the light, sum 1; `deviation_mm` the standard deviation of the light's
    position in x, y and z; `lens_mu` how much of the light's mu is the lens's own darkening to the side, which stays
    with the camera's axis.
    """

    positions_mm: tuple[tuple[float, float, float], ...]
    shares: tuple[float, ...]
    deviation_mm: tuple[float, float, float]
    lens_mu: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "positions_mm", tuple(tuple(map(float, place)) for place in self.positions_mm))
        object.__setattr__(self, "shares", tuple(map(float, self.shares)))
        object.__setattr__(self, "deviation_mm", tuple(map(float, self.deviation_mm)))
        sizes = [*map(len, self.positions_mm), len(self.deviation_mm)]
        if not self.positions_mm or set(sizes) != {3} or len(self.shares) != len(self.positions_mm):
            raise InputError(
                "lamps",
                f"{len(self.positions_mm)} positions, {len(self.shares)} shares",
                "expected a share for each position, and 3 numbers for each position and for the deviation",
            )
        numbers = [*np.ravel(self.positions_mm), *self.shares, *self.deviation_mm, self.lens_mu]
        if not np.isfinite(numbers).all():
            raise InputError("lamps", "a value is not finite", "expected numbers")
        if min(self.shares) <= 0 or abs(sum(self.shares) - 1) > 0.01 or min(self.deviation_mm) < 0:
            raise InputError(
                "lamps",
                f"shares {self.shares}, deviation {self.deviation_mm}",
                "expected shares above 0 whose sum is 1, and deviations of at least 0",
            )


@dataclass(frozen=True)
class PhotometricCalibration:
    """Light and response of one endoscope. `position_mm` in camera axes; `direction` is normalised at birth.

    `reflectance` is the share of light that the wall reflects for other wall to receive (radiosity's rho).
    `source` says where the numbers come from: measured, fitted (on a sparse map, whose light explains its points best
    and need not be the endoscope's own), published, given (by somebody who did not say) or assumed. `lamps` is what is
    known besides of a light whose position was measured: only what looks for millimetres takes each lamp, all else the
    one light at `position_mm`, the mean of its lamps, which at distances large against their own is the same.
    """

    gamma: float = DEFAULT_GAMMA
    mu: float = DEFAULT_MU
    position_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    direction: tuple[float, float, float] = (0.0, 0.0, 1.0)
    gain: float = 1.0
    reflectance: float = 0.0
    source: str = "assumed"
    lamps: MeasuredLamps | None = None

    def __post_init__(self) -> None:
        if isinstance(self.lamps, Mapping):  # of a record that was written as JSON
            object.__setattr__(self, "lamps", MeasuredLamps(**self.lamps))
        if len(self.position_mm) != 3 or len(self.direction) != 3:
            raise InputError(
                "light", f"position_mm {self.position_mm}, direction {self.direction}", "expected 3 numbers each"
            )
        numbers = [self.gamma, self.mu, self.gain, self.reflectance, *self.position_mm, *self.direction]
        if not np.isfinite(numbers).all():
            raise InputError("light", "a value is not finite", "expected numbers")
        if not 0.2 <= self.gamma <= 10:
            raise InputError(
                "light", f"gamma {self.gamma}", "expected a response exponent between 0.2 and 10, usually 2.2"
            )
        if self.mu < 0 or self.gain <= 0 or not 0 <= self.reflectance < 1:
            raise InputError(
                "light",
                f"mu {self.mu}, gain {self.gain}, reflectance {self.reflectance}",
                "expected mu >= 0, gain > 0 and 0 <= reflectance < 1",
            )
        length = float(np.linalg.norm(self.direction))
        if length == 0:
            raise InputError("light", "direction is zero", "expected a vector into the scene such as [0, 0, 1]")
        object.__setattr__(self, "direction", tuple(float(v) / length for v in self.direction))
        object.__setattr__(self, "position_mm", tuple(map(float, self.position_mm)))

    @property
    def assumed(self) -> bool:
        """Whether nobody gave this light: it is another endoscope's, whatever its numbers are."""
        return self.source == "assumed"

    def co_located(self) -> PhotometricCalibration:
        """The same light moved to the camera centre and turned along the axis: what an up-to-scale distance can use."""
        return replace(self, position_mm=(0.0, 0.0, 0.0), direction=(0.0, 0.0, 1.0), lamps=None)

    def terms(self, dtype: torch.dtype = torch.float32) -> LightTerms:
        """Tensors for one image (batch of 1)."""

        def shaped(value: float | tuple[float, ...]) -> Tensor:
            return torch.tensor(value, dtype=dtype).reshape(1, -1, 1, 1)

        return LightTerms(
            gamma=shaped(self.gamma),
            mu=shaped(self.mu),
            gain=shaped(self.gain),
            reflectance=shaped(self.reflectance),
            position=shaped(self.position_mm),
            direction=shaped(self.direction),
        )


class LightTerms(NamedTuple):
    """A batch of lights: scalars (B, 1, 1, 1), vectors (B, 3, 1, 1). Position in the unit of distance."""

    gamma: Tensor
    mu: Tensor
    gain: Tensor
    reflectance: Tensor
    position: Tensor
    direction: Tensor

    def co_located(self) -> LightTerms:
        """At the camera centre, along the axis."""
        axis = torch.zeros_like(self.direction)
        axis[:, 2] = 1.0
        return self._replace(position=torch.zeros_like(self.position), direction=axis)


def light_distance(distance: Tensor, rays: Tensor, light: LightTerms) -> tuple[Tensor, Tensor]:
    """|x - P| (B, 1, H, W) and l (B, 3, H, W)."""
    from_light = distance * rays - light.position
    reach = length(from_light)
    return reach, from_light / reach


def spread(towards: Tensor, light: LightTerms) -> Tensor:
    """exp(-mu (1 - D · l)), (B, 1, H, W)."""
    return torch.exp(-light.mu * (1 - (light.direction * towards).sum(-3, keepdim=True)))


def irradiance(
    distance: Tensor,
    normals: Tensor,
    rays: Tensor,
    light: LightTerms,
    cosine_exponent: float = 1.0,
    cosine_floor: float = 0.0,
) -> Tensor:
    """Direct light that falls on the surface: exp(-mu (1 - D · l)) cos^q / |x - P|², (B, 1, H, W)."""
    length, towards = light_distance(distance, rays, light)
    cosine = (-towards * normals).sum(-3, keepdim=True).clamp(min=cosine_floor)
    if cosine_exponent != 1.0:
        cosine = cosine.clamp(min=1e-6) ** cosine_exponent
    return spread(towards, light) * cosine / length.square().clamp(min=1e-12)


def render(
    distance: Tensor,
    normals: Tensor,
    rays: Tensor,
    albedo: Tensor,
    light: LightTerms,
    indirect: Tensor | float = 0.0,
    cosine_exponent: float = 1.0,
    ambient: Tensor | float = 0.0,
    shoulder: float = 1.0,
    saturate: bool = False,
) -> Tensor:
    """The encoded image (B, C, H, W). Without `saturate` it is not clipped: values above 1 are what the sensor would
    saturate.

    `indirect` is light from the wall on the wall (lightdepth.radiosity), `ambient` what reaches the sensor without the
    wall's colour, such as stray light in the lens: both in units of irradiance. `shoulder` is the code from which the
    tone curve bends, 1 for none.
    """
    direct = irradiance(distance, normals, rays, light, cosine_exponent)
    code = bent(encode(light.gain * (albedo * (direct + indirect) + ambient), light.gamma), shoulder)
    return code.clamp(max=1) if saturate else code


def encode(linear: Tensor, gamma: Tensor | float) -> Tensor:
    """Linear radiance to the camera's code values: v^(1/gamma), 0 (with gradient 0) where it is not positive."""
    lit = linear > 0  # the power's slope at 0 is infinite: times the zero gradient of a clamped cosine it makes NaN
    return torch.where(lit, torch.where(lit, linear, 1.0) ** (1 / gamma), 0.0)


def decode(image: Tensor, gamma: Tensor | float) -> Tensor:
    """Code values to linear radiance: v^gamma."""
    return image.clamp(min=0) ** gamma


_REACH = 1.15
"""How far above the shoulder s the tone curve ends, over 1 - s: it passes 1, so that sensors saturate."""


def bent(code: Tensor, shoulder: float) -> Tensor:
    """The end of a tone curve: codes above the shoulder s become s + 1.15 (1 - s) (1 - exp(-(code - s) / (1 - s)))."""
    if shoulder >= 1:
        return code
    room = 1 - shoulder
    excess = (code - shoulder).clamp(min=0)
    return torch.where(excess > 0, shoulder + room * (_REACH - _REACH * (-excess / room).exp()), code)


def straightened(code: Tensor, shoulder: float) -> Tensor:
    """The inverse of `bent`; where a code is above what the curve reaches, a large number."""
    if shoulder >= 1:
        return code
    room = 1 - shoulder
    left = (1 - (code - shoulder).clamp(min=0) / (_REACH * room)).clamp(min=1e-3)
    return torch.where(code > shoulder, shoulder - room * left.log(), code)


def brightness(image: Tensor) -> Tensor:
    """V = max(R, G, B), the channel that carries no albedo when the albedo's value is 1. (B, 1, H, W)"""
    return image.amax(-3, keepdim=True)


def hue_saturation_albedo(hue_saturation: Tensor) -> Tensor:
    """RGB albedo with value 1 from (hue, saturation) in [0, 1], (B, 2, H, W) -> (B, 3, H, W).

    Hue is stored half a turn off (0.5 = red), so that tissue, which is red, does not sit on the seam of the circle.
    """
    hue, saturation = hue_saturation[..., :1, :, :] + 0.5, hue_saturation[..., 1:, :, :]
    offsets = torch.tensor([0.0, 2 / 3, 1 / 3], dtype=hue.dtype, device=hue.device).reshape(3, 1, 1)
    position = (hue + offsets) % 1.0  # fraction of the circle from each primary
    ramp = ((position * 6 - 3).abs() - 1).clamp(0, 1)
    return 1 - saturation * (1 - ramp)
