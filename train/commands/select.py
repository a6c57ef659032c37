"""`lightdepth select`: the list of frames worth training on, a table of why, and a page to look at.

LIST (names, one a line), and beside it STEM.csv (one row a frame), STEM_contact.png and STEM.html.
"""

from __future__ import annotations

import csv
import io
import json
import time
import warnings
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, astuple, dataclass, field, fields, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np

from lightdepth.command_line.following import Input, Value, command
from lightdepth.command_line.options import Group
from lightdepth.command_line.outcome import end
from lightdepth.counting import full_stop
from lightdepth.datasets import FormatName, FrameSequence, SequenceSource
from lightdepth.datasets.coloured import colours_of
from lightdepth.datasets.with_map import open_with_map
from lightdepth.errors import AlreadyFinished, InputError
from lightdepth.files.replacing import check_files
from lightdepth.files.writing import Content, write_together
from lightdepth.foreign_text import for_table
from lightdepth.image_quality import RepeatFinder
from lightdepth.maps.convention import MapReading
from lightdepth.ranges import Range, checked
from lightdepth.reporting import batches
from lightdepth.reporting.beside import goes_on, kept_beside
from lightdepth.reporting.figures import BAD, GOOD, contact_sheet, jpeg, png, thumbnail
from lightdepth.reporting.names import told
from lightdepth.reporting.progress import Progress
from lightdepth.reporting.report import SMALL, Report, Tile
from lightdepth.reporting.run import Run, recorded
from lightdepth.sparse_map import SparseMap

from ..selecting.covisibility import (
    LOFTR_NODES,
    SIFT_NODES,
    FrameVerdict,
    MapRules,
    NodeRules,
    Seen,
    published_pairs,
    select_by_map,
    select_by_matching,
)
from ..selecting.matching import (
    LoftrMatcher,
    LoftrSettings,
    MatchAgreement,
    Matcher,
    OrientationDescriptor,
    SiftMatcher,
    SiftSettings,
)

_SHOWN = 48  # pictures of kept and of rejected frames each
_FILES = {
    "list": "the names of the kept frames, for train --data.frames",
    "table": "every frame, with its figures and why it is kept or not",
    "sheet": "pictures of kept and rejected frames",
}
"""What is written beside the page, of `_paths`."""


@dataclass(frozen=True)
@checked
class SelectConfig:
    """What is covisible and what is kept, by each way of telling."""

    matcher: Literal["sift", "loftr"] = "sift"
    """What matches images where there is no --map: sift, by single features; loftr, by a network, which finds matches
    on smoother tissue, takes longer and needs --loftr.weights. Its options begin with its name."""
    sift: SiftSettings = field(default_factory=SiftSettings)
    """features of the sift matcher"""
    sift_nodes: NodeRules = SIFT_NODES
    """what is covisible and what is kept, with the sift matcher"""
    loftr: LoftrSettings = field(default_factory=LoftrSettings)
    """weights and thresholds of the loftr matcher"""
    loftr_nodes: NodeRules = LOFTR_NODES
    """what is covisible and what is kept, with the loftr matcher"""
    bit_depth: Annotated[int | None, Range(8, 32)] = None
    """Bits per sample of pictures that have more than 8; left out, it is read from the files, else told by their
    highest values. A larger one reads the same numbers as darker."""
    map_rules: MapRules = field(default_factory=MapRules)
    """what is kept, with --map"""


