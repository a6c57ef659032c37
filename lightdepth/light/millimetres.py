"""Millimetres per map unit, from the light: it sits some millimetres beside the lens, and that shows in the shading.

How a place on the wall is lit from two positions of the camera depends on the light's offset as a share of the
distance. In a map that is scaled wrongly the offset is the wrong share, and no albedo explains all views of the place.
Notation: s millimetres per map unit; X a place on the wall with unit normal n, in camera axes and map units; P the
light's position, mm, D its direction, l = (X - P/s) / |X - P/s|; E the light that X receives,

    E(s, rho, b) = exp(-mu (1 - D · l)) (n · -l) / |X - P/s|²  +  E_ind(rho, b)

(the first term is a sum, by their shares, over several lamps that were measured) with the light E_ind that comes by way
of other wall, of reflectance rho, of which a share b counts where no look shows it (lightdepth.light.enclosure). Over
views i of places m, with L the light that comes back (lightdepth.light.looks),

    log L_im = log g_i + log a_m + log E_im(s, rho, b) + noise,

gain g_i and albedo a_m unknown. L is the brightest channel's light less the darkest's, and E_ind is reckoned for both,
each with its own reflectance (lightdepth.light.shading). For each s, rho and b of a grid these are fitted robustly,
from a fit by absolute values: gains differ by much between frames, and a redescending loss alone settles on a part of
them. What is left over, as a function of s, is least at the right scale; where the offset is too small to be seen it is
flat, and nothing is said. Blocks of wall and looks are drawn anew, and the least cost found again over s, rho and b:
that is the interval.
Maps of one procedure have one rho and one b: their costs are added, and each has its s.

A part of a light file's mu is the lens's (vignetting, about the camera's axis) and does not move with P. A light that
was measured on a board says how much. Else all is taken for the lamp's, and what the scale would change by if half were
the lens's is in the interval.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lightdepth.errors import InputError
from lightdepth.light.enclosure import enclosure
from lightdepth.light.looks import Look, elements, seen_places, typical_distance
from lightdepth.light.shading import Shading
from lightdepth.photometry import PhotometricCalibration

__all__ = ["Look", "Millimetres", "Together", "millimetres", "together"]

_RANGE, _STEPS = (0.4, 2.5), 13  # of the scale about the one that is expected
_COARSE = ((0.0, 0.1, 0.3, 0.6), (0.5,))  # reflectances, and shares of the unseen wall
_FINE = ((0.0, 0.04, 0.08, 0.15, 0.25, 0.33, 0.4, 0.48, 0.55, 0.62, 0.7), (0.0, 0.5, 1.0))
_FINE_STEPS = 9  # of the scale, over two steps of the coarse ones to either side
_MOVED = 2  # times that these are moved to where their best is, if that is their end
_CELL = 0.18  # side of the elements of wall that light each other, as a share of the typical distance
_PLACES = 2600
_BLOCK = 0.5  # side of the blocks of wall that are drawn together, as a share of the typical distance
_DRAWN = 200
_INFLATED, _MODEL = 1.3, 0.03
"""Times the deviation over draws, and in quadrature the least one: what the model of the light lacks."""
_BETWEEN = 0.28
"""Deviation by light from wall that no look shows, above all beside and behind the camera, per reflectance of the wall:
with it nine of ten intervals hold on 42 tuning colons of both renderers (docs/millimetres.md)."""
_LENS = 0.5  # of the light's spread that may be the lens's
_WIDEST = 0.25  # deviation of the logarithm from which no figure is given
_NEAREST = 0.03  # least offset, as a share of the typical distance at the scale that was found
_CURES = (
    ("nobody gave the light", "give it: --light light.json, with position_mm and a source other than assumed"),
    ("sit in the camera", "say in light.json where it sits: position_mm, in camera axes"),
    ("keyframes see the surface", "make the surface from more keyframes"),
    ("views of places", "use frames that are neither clipped nor dark, and keyframes that see the same wall"),
    ("shines from elsewhere", "check position_mm in light.json: is it this endoscope's, in camera axes?"),
    ("response does not fit", "check gamma in light.json: is it that of this recording?"),
    ("a wall of reflectance", "measure gamma and the light on a board (calibrate-light --position), or give a length"),
    ("shading hardly changes", "say how far the wall is, or give a known length"),
    ("offset is", "go nearer to the wall, or give a known length"),
    ("contradicts the known length", "measure the length again, or check light.json"),
)
"""What to do about each refusal, by words in it."""
_ASIDE, _BENT = 0.25, 0.2  # tangent of the angle to where the images put the light; error of the response's exponent
_UNMEASURED = 0.4  # reflectance from which a wall looks as one under another response: gamma 1, where it is 2.2
_LEAST_VIEWS, _LEAST_LOOKS = 300, 3


@dataclass(frozen=True)
class Millimetres:
    """Millimetres per map unit that the light tells, or why it tells nothing."""

    mm_per_unit: float
    deviation: float
    """of its logarithm: .05 is 5 %"""
    reflectance: float
    """the wall's, with which the views agree best"""
    views: int
    """number of views of places that were compared"""
    refused: str = ""
    """why no figure is given; empty where one is"""
    aside: float = float("nan")
    """tangent of the angle, around the axis, between the light's place and where the images put it"""
    bent: float = float("nan")
    """share by which the response's exponent is too large, as the images have it"""
    by: str = "the light"
    """what tells it"""
    light_refused: str = ""
    """why the light tells nothing, of a scale that something else tells"""

    @property
    def cure(self) -> str:
        """What to do about a refusal, of the light too; empty where there is none."""
        return next((cure for why, cure in _CURES if why in (self.refused or self.light_refused)), "")

    @property
    def interval(self) -> tuple[float, float]:
        """In which nine of ten scales lie, mm per map unit."""
        reach = float(np.exp(1.645 * self.deviation))
        return self.mm_per_unit / reach, self.mm_per_unit * reach


