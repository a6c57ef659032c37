"""The verb calibrate-light: response, spread and position of an endoscope's light."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np

from lightdepth.calibration import write_light
from lightdepth.command_line.following import Input, command, given
from lightdepth.command_line.options import Group
from lightdepth.command_line.outcome import end
from lightdepth.datasets import FormatName, SequenceSource
from lightdepth.datasets.no_camera import BOARD_NEEDS, NoCamera
from lightdepth.datasets.with_map import open_with_map
from lightdepth.detective import PairingConfig, check_pairing
from lightdepth.detective.clock import by_the_images
from lightdepth.errors import InputError
from lightdepth.files.replacing import check_files
from lightdepth.files.writing import write_together
from lightdepth.light.board import Board
from lightdepth.light.board_page import board_page
from lightdepth.light.fit_on_board import LampsConfig, PositionConfig, fit_on_board
from lightdepth.light.fit_on_map import fit_on_map
from lightdepth.light.fit_on_truth import fit_on_truth
from lightdepth.light.report import light_page
from lightdepth.photometry import PhotometricCalibration
from lightdepth.ranges import SEED, Range
from lightdepth.reporting.names import told
from lightdepth.reporting.report import Report
from lightdepth.reporting.same import plain


def calibrate_light(
    data: Path,
    output: Path,
    map: Path | None = None,
    format: FormatName | None = None,
    camera: Path | None = None,
    mask: Path | None = None,
    bit_depth: Annotated[int | None, Range(8, 32)] = None,
    seed: Annotated[int, SEED] = 0,
    pairing: Group[PairingConfig] = PairingConfig(),
    sought: Group[PositionConfig] = PositionConfig(),
    overwrite: bool = False,
) -> None:
    """The light of an endoscope: response and spread, from a map or known depth; its position, from a printed board.

    Args:
        data: Folder of frames, or video, whose light is sought.
        output: File light.json to write, with a report beside it (light.html).
        map: Sparse map of the frames (poses and points of a SLAM), by which the light is fitted: COLMAP model(s), a
            multi-map tree, a stella_vslam map, or a TUM trajectory with points; left out, the frames' own
            true depth is needed.
        format: Format of the frames: folder, video, c3vd, simcol, hamlyn, scared, endoslam or endomapper; found by
            looking if left out.
        camera: Calibration file, which wins over all others; left out, the map's own camera, else the folder's.
        mask: Image, white where tissue shows and black elsewhere; left out, the folder's own mask, where it has one.
        bit_depth: Bits per sample of pictures that have more than 8; left out, it is read from the files, else told by
            their highest values. A larger one reads the same numbers as darker.
        seed: Number that draws the bootstrap samples, which tell how sure the light is. Another one gives slightly
            different intervals.
        overwrite: Replace files that an earlier run made.
    """
    page_path = output.with_suffix(".html")
    if output.is_dir() or output.suffix == ".html":
        raise InputError(
            "-o",
            f"{output} is a folder, or named as what is written beside it",
            "expected the name of a file to write, such as light.json",
        )
    check_files([output, page_path], overwrite, [data, map, camera, mask])
    rng = np.random.default_rng(seed)
    source = SequenceSource(data, format, camera, mask=mask, bit_depth=bit_depth)
    if sought.position is not None:
        if map is not None:
            raise InputError("--position", "with --map", "give one of them: a board's own poses are found on it")
        found = _of_board(source, Board.of(sought.position, sought.board), sought.lamps, rng)
    elif sought != PositionConfig():
        raise InputError("--board, --lamps", "without --position", "say which board it is: --position charuco")
    else:
        found = _of_wall(source, map, pairing, rng)
    found.page.links([(output.name, "the light, for --light of the other verbs")])
    write_together({page_path: found.page.write, output: lambda path: write_light(found.light, path)})
    print(f"light: {found.said}")
    of_wall = sought.position is None  # of a board, the frames of the wall are others
    read_as = source.typed() if of_wall else {"--camera": Input("CAMERA", camera)}
    pairs = given(pairing) if map is not None else {}
    options = {"--map": Input("MAP", map), **pairs, **read_as, "--light": output, "-o": "runs/dense"}
    then = command("densify", Input("DATA", data) if of_wall else "DATA", options=options)
    result = {"light": plain(found.light), **found.more, "said": found.said}
    end(output, page_path, then=then, page=page_path, result=result)


@dataclass(frozen=True)
class _Found:
    """A light with what is said of it: in a line, on a page, and to programs besides."""

    light: PhotometricCalibration
    said: str
    page: Report
    more: dict[str, object]


def _of_wall(source: SequenceSource, map: Path | None, pairing: PairingConfig, rng: np.random.Generator) -> _Found:
    """By the wall itself, whose distance the map or the truth tells."""
    if map is None:
        fit = fit_on_truth(source.open(), rng)
        what = f"{source.data}, frames with known depth"
    else:
        sparse_map, frames = open_with_map(source, map, pairing)
        sparse_map = by_the_images(sparse_map, frames)
        given = frames.first().camera if source.camera is not None else None
        check_pairing(sparse_map, frames, pairing, given=given)
        fit = fit_on_map(frames, sparse_map, camera=given, rng=rng)
        what = f"{source.data}, {sparse_map.source}"
    page = light_page(fit, told(what, data=source.data, map=map))
    return _Found(fit.light, fit.summary(), page, {"errors": fit.errors, "uncertainty": fit.uncertainty})


def _of_board(source: SequenceSource, board: Board, config: LampsConfig, rng: np.random.Generator) -> _Found:
    """By a printed board, with the light's position."""
    if source.asks_for_camera:
        raise InputError("--camera auto", f"with {board.name}", BOARD_NEEDS)
    try:
        frames = source.open()
    except NoCamera as error:
        raise error.of_board() from error
    found = fit_on_board(frames, board, config, rng)
    page = board_page(found, told(f"{source.data}, frames of {board.name}", data=source.data))
    more = {
        "interval_mm": plain([[a - w, a + w] for a, w in zip(found.fit.lamps.middle, found.half_width, strict=True)]),
        "left": found.left,
        "withheld": plain(found.withheld),
        "frames": [white.name for white in found.whites],
    }
    return _Found(found.light, found.summary(), page, more)
