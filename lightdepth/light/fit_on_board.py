"""The place of an endoscope's lamps, from frames of a printed board: how well these tell it, and whether at all."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from scipy.special import stdtrit

from lightdepth.counting import counted
from lightdepth.datasets import FrameSequence
from lightdepth.errors import InputError
from lightdepth.frame import readable
from lightdepth.light import lamps as lamp_fit
from lightdepth.light.board import Board, BoardConfig, Kind, find_board, what_is_there
from lightdepth.light.board_pose import White, board_pose, white_paper
from lightdepth.light.fit_on_map import GAMMA_RANGE
from lightdepth.light.lamps import Fit, Samples, Unknowns, fit_lamps
from lightdepth.photometry import MeasuredLamps, PhotometricCalibration
from lightdepth.ranges import Range, checked
from lightdepth.robust import mad_sigma

LEAST_FRAMES, MOST_LOOKED_AT, MOST_FRAMES = 5, 160, 40
LEAST_CELLS = 12  # of a frame's white paper, or it says too little
MOST_CLIPPED = 0.5  # of the white pixels, over the frames
MOST_ASTRAY = 0.003  # root mean square error of the corners, as a share of the image's width
WIDEST_MM = 1.0  # half of the interval of a coordinate, from which a place is none
MOST_LEFT = 0.04  # of the code values, which the lamps do not explain
GAIN_NEEDED = 0.9  # one lamp more must leave at most this share of what frames that were withheld leave
NEAREST_MM, LEAST_SHARE = 0.5, 0.08  # two lamps nearer to each other are one; a lamp with less light is none
DRAWS = 400
CONFIDENCE = 0.9


@dataclass(frozen=True)
@checked
class LampsConfig:
    """Which lamps are sought."""

    number: Annotated[int | None, Range(1, 3)] = None
    """Number of lamps beside the lens. More explain brightness better, even where they do not exist; left out, one more
    is taken as long as it predicts the brightness of frames kept out of the fit better by a tenth."""
    gamma: Annotated[float | None, Range(*GAMMA_RANGE)] = None
    """Response exponent of the camera, where it is known, as in 2.2. A larger one takes the same code values for less
    light; left out, it is fitted."""
    axis: bool = True
    """Whether the direction in which the lamps shine is sought too; without it, they shine along the camera's axis."""


@dataclass(frozen=True)
class PositionConfig:
    """Whether the position of the lamps is sought, on which board, and how."""

    position: Kind | None = None
    """Printed board that the frames show, charuco or checkerboard. Its white paper tells the position of the light, in
    millimetres, the light's spread and the camera's response. --board.squares and --board.square-mm say its size. Left
    out, no position is sought."""
    board: BoardConfig = field(default_factory=BoardConfig)
    """The printed board."""
    lamps: LampsConfig = field(default_factory=LampsConfig)
    """What is sought of the lamps."""


@dataclass(frozen=True)
class BoardFit:
    """Lamps, the frames they rest on, and how sure their place is. `deviation` (3,) [mm] is of the lamps' middle, the
    larger of what frames drawn anew show and what the fit's own curvature does; `left` what is left over of code
    values, as a share; `withheld` what frames kept from the fit leave, in deviations, by the number of lamps."""

    fit: Fit
    whites: tuple[White, ...]
    deviation: np.ndarray
    left: float
    left_by_frame: np.ndarray
    withheld: dict[int, float]
    looked_at: int
    lens_mu: float
    lamp_mu: float

    @property
    def half_width(self) -> np.ndarray:
        """(3,) mm: half the 90 % interval of x, y and z."""
        found: np.ndarray = self.deviation * stdtrit(len(self.whites) - 1, (1 + CONFIDENCE) / 2)
        return found

    @property
    def light(self) -> PhotometricCalibration:
        lamps = self.fit.lamps
        lens_mu = round(self.lens_mu, 4)
        return PhotometricCalibration(
            gamma=round(lamps.gamma, 4),
            mu=max(round(self.lamp_mu + self.lens_mu, 4), 0.0),
            position_mm=_triple(lamps.middle),
            direction=_triple(lamps.axis, 6),
            source="measured",
            lamps=MeasuredLamps(
                tuple(map(_triple, lamps.places)),
                tuple(float(share) for share in lamps.shares),
                _triple(self.deviation, 4),
                lens_mu,
            ),
        )

    def summary(self) -> str:
        lamps = self.fit.lamps
        place = ", ".join(
            f"{axis} {at:.2f} ± {wide:.2f}" for axis, at, wide in zip("xyz", lamps.middle, self.half_width, strict=True)
        )
        lens = f"{self.lens_mu:.2f}{lens_said(self.lens_mu)}"
        many = "" if len(lamps.shares) == 1 else f" (the middle of {len(lamps.shares)} lamps)"
        return (
            f"at {place} mm{many}, nine of ten times; gamma {lamps.gamma:.2f}, mu {self.light.mu:.2f}, of which the "
            f"lens {lens}; {len(self.whites)} of {self.looked_at} frames, {self.left:.1%} of their white is unexplained"
        )