def select(
    data: Path,
    output: Path,
    map: Path | None = None,
    format: FormatName | None = None,
    camera: Path | None = None,
    mask: Path | None = None,
    config: Group[SelectConfig] = SelectConfig(),
    reading: Group[MapReading] = MapReading(),
    with_folder: bool = False,
    no_frames: bool = False,
    overwrite: bool = False,
    resume: bool = False,
) -> None:
    """The frames worth training on, by covisibility: not blur, water, stool, nor walls too near.

    Args:
        data: Folder of frames, or a video, to choose from.
        output: Text file to write with the names of the kept frames, one a line; beside it come a table of all frames
            (.csv), a sheet of pictures (_contact.png) and a page (.html).
        map: Sparse map of the frames (a SLAM export or a COLMAP model): which keyframes see the same wall (are
            covisible) is then read from it, by --map-rules, and no images are matched.
        format: Format of the frames: folder (images with camera.json), video, or the data set c3vd, simcol, hamlyn,
            scared, endoslam or endomapper. Left out, it is told by the files.
        camera: Calibration file of the camera, used instead of the folder's own; left out, the folder's, else the
            map's.
        mask: Image, white where tissue shows and black elsewhere, used instead of the folder's own mask. Left out, the
            folder's own, where it has one, else the whole image.
        with_folder: true: names are written as folder/name, so that lists of several sequences can be joined. false: as
            name alone.
        no_frames: Leave out all pictures: the sheet is not written, and the page has none. Without it, both show
            frames.
        overwrite: Replace the files of an earlier run. Without it, files that are already there are refused.
        resume: Go on with the run that was stopped there, as it was begun; frames that were looked at are not matched
            again.
    """
    if resume and overwrite:
        raise InputError("--resume, --overwrite", "they contradict each other", "give one of them")
    paths, going_on = _paths(output), resume and goes_on(output)
    # A run that goes on may have been begun by --overwrite; one that is finished is looked at before it is refused.
    replacing = overwrite or going_on or (resume and output.is_file())
    check_files(paths.values(), replacing, [data, map, camera, mask])
    if output.resolve().parent == data.resolve() and not no_frames and any(c.isdigit() for c in output.stem):
        found = f"{paths['sheet'].name}, among the frames, would be taken for one: it has a number"
        raise InputError("-o", found, "choose a name without digits, another folder, or --no-frames")
    source = SequenceSource(data, format, camera, mask=mask, bit_depth=config.bit_depth)
    sparse_map, frames = (None, source.open()) if map is None else open_with_map(source, map, reading)
    frames = frames.without_truth()
    way = _way(frames, sparse_map, map, config)
    shown, header = told(str(data), data=data, map=map), [told(line, data=data, map=map) for line in way.header]
    arguments = recorded(source, config, reading, output=output, map=map, with_folder=with_folder, no_frames=no_frames)
    with kept_beside(output, "select", arguments, overwrite, resume) as run:
        made_by = run.check_inputs(**source.files, map=map, weights=config.loftr.weights)
        if resume and not run.resumed and output.is_file():
            _check_finished(paths, made_by, no_frames)
        doubts = colours_of(frames).doubts
        for doubt in doubts:
            warnings.warn(f"{data}: {doubt}", stacklevel=2)
        verdicts = _kept(run, way)
        if not any(v.kept for v in verdicts):
            raise InputError(
                data,
                f"none of the {len(verdicts)} frames is kept ({_counts(verdicts)})",
                "loosen the limits that reject them; nothing was written",
            )
        summary = f"{sum(v.kept for v in verdicts)} of {len(verdicts)} frames kept; rejected: {_counts(verdicts)}"
        folder = f"{data.resolve().name}/" if with_folder else ""
        chosen = [f"{folder}{v.name}" for v in verdicts if v.kept]
        listed = [_comment(line) for line in (f"{shown}: {summary}", *header, _ending(made_by, len(chosen)))]
        listed += chosen
        pictures = [] if no_frames else _pictures(frames, verdicts)
        doubts = tuple(told(doubt, data=data, map=map) for doubt in doubts)
        page = _page(f"{shown}, {header[0]}: {summary}.", header[1:], verdicts, pictures, doubts)
        page.links([(paths[what].name, said) for what, said in _FILES.items() if what != "sheet" or not no_frames])
        writers: dict[Path, Content] = {
            paths["table"]: _table(verdicts),
            paths["page"]: page.write,
            paths["list"]: "\n".join(listed) + "\n",  # last: its presence means all is there
        }
        if pictures:
            writers = {paths["sheet"]: _sheet(pictures), **writers}
        check_files(writers, replacing)  # a run to list.md writes list.csv too
        write_together(writers)
        if no_frames:
            paths["sheet"].unlink(missing_ok=True)  # that of an earlier run shows other frames
    print(summary)
    read_as = SequenceSource(data, format, camera, mask=mask).typed()
    frames_of: dict[str, Value] = {"--data.sequences": Input("'[DATA]'", json.dumps([str(data)]))}
    frames_of |= {f"--data.{option[2:]}": value for option, value in read_as.items()} | {"--data.frames": output}
    then = command("train", options={"--preset": "lightdepth", "-o": "runs/self", **frames_of})
    result = {"frames": len(verdicts), "kept": len(chosen), "rejected": dict(_rejected(verdicts))}
    beside = [path for path in writers if path != output]
    end(output, *beside, then=then, page=paths["page"], result=result, doubts=doubts)


