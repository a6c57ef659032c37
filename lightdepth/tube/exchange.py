"""How much of the light that leaves one patch of wall falls on another: several answers, each wrong in its own way.

A network that is taught by one way of computing the light between walls learns to undo that way, flaws and all. So the
colons of a training may each take another. Notation: N patches, K (N, N) form factors, rows receive; E irradiance, rho
reflectance; E = E_0 + K rho E, summed over so many bounces.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor

from lightdepth.errors import InputError
from lightdepth.radiosity import form_factors
from lightdepth.ranges import COUNT, above, checked, ends_of
from lightdepth.tube.casting import Caster
from lightdepth.tube.wall import place_of

Form = Literal["points", "through", "enclosed", "cast"]

_LIFTED_MM = 0.4  # above the wall, so that a patch does not hide behind its own triangles
_RAYS = 384  # of a patch, when they are cast
_TURN = math.pi * (3 - math.sqrt(5))


@dataclass(frozen=True)
@checked
class ExchangeConfig:
    """How light goes from wall to wall; of several forms one is drawn for each colon, of two ends a value between."""

    forms: tuple[Form, ...] = ("points",)
    """Ways to compute the light between patches of wall, a list, of which each colon draws one: points, between the
    patches' centres where these see each other; through, the same, but as if wall hid nothing, as the loss computes it;
    enclosed, as points, but all the light that a patch reflects falls on others, as in a closed cavity; cast, by rays,
    the most exact."""
    bounces: Annotated[tuple[int, int], ends_of(COUNT)] = (6, 6)
    """Ends of the range of the number of times that light is reflected from wall to wall. A larger one makes more
    indirect light where the wall is bright, and takes longer."""
    coarser: Annotated[tuple[float, float], ends_of(above(0, up_to=10))] = (1.0, 1.0)
    """Ends of the range of a factor on the length of the patches. A larger one makes coarser indirect light in less
    time."""

    def __post_init__(self) -> None:
        if not self.forms:
            raise InputError(
                "forms of the exchange of light", "none", "expected some of points, through, enclosed, cast"
            )


class Exchange(NamedTuple):
    """One colon's."""

    form: Form
    bounces: int
    coarser: float


def draw_exchange(config: ExchangeConfig, rng: np.random.Generator) -> Exchange:
    """What a colon takes. Nothing is drawn from `rng` where there is nothing to choose: earlier colons stay."""
    if config == ExchangeConfig():
        return Exchange("points", 6, 1.0)
    (own,) = rng.spawn(1)
    form = config.forms[int(own.integers(len(config.forms)))]
    bounces = int(own.integers(config.bounces[0], config.bounces[1] + 1))
    return Exchange(form, bounces, own.uniform(*config.coarser))


class Patches(NamedTuple):
    """A grid (n_s, n_phi) of N = n_s n_phi patches: points, normals and lifted points (N, 3), areas (N,)."""

    grid: tuple[int, int]
    points: Tensor
    normals: Tensor
    areas: Tensor

    @property
    def lifted(self) -> Tensor:
        return self.points + _LIFTED_MM * self.normals


def exchanged(form: Form, patches: Patches, caster: Caster, mesh: tuple[int, ...]) -> Tensor:
    """K (N, N) between patches of a wall that is a mesh over (rings, spokes)."""
    if form == "cast":
        return _by_rays(patches, caster, mesh)
    points, normals, areas = (part[None] for part in (patches.points, patches.normals, patches.areas))
    factors = form_factors(points, normals, areas)[0]
    if form == "through":
        return factors
    # A patch cannot light what it does not see.
    i, j = torch.nonzero((factors + factors.T).triu() > 1e-6).unbind(-1)
    blocked = caster.blocked(patches.lifted[i], patches.lifted[j]).to(factors.device)
    factors[i[blocked], j[blocked]] = factors[j[blocked], i[blocked]] = 0
    return factors / factors.sum(-1, keepdim=True).clamp(min=1e-3) if form == "enclosed" else factors


def _by_rays(patches: Patches, caster: Caster, mesh: tuple[int, ...]) -> Tensor:
    """The share of each patch's rays, spread as the cosine of their angle from its normal, that meets each other: its
    own rows, so that light is lost only through the open end."""
    normals, (n_s, n_phi) = patches.normals, patches.grid
    count, device = len(normals), normals.device
    k = torch.arange(_RAYS, device=device) + 0.5
    out = (k / _RAYS).sqrt()
    turn = k * _TURN + torch.arange(count, device=device)[:, None]  # no two patches have one pattern
    least = torch.eye(3, device=device)[normals.abs().argmin(1)]
    side = torch.nn.functional.normalize(torch.linalg.cross(normals, least), dim=1)
    up = torch.linalg.cross(normals, side)
    rays = (out * turn.cos())[..., None] * side[:, None] + (out * turn.sin())[..., None] * up[:, None]
    rays = rays + (1 - out.square()).clamp(min=0).sqrt()[:, None] * normals[:, None]
    hits = caster.cast(patches.lifted[:, None].expand_as(rays).reshape(-1, 3), rays.reshape(-1, 3))
    met = hits.distance.isfinite().to(device)
    phi, s = place_of(torch.where(met, hits.face.to(device), 0), hits.uv.to(device), mesh).unbind(-1)
    row, column = ((s + 1) / 2 * (n_s - 1)).round().long(), ((phi + 1) / 2 * n_phi).round().long() % n_phi
    seen = row.clamp(0, n_s - 1) * n_phi + column
    receiver = torch.arange(count, device=device).repeat_interleave(_RAYS)
    factors = normals.new_zeros(count * count)
    factors.index_add_(0, receiver * count + seen, met.to(normals.dtype) / _RAYS)
    return factors.reshape(count, count)