def lens_said(lens_mu: float) -> str:
    """What a lens is that darkens by less than nothing to its side, in brackets; empty for others."""
    if round(lens_mu, 2) >= 0:
        return ""
    return (
        " (below 0: images are brighter at the edge than the light alone makes them, as where the endoscope evens "
        "out its lens)"
    )


def fit_on_board(
    frames: FrameSequence,
    board: Board,
    config: LampsConfig = LampsConfig(),
    rng: np.random.Generator | None = None,
) -> BoardFit:
    """Where the lamps are. Raises InputError where the board is not found, or does not lie where the camera says, where
    its white is saturated, and where the frames do not tell the place."""
    whites, looked_at = _whites(frames, board)
    return fit_on_white(whites, config, frames.source, looked_at, rng)


def fit_on_white(
    whites: Sequence[White],
    config: LampsConfig,
    source: str,
    looked_at: int,
    rng: np.random.Generator | None = None,
) -> BoardFit:
    """Where the lamps are, from white paper of several frames. Raises InputError where it does not tell the place."""
    rng = np.random.default_rng(0) if rng is None else rng
    samples = Samples.of(whites)
    fits, withheld = _by_number(samples, config)
    fit = fits[max(fits)]
    unknowns = Unknowns(len(fit.lamps.shares), config.axis, config.gamma)
    middles = lamp_fit.drawn(samples, unknowns, fit, rng, DRAWS)
    deviation = np.maximum(fit.deviation, _mad_sigmas(middles))
    residuals = samples.residuals(fit.lamps, fit.weights) * samples.noise
    by_frame = [mad_sigma(residuals[samples.frame == i]) for i in range(len(whites))]
    off_axis = 1 - samples.places[:, 2] / np.linalg.norm(samples.places, axis=1)
    bend = float((off_axis**3).sum() / max((off_axis**2).sum(), 1e-9))  # of a square, the line that is nearest to it
    lens_mu, lamp_mu = fit.lamps.lens[0] + bend * fit.lamps.lens[1], fit.lamps.mu + bend * fit.lamps.edge
    found = BoardFit(
        fit, tuple(whites), deviation, mad_sigma(residuals), np.array(by_frame), withheld, looked_at, lens_mu, lamp_mu
    )
    _check(found, source)
    return found


def _mad_sigmas(values: np.ndarray) -> np.ndarray:
    """Deviation of each column of (n, k), whatever a few draws do."""
    return np.array([mad_sigma(column - np.median(column)) for column in values.T])