@dataclass(frozen=True)
class _Way:
    """How frames are chosen: a sentence and a line for each setting, and what gives the verdicts."""

    header: tuple[str, ...]
    verdicts: Callable[[Run], list[FrameVerdict]]


def _way(frames: FrameSequence, sparse_map: SparseMap | None, folder: Path | None, config: SelectConfig) -> _Way:
    if sparse_map is not None and folder is not None:
        found, how = _by_map(frames, sparse_map, folder, config.map_rules)
        return _Way((how, *_lines({"map": str(folder), **asdict(config.map_rules)})), lambda run: found)
    used: Matcher = SiftMatcher(config.sift) if config.matcher == "sift" else LoftrMatcher(config.loftr)
    rules = config.sift_nodes if config.matcher == "sift" else config.loftr_nodes
    own = asdict(config.sift if config.matcher == "sift" else config.loftr)
    lines = _lines({"matcher": config.matcher, **asdict(rules), **own})
    return _Way((f"frames matched with {config.matcher}", *lines), lambda run: _by_matching(run, frames, used, rules))


def _lines(settings: Mapping[str, object]) -> list[str]:
    return [f"{name}: {value}" for name, value in settings.items() if value is not None]


def _comment(line: str) -> str:
    return f"# {' '.join(line.split())}"


def _ending(made_by: str, count: int) -> str:
    """The last line before the names, by which a finished list is known again."""
    return f"run {made_by}, {count} names follow"


def _check_finished(paths: Mapping[str, Path], made_by: str, no_frames: bool) -> None:
    """Raises AlreadyFinished where the list is whole, of these frames and settings, and all is there that belongs to
    it, else InputError."""
    output, cure = paths["list"], "choose another -o, or give --overwrite to start anew"
    lines = output.read_text(encoding="utf-8", errors="replace").split("\n")
    said = [line for line in lines if line.startswith("# run ")]
    if not said or not said[-1].startswith(f"# run {made_by}, "):
        raise InputError(output, "not resumed, it was made with other frames or settings", cure)
    if said[-1] != _comment(_ending(made_by, sum(bool(line) and not line.startswith("#") for line in lines))):
        raise InputError(output, "not resumed, it is finished, but was changed since", cure)
    for what, path in paths.items():
        if not path.is_file() and not (what == "sheet" and no_frames):
            raise InputError(output, f"not resumed, it is finished, but {path.name} beside it is gone", cure)
    raise AlreadyFinished(f"{output.name} is already finished")


def _kept(run: Run, way: _Way) -> list[FrameVerdict]:
    """The verdicts, or those that were there when the run was stopped as it wrote."""
    if run.done("verdicts"):
        return [FrameVerdict(**each) for each in run.kept_of("verdicts")]
    verdicts = way.verdicts(run)
    run.finish_part("verdicts", [], [asdict(each) for each in verdicts])
    return verdicts


def _by_matching(run: Run, frames: FrameSequence, matcher: Matcher, rules: NodeRules) -> list[FrameVerdict]:
    """Verdicts by matching images; what is known of the frames before a node is kept now and then."""
    before: list[Seen] = []
    for part in list(run.parts or {}):
        before += [_seen_again(each) for each in run.kept_of(part)] if run.done(part) else []
    kept, since = len(before), time.monotonic()

    def keep(seen: Sequence[Seen]) -> None:
        nonlocal kept, since
        if time.monotonic() - since >= batches.SECONDS:
            run.finish_part(f"frames from {kept}", [], [asdict(each) for each in seen[kept:]])
            kept, since = len(seen), time.monotonic()

    with Progress("Selecting", len(frames)) as bar:
        describe, again = OrientationDescriptor(), RepeatFinder().again
        return select_by_matching(frames, frames.names, describe, matcher, rules, bar.advance, again, before, keep)


