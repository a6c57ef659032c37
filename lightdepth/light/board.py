"""A printed calibration board in a frame: its corners, by OpenCV, and where its paper is white.

Board axes: x to the right and y down along the print, from the outer corner of its first square, z into the board; mm.
A checkerboard of even symmetry looks the same from both ends: which end is taken for the first does not matter, as the
plane and its white squares are the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Annotated, Any, Literal, get_args

import cv2
import numpy as np

from lightdepth.errors import InputError, MissingOption
from lightdepth.ranges import Range, above, checked

Kind = Literal["charuco", "checkerboard"]
Dictionary = Literal["4x4", "5x5", "6x6", "7x7", "original"]
LEAST_CORNERS = 8
"""Fewer do not tell how a board is tilted."""
_LEAST_SIDE = 24  # pixels of an image
_PART = 60  # samples of the drawing a square


@dataclass(frozen=True)
@checked
class BoardConfig:
    """The print, as it was measured."""

    squares: Annotated[tuple[int, int] | None, Range(3, 100)] = None
    """Numbers of squares across and down, black and white ones counted, as in [9,7]. More mean a board with more
    corners."""
    square_mm: Annotated[float | None, above(0, up_to=1000)] = None
    """Side of a square on the print, mm: all millimetres come from it. A larger one puts the light further away."""
    marker_mm: Annotated[float | None, above(0, up_to=1000)] = None
    """Side of a marker of a charuco board, mm, its black border included. A larger one leaves less white around it."""
    dictionary: Dictionary = "4x4"
    """Number of dots across and down in a charuco board's markers, from OpenCV's dictionaries or ArUco's original one.
    How many markers the dictionary has, as in 4x4_250, does not matter: the first ones are the same."""


@dataclass(frozen=True)
class Board:
    """A board that can be looked for."""

    kind: Kind
    squares: tuple[int, int]
    square_mm: float
    marker_mm: float = 0.0
    dictionary: Dictionary = "4x4"
    legacy: bool = False
    """Whether the markers of a charuco board begin in its first square, as OpenCV drew them before 4.6."""
    odd: bool = False
    """Whether the first square of a checkerboard is white."""

    @classmethod
    def of(cls, kind: Kind, config: BoardConfig) -> Board:
        """Raises MissingOption without a size, InputError where sizes do not fit each other."""
        if config.squares is None or config.square_mm is None:
            missing = "--board.squares" if config.squares is None else "--board.square-mm"
            raise MissingOption(missing, "not given", "give the board's: --board.squares [9,7] --board.square-mm 4")
        if kind == "checkerboard":
            return cls(kind, config.squares, config.square_mm)
        if config.marker_mm is None:
            raise MissingOption("--board.marker-mm", "not given", "give the side of a charuco board's markers, mm")
        if not 0.2 * config.square_mm <= config.marker_mm < config.square_mm:
            raise InputError(
                "--board.marker-mm",
                f"{config.marker_mm:g} in squares of {config.square_mm:g} mm",
                "expected less than the square's side, and a fifth of it at least",
            )
        board = cls(kind, config.squares, config.square_mm, config.marker_mm, config.dictionary)
        needed, held = board._markers, len(_words(config.dictionary, 1000).bytesList)
        if needed > held:
            raise InputError(
                "--board.dictionary",
                f"{config.dictionary} has {held} markers, and a board of {_by(config.squares)} needs {needed}",
                "expected the board's own",
            )
        return board

    @property
    def name(self) -> str:
        """For sentences."""
        return f"a {self.kind} of {_by(self.squares)} squares"

    @property
    def _words(self) -> cv2.aruco.Dictionary:
        return _words(self.dictionary, self._markers)

    @property
    def _markers(self) -> int:
        return self.squares[0] * self.squares[1] // 2

    @property
    def _charuco(self) -> cv2.aruco.CharucoBoard:
        made = cv2.aruco.CharucoBoard(self.squares, self.square_mm, self.marker_mm, self._words)
        made.setLegacyPattern(self.legacy)
        return made

    def white_within(self, places: np.ndarray) -> np.ndarray:
        """How far [mm] places (n, 2) of the print are from what is not white; 0 where they are not white themselves,
        and beside the squares."""
        column, row = np.floor(places * (_PART / self.square_mm)).astype(int).T
        white = _white(self)
        height, width = white.shape
        inside = (column >= 0) & (row >= 0) & (column < width) & (row < height)
        found: np.ndarray = np.where(inside, white[np.where(inside, row, 0), np.where(inside, column, 0)], 0.0)
        return found


@dataclass(frozen=True)
class Sighting:
    """A board's corners in an image: places on the print (n, 2) [mm], and pixels (n, 2), first centre at (0.5, 0.5)."""

    board: Board
    """as it was found: which of its squares are white"""
    places: np.ndarray
    pixels: np.ndarray