@dataclass(frozen=True)
class Together:
    """What the light tells of maps that share it and the wall's reflectance."""

    maps: tuple[Millimetres, ...]
    covariance: np.ndarray
    """(k, k), of the logarithms of the maps' scales; infinite on the diagonal where nothing is told"""


def millimetres(looks: Sequence[Look], light: PhotometricCalibration, near: float = 1.0, seed: int = 0) -> Millimetres:
    """The scale of a map from the light's offset. It is looked for from .4 to 2.5 times `near`, mm per map unit.

    Raises InputError where fewer than three looks are given.
    """
    if len(looks) < _LEAST_LOOKS:
        cure = f"expected at least {_LEAST_LOOKS}: places have to be seen from several"
        raise InputError("the looks", f"{len(looks)} of them", cure)
    return together([looks], light, [near], seed).maps[0]


def unplaced(light: PhotometricCalibration) -> Millimetres | None:
    """The refusal of a light of which nobody said where it sits: it tells no scale, whatever it shines on."""
    if not light.assumed and np.hypot(*light.position_mm[:2]) > 0:
        return None
    why = "nobody gave the light" if light.assumed else "the light is said to sit in the camera"
    return _untold(f"{why}: its position is needed")


def together(
    maps: Sequence[Sequence[Look]],
    light: PhotometricCalibration,
    near: Sequence[float],
    seed: int = 0,
    surface: float = 0.0,
) -> Together:
    """The scales of maps, given by their looks, that share the light, the wall's reflectance and the share of unseen
    wall. Each scale is looked for from .4 to 2.5 times that in `near`, mm per map unit. `surface` is the deviation of
    its logarithm by what is wrong with the looks' distances; it is each map's own."""
    covariance = np.diag(np.full(len(maps), np.inf))
    if (refusal := unplaced(light)) is not None:
        return Together((refusal,) * len(maps), covariance)
    offset = float(np.hypot(*light.position_mm[:2]))
    rng = np.random.default_rng(seed)
    found = [_place(looks, light, rng) for looks in maps]
    rows = [i for i, one in enumerate(found) if isinstance(one, _Placed)]
    placed = [one for one in found if isinstance(one, _Placed)]
    if placed:
        told, covariance[np.ix_(rows, rows)] = _solved(placed, offset, [near[i] for i in rows], rng, surface)
        found = [told[rows.index(i)] if i in rows else one for i, one in enumerate(found)]
    return Together(tuple(one for one in found if isinstance(one, Millimetres)), covariance)