def _seen_again(kept: Mapping[str, Any]) -> Seen:
    found = Seen(**kept)
    return replace(found, agreement=None if found.agreement is None else MatchAgreement(*found.agreement))


def _paths(output: Path) -> dict[str, Path]:
    if output.is_dir() or output.suffix in (".csv", ".html", ".png"):
        raise InputError(
            "-o",
            f"{output} is a folder, or named as what is written beside it",
            "expected the name of a list to write, such as frames.txt",
        )
    beside = output.parent / output.stem
    paths = {"list": output}
    for what, ending in (("table", ".csv"), ("sheet", "_contact.png"), ("page", ".html")):
        paths[what] = beside.with_name(beside.name + ending)
    return paths


def _by_map(
    frames: FrameSequence, sparse_map: SparseMap, folder: Path, rules: MapRules
) -> tuple[list[FrameVerdict], str]:
    pairs = published_pairs(folder, sparse_map) if rules.published else {}
    how = f"covisibility of {sparse_map.source}" + (" by its camerasModel.txt" if pairs else "")
    return select_by_map(frames.names, sparse_map, rules, pairs), how


def _counts(verdicts: Sequence[FrameVerdict]) -> str:
    return ", ".join(f"{count} {reason}" for reason, count in _rejected(verdicts).most_common()) or "none"


def _rejected(verdicts: Sequence[FrameVerdict]) -> Counter[str]:
    return Counter(v.reason for v in verdicts if not v.kept)


def _table(verdicts: Sequence[FrameVerdict]) -> str:
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow([f.name for f in fields(FrameVerdict)])
    for verdict in verdicts:
        row = [int(v) if isinstance(v, bool) else f"{v:.4f}" if isinstance(v, float) else v for v in astuple(verdict)]
        writer.writerow(for_table(v) if isinstance(v, str) else v for v in row)
    return buffer.getvalue()


def _pictures(frames: FrameSequence, verdicts: Sequence[FrameVerdict]) -> list[tuple[np.ndarray, FrameVerdict]]:
    """Kept and rejected frames in order, spread over the sequence. Read again: keeping them would fill the memory."""
    rows = []
    for kept in (True, False):
        readable = [i for i, v in enumerate(verdicts) if v.kept == kept and v.reason != "unreadable"]
        rows += [readable[i] for i in np.linspace(0, len(readable) - 1, min(_SHOWN, len(readable))).astype(int)]
    rows.sort()
    return [(thumbnail(frames[i].image, 160), verdicts[i]) for i in rows]


def _sheet(pictures: Sequence[tuple[np.ndarray, FrameVerdict]]) -> bytes:
    labels = [f"{verdict.name[-14:]} {verdict.reason}"[:28] for _, verdict in pictures]
    return png(contact_sheet([p for p, _ in pictures], labels, [_color(verdict) for _, verdict in pictures]))


def _tile(picture: np.ndarray, verdict: FrameVerdict) -> Tile:
    return Tile(jpeg(picture), f"{verdict.name} {verdict.reason}".strip(), _color(verdict))


def _color(verdict: FrameVerdict) -> tuple[int, int, int]:
    return GOOD if verdict.kept else BAD


def _page(
    said: str,
    settings: Sequence[str],
    verdicts: Sequence[FrameVerdict],
    pictures: Sequence[tuple[np.ndarray, FrameVerdict]],
    doubts: Sequence[str],
) -> Report:
    page = Report("Frames worth training on")
    page.text(said)
    for doubt in doubts:
        page.text(full_stop(f"Warning: {doubt}"))
    counts = Counter("kept" if v.kept else v.reason for v in verdicts)
    page.table(["", "frames", "share"], [[what, n, n / len(verdicts)] for what, n in counts.most_common()])
    if any(v.reason == "blur" for v in verdicts):
        page.text("Blur stands for all that shows little detail: blur, water, cover, and walls too near.")
    if pictures:
        page.heading("Kept (green) and rejected (red)")
        said = f"At most {_SHOWN} of each, spread over the sequence, in its order"
        page.tiles([_tile(*picture) for picture in pictures], said, SMALL)
    page.heading("Settings")
    page.table(["", "value"], [line.split(": ", 1) for line in settings])
    return page