def find_board(image: np.ndarray, board: Board) -> Sighting | None:
    """The board in an image (H, W, 3) in [0, 1]; None where fewer than eight of its corners are seen (of a
    checkerboard, where any is not)."""
    if min(image.shape[:2]) < _LEAST_SIDE:
        return None
    return _charuco(_grey8(image), board) if board.kind == "charuco" else _checkerboard(_grey8(image), board)


def _charuco(grey: np.ndarray, board: Board) -> Sighting | None:
    best: Sighting | None = None
    markers: list[Any] = []  # they are the same in both
    for legacy in dict.fromkeys((board.legacy, not board.legacy)):
        one = replace(board, legacy=legacy)
        detector = cv2.aruco.CharucoDetector(one._charuco)
        pixels, ids, *markers = detector.detectBoard(grey, None, None, *markers)
        if ids is not None and len(ids) >= LEAST_CORNERS and (best is None or len(ids) > len(best.places)):
            at = np.asarray(one._charuco.getChessboardCorners(), float)[ids.ravel(), :2]
            best = Sighting(one, at, pixels.reshape(-1, 2).astype(float) + 0.5)
        if best is not None or board.squares[1] % 2:  # both ways of drawing are the same where rows are odd
            break
    return best


def _checkerboard(grey: np.ndarray, board: Board) -> Sighting | None:
    inner = (board.squares[0] - 1, board.squares[1] - 1)
    found, pixels = cv2.findChessboardCornersSB(grey, inner, None, cv2.CALIB_CB_NORMALIZE_IMAGE)
    if not found:
        return None
    pixels = pixels.reshape(-1, 2).astype(float)
    row, column = (part.ravel() for part in np.indices(inner[::-1]))
    places = np.stack([column + 1, row + 1], -1) * board.square_mm
    squares = pixels.reshape(*inner[::-1], 2)  # the middles of squares inside: which of them are white
    middle = (squares[:-1, :-1] + squares[1:, :-1] + squares[:-1, 1:] + squares[1:, 1:]) / 4
    u, v = np.rint(middle).astype(int).reshape(-1, 2).T
    level = grey[v.clip(0, grey.shape[0] - 1), u.clip(0, grey.shape[1] - 1)].astype(float)
    parity = np.indices(middle.shape[:2]).sum(0).ravel() % 2
    odd = bool(np.median(level[parity == 0]) > np.median(level[parity == 1]))
    return Sighting(replace(board, odd=odd), places, pixels + 0.5)


@lru_cache(maxsize=4)
def _white(board: Board) -> np.ndarray:
    """Distance [mm] of places of the print from what is not white, `_PART` places a square. Read-only: it is kept."""
    across, down = (n * _PART for n in board.squares)
    if board.kind == "charuco":
        drawn = board._charuco.generateImage((across, down), marginSize=0)
    else:
        row, column = np.indices((down, across)) // _PART
        drawn = np.where((row + column) % 2 == int(board.odd), 0, 255)
    white = cv2.copyMakeBorder((drawn > 127).astype(np.uint8), 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=0)
    away = cv2.distanceTransform(white, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)[1:-1, 1:-1]
    result: np.ndarray = away * (board.square_mm / _PART)
    result.flags.writeable = False
    return result


def what_is_there(images: Sequence[np.ndarray], board: Board) -> str:
    """What images show in place of a board that was not found, for a sentence; "" where nothing is recognised."""
    across, down = board.squares
    if board.kind == "checkerboard":
        for squares in ((across + 1, down + 1), (down, across), (down + 1, across + 1), (across - 1, down - 1)):
            if min(squares) >= 3 and any(find_board(image, replace(board, squares=squares)) for image in images):
                return f"a checkerboard of {_by(squares)} squares is there"
        return ""
    images = [image for image in images if min(image.shape[:2]) >= _LEAST_SIDE]
    for name in get_args(Dictionary):
        detector = cv2.aruco.ArucoDetector(_words(name, 250))
        seen = [ids.ravel() for image in images if (ids := detector.detectMarkers(_grey8(image))[1]) is not None]
        if seen and max(map(len, seen)) >= 4:
            return f"markers of {name} are there, with numbers up to {max(map(np.max, seen))}"
    return ""


def _words(name: str, markers: int) -> cv2.aruco.Dictionary:
    """The smallest dictionary that has so many markers: fewer words are told apart better."""
    held = next((n for n in (50, 100, 250) if n >= markers), 1000)
    code = "DICT_ARUCO_ORIGINAL" if name == "original" else f"DICT_{name.upper()}_{held}"
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, code))


def _grey8(image: np.ndarray) -> np.ndarray:
    """(H, W) uint8, its brightest parts white: boards are looked for in dark images too."""
    grey = image.mean(-1)
    top = max(float(np.quantile(grey, 0.995)), 0.02)
    found: np.ndarray = np.rint(255 * np.clip(grey / top, 0, 1)).astype(np.uint8)
    return found


def _by(squares: tuple[int, int]) -> str:
    return f"{squares[0]} by {squares[1]}"
