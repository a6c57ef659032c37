"""Frames by name: lists that `select` writes, entries of a split, and how their sequences are opened."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from lightdepth.datasets import FrameSequence, SequenceSource
from lightdepth.datasets.splits import Chosen, Split
from lightdepth.errors import InputError
from lightdepth.regular import regular


def read_frame_list(path: Path) -> list[str]:
    """Frame names, one a line; empty lines and lines that start with # are skipped."""
    regular(path)
    try:
        lines = [line.strip() for line in path.read_text(encoding="utf-8-sig", errors="surrogateescape").splitlines()]
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(
            path,
            f"cannot be read as a list of frame names ({error})",
            "expected one a line, as `lightdepth select` writes",
        ) from error
    names = [line for line in lines if line and not line.startswith("#")]
    if not names:
        raise InputError(path, "no frame names in it", "expected one a line, as `lightdepth select` writes")
    return names


@dataclass(frozen=True)
class Listed:
    """An entry of a split."""

    split: Split
    chosen: Chosen


def open_listed(source: Callable[..., SequenceSource], path: str, of: Listed | None) -> FrameSequence:
    """The frames of a sequence, or those of them that a split lists; `source(path, format)` says how it is read."""
    if of is None:
        return source(path).open()
    info, expected = of.split.info, of.split.frame_count(of.chosen.name)
    frames = source(path, None if info is None else info.format).open()
    if expected is not None and len(frames) != expected:
        warnings.warn(f"{path}: {len(frames)} frames; the data set has {expected}. Is it complete?", stacklevel=2)
    rows = [i for i, number in enumerate(frames.numbers) if of.chosen.takes(number)]
    if not rows:
        raise InputError(
            path,
            f"no frame in {of.chosen}",
            f"choose others: its numbers are {frames.numbers[0]} to {frames.numbers[-1]}",
        )
    return frames.at(rows)


def listed_rows(path: Path, sequences: Mapping[str, FrameSequence]) -> dict[str, list[int]]:
    """Rows of the listed frames in each sequence, in its order; a frame's ending does not count.

    An entry `folder/name` is a frame of the sequence whose path ends in `folder`. Raises InputError for one that is in
    no sequence, or in several.
    """
    rows: dict[str, set[int]] = {where: set() for where in sequences}
    known: dict[str, list[tuple[str, int]]] = {}
    for where, frames in sequences.items():
        for i, name in enumerate(frames.names):
            known.setdefault(_stem(name), []).append((where, i))
    found: dict[str, list[tuple[str, int]]] = {}
    for entry in read_frame_list(path):
        *folders, name = entry.replace("\\", "/").split("/")
        ends = {where: Path(where).resolve().parts[-len(folders) :] == tuple(folders) for where in sequences}
        found[entry] = [(where, i) for where, i in known.get(_stem(name), []) if not folders or ends[where]]
    if not any(found.values()):
        raise InputError(
            path,
            f"none of the {len(found)} listed frames is in {' or '.join(sequences)}",
            "give the list of these sequences",
        )
    for entry, places in found.items():
        if not places:
            raise InputError(
                path, f"{entry} is not a frame of {' or '.join(sequences)}", "take it out, or give its sequence too"
            )
        if len(places) > 1:
            raise InputError(path, f"{entry} is in {' and in '.join(w for w, _ in places)}", "write folder/name")
        rows[places[0][0]].add(places[0][1])
    return {where: sorted(chosen) for where, chosen in rows.items()}


def _stem(name: str) -> str:
    """The name without folder and without the ending of an image; dots in names are kept."""
    from lightdepth.datasets.sequence import IMAGE_SUFFIXES

    last = Path(name)
    return last.stem if last.suffix.lower() in IMAGE_SUFFIXES else last.name