def _whites(frames: FrameSequence, board: Board) -> tuple[list[White], int]:
    """White paper of the frames that show the board, and how many frames were looked at."""
    rows = np.unique(np.linspace(0, len(frames) - 1, min(MOST_LOOKED_AT, len(frames))).round().astype(int)).tolist()
    found, errors, seen = [], [], 0
    for frame in readable(frames, rows):
        sighting = find_board(frame.image, board)
        pose = None if sighting is None else board_pose(frame.camera, sighting)
        if sighting is None or pose is None:
            continue
        seen += 1
        errors.append(pose.error / frame.camera.width)
        if errors[-1] <= MOST_ASTRAY:
            found.append(white_paper(frame, pose, sighting.board))
    astray = float(np.median(errors)) if errors else 0.0
    there = ""
    if not found:
        looked = [frame.image for frame in readable(frames, [rows[i] for i in (0, len(rows) // 2, -1)])]
        there = f"; {said}" if (said := what_is_there(looked, board)) else ""
    if seen < LEAST_FRAMES:
        cure = (
            "are --board.squares (squares, not the corners between them) and, of a charuco board, --board.dictionary "
            "its own, and does it fill much of the image?"
        )
        raise InputError(
            frames.source,
            f"{board.name} was found in {seen} of {len(rows)} frames{there}",
            f"expected at least {LEAST_FRAMES}: {'take more, a dozen are good' if seen == len(rows) else cure}",
        )
    if astray > MOST_ASTRAY or len(found) < LEAST_FRAMES:
        raise InputError(
            frames.source,
            f"the board's corners lie {astray:.2%} of the image's width from their places (median over "
            f"{seen} frames), in {counted(len(found), 'frame')} no farther than {MOST_ASTRAY:.1%}{there}",
            f"expected at most {MOST_ASTRAY:.1%}, in {LEAST_FRAMES} frames at least: is this the camera of these "
            "frames, are the sizes those of the board, and is it flat?",
        )
    clipped = float(np.median([white.clipped for white in found]))
    usable = [white for white in found if len(white) >= LEAST_CELLS]
    if clipped > MOST_CLIPPED or len(usable) < LEAST_FRAMES:
        raise InputError(
            frames.source,
            f"{clipped:.0%} of the board's white is saturated (median over {len(found)} frames), and {len(usable)} "
            f"frames have {LEAST_CELLS} places of white with a brightness of their own",
            f"expected {LEAST_FRAMES} frames: turn the light or the exposure down, or fill more of the image with a "
            "board of larger squares",
        )
    kept = np.unique(np.linspace(0, len(usable) - 1, min(MOST_FRAMES, len(usable))).round().astype(int))
    return [usable[i] for i in kept], len(rows)


def _by_number(samples: Samples, config: LampsConfig) -> tuple[dict[int, Fit], dict[int, float]]:
    """Fits by their number of lamps, one more as long as withheld frames speak for it, and what these leave."""
    fits: dict[int, Fit] = {}
    withheld: dict[int, float] = {}
    for number in (config.number,) if config.number else (1, 2, 3):
        unknowns = Unknowns(number, config.axis, config.gamma)
        fit = fit_lamps(samples, unknowns)
        error = lamp_fit.withheld(samples, unknowns, fit)
        withheld[number] = error
        if fits and (error > GAIN_NEEDED * withheld[number - 1] or not _apart(fit)):
            break
        fits[number] = fit
    return fits, withheld


def _apart(fit: Fit) -> bool:
    """Whether lamps are several."""
    places, shares = fit.lamps.places, fit.lamps.shares
    between = [float(np.linalg.norm(a - b)) for i, a in enumerate(places) for b in places[:i]]
    return min(between, default=np.inf) >= NEAREST_MM and float(shares.min()) >= LEAST_SHARE


def _check(found: BoardFit, source: str) -> None:
    """Raises InputError where the frames do not tell the place."""
    lamps, wide = found.fit.lamps, found.half_width
    away = [white.pose.distance for white in found.whites]
    tilts = [white.pose.tilt for white in found.whites]
    poses = (
        f"{len(away)} boards {min(away):.0f} to {max(away):.0f} mm away, tilted by {min(tilts):.0f} to "
        f"{max(tilts):.0f} degrees"
    )
    place = f"x {lamps.middle[0]:.2f} ± {wide[0]:.2f}, y {lamps.middle[1]:.2f} ± {wide[1]:.2f}, z "
    place += f"{lamps.middle[2]:.2f} ± {wide[2]:.2f} mm"
    if not GAMMA_RANGE[0] <= lamps.gamma <= GAMMA_RANGE[1]:
        raise InputError(
            source,
            f"the response's exponent would be {lamps.gamma:.2f}",
            "give it, where it is known: --lamps.gamma 2.2",
        )
    if found.left > MOST_LEFT:
        raise InputError(
            source,
            f"lamps beside the lens leave {found.left:.1%} of the white's brightness unexplained",
            f"expected at most {MOST_LEFT:.0%}: matt paper in a dark room, and a camera without tone mapping or "
            "enhancement; or does it have more lamps?",
        )
    if float(wide.max()) > WIDEST_MM:
        raise InputError(
            source,
            f"the place of the light cannot be determined: {place} ({poses})",
            f"expected ± {WIDEST_MM:g} mm at most: photograph the board from near (10 to 40 mm) and tilted by 20 to 45 "
            "degrees to all sides, a dozen times",
        )
    aside = float(np.hypot(*lamps.middle[:2]))
    reach = float(np.linalg.norm(wide[:2] * lamps.middle[:2])) / max(aside, 1e-9)
    if aside <= reach:
        raise InputError(
            source,
            f"the light is {aside:.2f} ± {reach:.2f} mm beside the lens, which may as well be 0 ({place}; {poses})",
            "a ring light, or lamps around the lens, have no side: they tell no millimetres. If the lamp is on one "
            "side, photograph the board more often and from nearer",
        )


def _triple(values: Sequence[float] | np.ndarray, digits: int = 4) -> tuple[float, float, float]:
    x, y, z = (round(float(v), digits) for v in values)
    return x, y, z
