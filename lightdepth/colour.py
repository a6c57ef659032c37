"""Whether frames were taken under one white, steady light, as the models take it: their colours, and how these jump.

Frames (H, W, 3), codes in [0, 1], are looked at as small pictures of some dozen columns, where they are neither black
nor white. A frame's colour is the median over these cells of log R/G and log B/G. Tissue under white light is red;
under narrow-band light it is not, and the brightest channel then carries the wall's own pattern. Neighbours are
compared cell by cell: where the medians of the log ratios are far off and their spread is small, the picture stayed and
the camera changed.

The limits stand where harm begins, measured on synthetic colons (docs/colour.md).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass
from typing import Any

import cv2
import numpy as np

COLUMNS = 48
BLACK, WHITE = 0.08, 0.97
_CELLS = 50  # cells from which a picture has a colour
_RED = -0.05  # log of red over the brighter of green and blue, below which tissue is not under white light
_LESS_RED, _HARDLY_RED = 0.25, 0.1  # lost of the same against the rest of the clip, and what is left of it at most
_REST = 0.75  # quantile of the redness that the rest of a clip has: up to so many of its frames may be odd
_RED_JUMP, _BLUE_JUMP = 0.25, 0.45  # of log R/G and log B/G between neighbours
_GAIN_JUMP, _CLIPPED_JUMP = 0.6, 0.3  # of the log of brightness; the lower one where the brighter frame is mostly white
_MOSTLY = 0.5
_SEEN_JUMP, _ALL = 0.1, 0.75  # a bright picture goes white all over: of its brightness little more can be seen
_STEADY = 0.5  # spread of the log ratios, over their median, up to which one factor explains them
_SHARE, _LEAST = 0.05, 2  # of the frames or neighbours, from which it is said


@dataclass(frozen=True, eq=False)
class Glance:
    """One frame as a small picture: log of the codes (h, w, 3), the cells (h, w) inside the mask that are not black, of
    these the ones that are not white either, and the share of white ones."""

    log: np.ndarray
    lit: np.ndarray
    usable: np.ndarray
    white: float

    @classmethod
    def of(cls, image: np.ndarray, valid: np.ndarray) -> Glance:
        """Of a frame (H, W, 3) where it is valid (H, W)."""
        height, width = valid.shape
        columns = min(width, COLUMNS)
        size = columns, max(1, round(height * columns / width))
        small = cv2.resize(image.astype(np.float32, copy=False), size, interpolation=cv2.INTER_AREA)
        inside = cv2.resize(valid.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.99
        top = small.max(-1)
        white = float((top >= WHITE)[inside].mean()) if inside.any() else 0.0
        lit = inside & (top > BLACK)
        return cls(np.log(np.maximum(small, 0.02)), lit, lit & (top < WHITE), white)

    @property
    def colour(self) -> tuple[float, float]:
        """Medians of log R/G and log B/G; NaN where too little can be seen."""
        cells = self.log[self.usable]
        if len(cells) < _CELLS:
            return float("nan"), float("nan")
        return float(np.median(cells[:, 0] - cells[:, 1])), float(np.median(cells[:, 2] - cells[:, 1]))


@dataclass(frozen=True)
class Step:
    """What changed from a frame to its neighbour: logs of the factors on brightness, red over green and blue over
    green; 0 where no single factor explains it, because the picture changed."""

    brightness: float
    red: float
    blue: float
    white: float
    """share of the brighter of both that is white"""
    whitened: float = 0.0
    """by how much the share of white changed"""

    @classmethod
    def between(cls, before: Glance, after: Glance) -> Step | None:
        """None where too little can be seen in both."""
        if before.usable.shape != after.usable.shape:
            return None
        both, white = before.usable & after.usable, max(before.white, after.white)
        if int(both.sum()) < _CELLS:
            return cls._into_white(before, after)
        a, b = before.log[both], after.log[both]
        change = b - a
        steps = b.max(1) - a.max(1), change[:, 0] - change[:, 1], change[:, 2] - change[:, 1]
        brightness, red, blue = map(_one_factor, steps)
        return cls(brightness, red, blue, white, abs(after.white - before.white))

    @classmethod
    def _into_white(cls, before: Glance, after: Glance) -> Step | None:
        """Where one of both is white nearly all over: brightness changed by at least as much as is seen."""
        darker, brighter, sign = (before, after, 1) if before.white < after.white else (after, before, -1)
        both = darker.usable & brighter.lit
        if brighter.white <= _MOSTLY or int(both.sum()) < _CELLS:
            return None
        least = np.median(brighter.log[both].max(1) - darker.log[both].max(1))
        return cls(sign * float(least), 0.0, 0.0, brighter.white, brighter.white - darker.white)

    @property
    def gain_jumps(self) -> bool:
        """Whether brightness changed by more than the models survive: out of what they know, or into white."""
        size = abs(self.brightness)
        clipped = (size >= _CLIPPED_JUMP and self.white > _MOSTLY) or (size >= _SEEN_JUMP and self.whitened >= _ALL)
        return size >= _GAIN_JUMP or clipped

    @property
    def balance_jumps(self) -> bool:
        """Whether the channels changed by different factors."""
        return abs(self.red) >= _RED_JUMP or abs(self.blue) >= _BLUE_JUMP


def _one_factor(steps: np.ndarray) -> float:
    """The median of log ratios (n,), 0 where they are spread too wide to be one factor."""
    middle = float(np.median(steps))
    spread = 1.4826 * float(np.median(np.abs(steps - middle)))
    return middle if spread <= _STEADY * abs(middle) else 0.0


class ColourMeter:
    """Looks at frames one after the other; `apart` begins anew where the next one is no neighbour of the last."""

    def __init__(self) -> None:
        self._colours: list[tuple[float, float]] = []
        self._steps: list[Step] = []
        self._before: Glance | None = None

    def apart(self) -> None:
        self._before = None

    def add(self, image: np.ndarray, valid: np.ndarray) -> None:
        """A frame (H, W, 3) in [0, 1], and where it is valid (H, W)."""
        seen = Glance.of(image, valid)
        if np.isfinite(seen.colour[0]):
            self._colours.append(seen.colour)
        step = None if self._before is None else Step.between(self._before, seen)
        if step is not None:
            self._steps.append(step)
        self._before = seen

    def taken(self) -> tuple[int, int]:
        """How many colours and steps there are by now, for `since`."""
        return len(self._colours), len(self._steps)

    def since(self, taken: tuple[int, int]) -> dict[str, Any]:
        """What came after that, as plain values that `go_on` takes."""
        colours, steps = taken
        return {"colours": self._colours[colours:], "steps": [astuple(step) for step in self._steps[steps:]]}

    def last(self) -> dict[str, np.ndarray]:
        """The last frame, with which the next is compared, as arrays that `go_on` takes; empty where there is none."""
        if self._before is None:
            return {}
        return {name: np.asarray(value) for name, value in vars(self._before).items()}

    def go_on(self, since: Mapping[str, Any], last: Mapping[str, np.ndarray]) -> None:
        """Takes what another meter has seen."""
        self._colours += [(red, blue) for red, blue in since["colours"]]
        self._steps += [Step(*step) for step in since["steps"]]
        self._before = None
        if last:
            self._before = Glance(last["log"], last["lit"], last["usable"], float(last["white"]))

    def result(self) -> Colours:
        return Colours(np.array(self._colours, np.float64).reshape(-1, 2), tuple(self._steps))


@dataclass(frozen=True, eq=False)
class Colours:
    """Colours (n, 2) of the frames that show enough, log R/G and log B/G, and the steps between neighbours."""

    of_frames: np.ndarray
    steps: Sequence[Step]

    @property
    def redness(self) -> np.ndarray:
        """Log of red over the brighter of green and blue (n,)."""
        result: np.ndarray = self.of_frames[:, 0] - np.maximum(self.of_frames[:, 1], 0)
        return result

    @property
    def odd(self) -> np.ndarray:
        """Which frames (n,) are not of tissue under white light, or not under the light of the rest.

        Bile takes blue away and leaves the red: against the rest, both green and blue have to gain on red."""
        if not len(self.of_frames):
            return np.zeros(0, bool)
        red_over_blue = self.of_frames[:, 0] - self.of_frames[:, 1]
        lost = [np.quantile(each, _REST) - each for each in (self.of_frames[:, 0], red_over_blue)]
        result: np.ndarray = (self.redness < _RED) | ((self.redness < _HARDLY_RED) & (np.minimum(*lost) > _LESS_RED))
        return result

    @property
    def doubts(self) -> tuple[str, ...]:
        """One sentence for each thing that is not as the models take it, with its share; empty where nothing is."""
        return tuple(said for said in (self._of_colour(), self._of_gain(), self._of_balance()) if said)

    def record(self) -> dict[str, object]:
        """For run.json."""
        return {
            "frames": len(self.of_frames),
            "in_another_colour": int(self.odd.sum()),
            "neighbours": len(self.steps),
            "gain_jumps": sum(step.gain_jumps for step in self.steps),
            "white_balance_jumps": sum(step.balance_jumps for step in self.steps),
            "doubts": list(self.doubts),
        }

    def _of_colour(self) -> str:
        odd, count = int(self.odd.sum()), len(self.odd)
        if not _told(odd, count):
            return ""
        rest = "the rest" if 2 * odd <= count else "tissue under white light"
        return (
            f"{odd / count:.0%} of the frames are in another colour than {rest} (narrow-band light?): their depth is "
            f"read as if the light were white ({odd} of {count} looked at)"
        )

    def _of_gain(self) -> str:
        jumps = [abs(step.brightness) for step in self.steps if step.gain_jumps]
        if not _told(len(jumps), len(self.steps)):
            return ""
        return (
            f"the gain jumps at {len(jumps) / len(self.steps):.0%} of the frames, brightness changes there by a factor "
            f"of {np.exp(np.median(jumps)):.1f} from one to the next: what is clipped or far darker than usual is read "
            f"as if it were exposed alike ({len(jumps)} of {len(self.steps)} neighbours looked at)"
        )

    def _of_balance(self) -> str:
        jumps = [max(abs(step.red), abs(step.blue)) for step in self.steps if step.balance_jumps]
        if not _told(len(jumps), len(self.steps)):
            return ""
        return (
            f"the white balance jumps at {len(jumps) / len(self.steps):.0%} of the frames, one channel changes there "
            f"by a factor of {np.exp(np.median(jumps)):.1f} against another: their depth is read as if the light were "
            f"white and steady ({len(jumps)} of {len(self.steps)} neighbours looked at)"
        )


def _told(count: int, of: int) -> bool:
    return count > 0 and count >= _SHARE * of and (count >= _LEAST or count == of)