def _untold(why: str, views: int = 0) -> Millimetres:
    return Millimetres(float("nan"), float("inf"), float("nan"), views, why)


@dataclass(frozen=True)
class _Placed:
    """A map's places with who sees and who lights them, the number of views, and the typical distance."""

    shading: Shading
    views: int
    typical: float

    def by_the_lens(self, scales: np.ndarray, reflectance: float, unseen: float) -> float:
        """Half of what log scale changes by where a part of the light's spread is the lens's; 0 where that is known."""
        light = self.shading.light
        if light.lamps is not None:
            return 0.0
        through = [
            _least(scales, replace(self.shading, lens=lens).losses(scales, (reflectance,), (unseen,)).sum((1, 2, 3, 4)))
            for lens in (0.0, _LENS * light.mu)
        ]
        return float(0.5 * np.log(through[1] / through[0]))


def _place(looks: Sequence[Look], light: PhotometricCalibration, rng: np.random.Generator) -> _Placed | Millimetres:
    """What a scale can be found from, or why it cannot."""
    if len(looks) < _LEAST_LOOKS:
        return _untold(f"{len(looks)} keyframes see the surface, of {_LEAST_LOOKS} needed")
    walls, typical = [look.wall() for look in looks], typical_distance(looks)
    seen = seen_places(looks, walls, light.gamma, _PLACES, rng) if all(w.even.any() for w in walls) else None
    views = 0 if seen is None else int(np.isfinite(seen.log_light).sum())
    if seen is None or views < _LEAST_VIEWS:
        why = f"{views} views of places are even, coloured, and neither white, dark nor steep, of {_LEAST_VIEWS} needed"
        return _untold(why, views)
    around = enclosure(looks, walls, elements(walls, _CELL * typical), seen, typical, rng)
    poses, lens = np.stack([look.cam_from_map for look in looks]), 0.0 if light.lamps is None else light.lamps.lens_mu
    return _Placed(Shading(poses, seen, around, light, lens), views, typical)


def _solved(
    placed: Sequence[_Placed], offset: float, near: Sequence[float], rng: np.random.Generator, surface: float
) -> tuple[list[Millimetres], np.ndarray]:
    """What the light tells of each map, and the covariance (k, k) of the logarithms of their scales."""
    ranges = [one * np.geomspace(*_RANGE, _STEPS) for one in near]
    coarse = _profiles([p.shading.losses(r, *_COARSE).sum((3, 4)) for p, r in zip(placed, ranges, strict=True)])
    at = [int(profile.argmin()) for profile in coarse]
    stretch = (ranges[0][1] / ranges[0][0]) ** np.linspace(-2, 2, _FINE_STEPS)
    scales = [r[i] * stretch for r, i in zip(ranges, at, strict=True)]
    blocks = [_blocks(p.shading.seen.places, _BLOCK * p.typical) for p in placed]
    losses = [p.shading.losses(s, *_FINE, blocks=b) for p, s, b in zip(placed, scales, blocks, strict=True)]
    for _ in range(_MOVED):
        steps = _steps(losses)
        rows = [k for k, step in enumerate(steps) if _goes_on(scales[k], step, ranges[k])]
        if not rows:
            break
        for k in rows:
            scales[k] = scales[k][steps[k]] * stretch
            losses[k] = placed[k].shading.losses(scales[k], *_FINE, blocks=blocks[k])
    draws = np.log(_drawn(losses, scales, rng))
    found = np.exp(np.median(draws, axis=0))
    costs = [loss.sum((3, 4)) for loss in losses]
    steps = _steps(losses)
    best = np.sum([cost.min(0) for cost in costs], axis=0)
    row, column = (int(k) for k in np.unravel_index(best.argmin(), best.shape))
    reflectance, unseen = _FINE[0][row], _FINE[1][column]
    lens = np.array([p.by_the_lens(s, reflectance, unseen) for p, s in zip(placed, scales, strict=True)])
    covariance = _INFLATED**2 * np.atleast_2d(np.cov(draws, rowvar=False, bias=True))
    covariance += (_MODEL**2 + surface**2 + (_BETWEEN * reflectance) ** 2) * np.eye(len(placed)) + np.outer(lens, lens)
    told = []
    for k, p in enumerate(placed):
        doubts = p.shading.doubts(float(found[k]), reflectance, unseen)
        one = Millimetres(float(found[k]), float(np.sqrt(covariance[k, k])), reflectance, p.views, "", *doubts)
        flat = at[k] in (0, _STEPS - 1) or steps[k] in (0, _FINE_STEPS - 1) or one.deviation > _WIDEST
        share = offset / ((near[k] if flat else one.mm_per_unit) * p.typical)
        measured = p.shading.light.lamps is not None
        told.append(replace(one, refused=_doubt(one, flat, share, measured)))
    return told, covariance


def _steps(losses: Sequence[np.ndarray]) -> list[int]:
    """Which of its scales is best for each map, whose losses are (scales, rhos, shares, looks, blocks)."""
    return [int(profile.argmin()) for profile in _profiles([loss.sum((3, 4)) for loss in losses])]


def _goes_on(scales: np.ndarray, step: int, bounds: np.ndarray) -> bool:
    """Whether the best of the scales is their first or last, and not yet an end of what is searched."""
    return step in (0, len(scales) - 1) and bool(bounds[0] < scales[step] < bounds[-1])


def _doubt(told: Millimetres, flat: bool, share: float, measured: bool = False) -> str:
    """Why no figure is given, of a light beside the lens by such a share of the distance, measured on a board or not;
    empty where nothing is."""
    brightest = _FINE[0][-1] if measured else min(_UNMEASURED, _FINE[0][-1])
    if share < _NEAREST:
        return f"the light's offset is {share:.1%} of the distance, of {_NEAREST:.0%} needed"
    if abs(told.aside) > _ASIDE:
        angle = np.degrees(np.arctan(abs(told.aside)))
        return f"the light shines from elsewhere: the images put it {angle:.0f} degrees around the axis from its place"
    if abs(told.bent) > _BENT:
        return f"the response does not fit: the images' gamma is {1 / (1 + told.bent):.2f} times the light's"
    if told.reflectance >= brightest:
        return f"a wall of reflectance {told.reflectance:g} or more, or another response: the images do not say which"
    if flat:
        return f"shading hardly changes with the scale: the light's offset is {share:.1%} of the distance"
    return ""


def _profiles(costs: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Of costs (scales, rhos, shares) of each map, the least of all maps together over what they share and over the
    others' scales, for each scale (scales,) of its own."""
    least = [cost.min(0) for cost in costs]
    total = np.sum(least, axis=0)
    return [(cost + (total - own)).min((1, 2)) for cost, own in zip(costs, least, strict=True)]


def _drawn(losses: Sequence[np.ndarray], scales: Sequence[np.ndarray], rng: np.random.Generator) -> np.ndarray:
    """The scales (draws, maps) of least loss over blocks of wall and looks that are drawn with replacement."""
    found = []
    for _ in range(_DRAWN):
        costs = []
        for loss in losses:
            looks, blocks = loss.shape[3:]
            of_look = rng.multinomial(looks, np.full(looks, 1 / looks))
            of_block = rng.multinomial(blocks, np.full(blocks, 1 / blocks))
            costs.append((of_look @ loss.reshape(-1, looks, blocks) @ of_block).reshape(loss.shape[:3]))
        found.append([_least(s, profile) for s, profile in zip(scales, _profiles(costs), strict=True)])
    return np.array(found)


def _blocks(places: np.ndarray, side: float) -> np.ndarray:
    """The block (n,) of wall in which each place lies."""
    _, blocks = np.unique(np.floor(places / side), axis=0, return_inverse=True)
    result: np.ndarray = blocks.ravel()
    return result


def _least(scales: np.ndarray, costs: np.ndarray) -> float:
    """Where a parabola through the least cost and its neighbours, over log scale, is least."""
    at, step = int(costs.argmin()), float(np.log(scales[1] / scales[0]))
    shift = 0.0
    if 0 < at < len(scales) - 1:
        before, here, after = costs[at - 1 : at + 2]
        bend = before - 2 * here + after
        shift = 0.5 * (before - after) / bend if bend > 0 else 0.0
    return float(scales[at] * np.exp(shift * step))
