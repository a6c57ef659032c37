"""Which frames are worth training on: those that see what other frames see.

Walls too near, water, stool and blur match nothing; a frame that many others are covisible with is a good one. With
frames alone this is ColonMapper's mapping (Morlana, Tardós and Montiel): consecutive frames gather in a node while they
match; a node with few views is thrown away with all its frames. With a sparse map, its covisibility graph says it.

A node has views, against which new frames are compared, and frames, which are its views and what lies between them.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np

from lightdepth.errors import InputError
from lightdepth.frame import Frame, frame_number
from lightdepth.image_quality import RepeatFinder
from lightdepth.ranges import SHARE, Range, at_least, checked
from lightdepth.sparse_map import SparseMap, Submap, covisibility

from .matching import Descriptor, MatchAgreement, Matcher

BLUR, NO_MATCHES, FEW_VIEWS, UNREADABLE = "blur", "no matches", "too few views", "unreadable"
DOUBLE = "double"
NOT_IN_MAP, FEW_KEYFRAMES = "not in the map", "too few covisible keyframes"


@dataclass(frozen=True)
@checked
class NodeRules:
    """When a frame belongs to a node, and which nodes are kept."""

    similarity: Annotated[float, Range(-1, 1)] = 0.98
    """Likeness of two frames, a cosine up to 1 (the same), above which a frame joins the present node without being
    matched (a node is a run of frames that see the same wall). A higher one matches more frames and takes longer."""
    min_matches: Annotated[int, at_least(0)] = 15
    """Number of matches above which two frames count as covisible, that is as seeing the same wall. More keep fewer
    frames."""
    min_spread: Annotated[float, SHARE] = 0.2
    """Least share of the image (of the cells of an 8 x 8 grid) in which the matches of two covisible frames must lie; 0
    asks for none. A larger one keeps fewer frames."""
    min_views: Annotated[int, at_least(1)] = 3
    """Least number of views that a node must have for its frames to be kept (a node is a run of frames that see the
    same wall; its views are those that further frames are matched with). More keep fewer frames."""
    max_skipped: Annotated[int, at_least(0)] = 1
    """Largest number of frames in a row that are taken for the same wall by `similarity` alone, without being matched;
    0 matches every frame. More take less time and notice changes later."""
    min_frames: Annotated[int, at_least(1)] = 1
    """Least number of frames from one view of a node to the next (a node is a run of frames that see the same wall; its
    views are those that further frames are matched with). More make fewer views, so that fewer nodes reach
    min_views."""
    max_views: Annotated[int, at_least(1)] = 29
    """Number of views above which a node ends and the next frame begins another (a node is a run of frames that see the
    same wall; its views are those that further frames are matched with). More make longer nodes."""
    reference: Literal["last", "middle"] = "last"
    """Which view of a node a new frame is matched with (a node is a run of frames that see the same wall): last, the
    newest, so that a node may move along the wall; middle, an older one, so that a node ends sooner as the camera moves
    on."""
    blur: Annotated[float, at_least(0)] = 0.5
    """Share of the median number of features of the kept frames, below which a frame is rejected as blurred, even where
    it matches others; 0 rejects none. A larger one rejects more frames. With the loftr matcher, which has no features
    to count, it has no effect."""

    def __post_init__(self) -> None:
        if self.max_views < self.min_views - 1:
            raise InputError(
                "max_views",
                f"{self.max_views}, and so no node could have min_views {self.min_views}",
                "expected at least min_views",
            )


# Calibrated on the synthetic colons of tests/benchmarks/bench_select.py, seeds 100 to 107.
SIFT_NODES = NodeRules()
# ColonMapper's published values, for EndoMapper; confidence 0.4 is in LoftrSettings. Its video is not thinned.
LOFTR_NODES = NodeRules(
    similarity=0.92, min_matches=100, min_spread=0.0, min_views=3, max_skipped=7, min_frames=4, max_views=9
)


@dataclass(frozen=True)
class FrameVerdict:
    """One frame: kept, or the reason why not. `node` counts nodes, or is the submap's id; `similarity` is the largest
    cosine to the node's views, `matches` and `spread` are with its reference view; None where not looked at."""

    name: str
    kept: bool
    reason: str = ""
    node: int | None = None
    view: bool = False
    similarity: float | None = None
    matches: int | None = None
    spread: float | None = None
    features: int | None = None


@dataclass
class _Node:
    """The node that is being filled."""

    id: int
    frames: list[int]
    views: list[tuple[int, np.ndarray, Any]]
    skipped: int = 0

    @property
    def updated(self) -> int:
        return self.views[-1][0]

    def similarity(self, descriptor: np.ndarray) -> float:
        return max(float(descriptor @ view) for _, view, _ in self.views)

    def reference(self, which: str) -> Any:
        return self.views[-1 if which == "last" else len(self.views) // 2][2]


@dataclass
class Seen:
    """What is remembered of a frame: all that the verdicts need."""

    name: str
    node: int | None = None
    view: bool = False
    similarity: float | None = None
    agreement: MatchAgreement | None = None
    features: int | None = None
    double: bool = False


def select_by_matching(
    frames: Sequence[Frame],
    names: Sequence[str],
    descriptor: Descriptor,
    matcher: Matcher,
    rules: NodeRules,
    advance: Callable[[], None] = lambda: None,
    repeated: Callable[[np.ndarray], bool] = lambda image: False,
    before: Sequence[Seen] = (),
    at_node: Callable[[Sequence[Seen]], None] = lambda seen: None,
) -> list[FrameVerdict]:
    """A verdict for every frame, in order. Each frame is read and described once; images are not kept.

    A frame that cannot be read is rejected, and so is one whose image repeats the one before (`repeated`): it
    matches it, and shows nothing new. `at_node` is told of all frames until then where a node begins with the last of
    them; a run that is given these as `before` goes on there. Raises InputError when none can be read.
    """
    seen = list(before)
    views_in = Counter(s.node for s in seen if s.node is not None and s.view)
    node = _begun_again(frames, seen, descriptor, matcher, repeated) if seen else None
    trouble = ""
    for i, name in enumerate(names):
        advance()
        if i < len(before):
            continue
        seen.append(Seen(name))
        try:
            frame = frames[i]
        except InputError as error:
            trouble = trouble or str(error)
            continue
        seen[i].double = repeated(frame.image)
        if seen[i].double:
            continue
        described, kept = descriptor(frame), matcher.keep(frame)
        seen[i].features = matcher.count(kept)
        node = _into_node(i, described, kept, node, seen[i], matcher, rules)
        if node is None or node.frames[-1] != i:
            node = _Node(len(views_in), [i], [(i, described, kept)])
        seen[i].node, seen[i].view = node.id, node.updated == i
        views_in[node.id] = len(node.views)
        if node.frames[0] == i:
            at_node(seen)
        if len(node.views) > rules.max_views:
            node = None
    if not views_in:
        raise InputError("the frames", "none could be read", f"the first reason: {trouble}")
    good = {id for id, views in views_in.items() if views >= rules.min_views}
    counts = [s.features for s in seen if s.node in good and s.features is not None]
    least = rules.blur * float(np.median(counts)) if counts else 0.0
    blurred = [s.features is not None and s.features < least for s in seen]
    sharp_views = Counter(s.node for s, blur in zip(seen, blurred, strict=True) if s.view and not blur)
    good = {id for id in good if sharp_views[id] >= rules.min_views}
    return [_verdict(s, blur, views_in, good) for s, blur in zip(seen, blurred, strict=True)]


def _begun_again(
    frames: Sequence[Frame],
    seen: Sequence[Seen],
    descriptor: Descriptor,
    matcher: Matcher,
    repeated: Callable[[np.ndarray], bool],
) -> _Node:
    """The node that begins with the last of the frames seen; what tells repeats is shown those before it again."""
    last = len(seen) - 1
    readable = [i for i, s in enumerate(seen) if s.node is not None or s.double]
    for i in readable[-RepeatFinder.LOOKS_BACK :]:
        repeated(frames[i].image)
    frame, id = frames[last], seen[last].node
    assert id is not None
    return _Node(id, [last], [(last, descriptor(frame), matcher.keep(frame))])


def _into_node(
    i: int, described: np.ndarray, kept: Any, node: _Node | None, seen: Seen, matcher: Matcher, rules: NodeRules
) -> _Node | None:
    """The node with frame `i` in it where it belongs there; else as it was."""
    if node is None:
        return None
    seen.similarity = node.similarity(described)
    if seen.similarity > rules.similarity and node.skipped < rules.max_skipped:
        node.skipped += 1
        node.frames.append(i)
        return node
    seen.agreement = agreement = matcher.agree(node.reference(rules.reference), kept)
    if agreement.matches > rules.min_matches and agreement.spread >= rules.min_spread:
        node.frames.append(i)
        node.skipped = 0
        if i - node.updated >= rules.min_frames:
            node.views.append((i, described, kept))
    return node


def _verdict(seen: Seen, blurred: bool, views_in: Counter[int], good: set[int]) -> FrameVerdict:
    matches, spread = seen.agreement or (None, None)
    found = FrameVerdict(
        seen.name,
        seen.node in good and not blurred,
        "",
        seen.node,
        seen.view,
        seen.similarity,
        matches,
        spread,
        seen.features,
    )
    if found.kept:
        return found
    if seen.double:
        return replace(found, reason=DOUBLE)
    if seen.node is None:
        return replace(found, reason=UNREADABLE)
    if blurred:
        return replace(found, reason=BLUR)
    return replace(found, reason=NO_MATCHES if views_in[seen.node] == 1 else FEW_VIEWS)


@dataclass(frozen=True)
@checked
class MapRules:
    """Which frames are kept where a sparse map tells it."""

    points: Annotated[int, at_least(1)] = 15
    """Number of map points that two keyframes must both see to count as covisible (seeing the same wall). More keep
    fewer frames."""
    keyframes: Annotated[int, at_least(1)] = 2
    """Least number of other keyframes that a keyframe must be covisible with (see the same wall as) to be kept. More
    keep fewer frames."""
    between: Annotated[int, at_least(1)] = 40
    """Largest difference of the numbers (in file names) of two kept keyframes that follow each other and are covisible,
    for the frames between them to be kept as well; 1 keeps keyframes only. More keep more frames."""
    published: bool = True
    """true: where camerasModel.txt (EndoMapper) lies beside the map, it says which keyframes are covisible, and
    --map-rules.points has no effect. false: the points always say it."""


def select_by_map(
    names: Sequence[str],
    sparse_map: SparseMap,
    rules: MapRules,
    published: Mapping[int, Mapping[int, set[int]]] | None = None,
) -> list[FrameVerdict]:
    """A verdict for every frame, in order. `published` holds, for submaps by id, the covisible frame numbers of each.

    A keyframe of several submaps is kept when one of them keeps it. Raises InputError when the map has none of the
    frames.
    """
    numbers = [frame_number(name) for name in names]
    found: dict[int, FrameVerdict] = {}
    for submap in sparse_map.submaps:
        given = (published or {}).get(submap.id) if rules.published else None
        keyframes = [k.number for k in submap.keyframes]
        covisible = _counted(submap, rules.points) if given is None else _listed(keyframes, given)
        others = covisible.sum(1)
        kept = {n for n, count in zip(keyframes, others, strict=True) if count >= rules.keyframes}
        for n, count in zip(keyframes, others, strict=True):
            reason = "" if n in kept else FEW_KEYFRAMES
            _best(found, n, FrameVerdict("", n in kept, reason, submap.id, True, None, int(count)))
        order = np.argsort(keyframes)
        for a, b in pairwise(order):
            first, last = keyframes[a], keyframes[b]
            if {first, last} <= kept and covisible[a, b] and last - first <= rules.between:
                for n in range(first + 1, last):
                    _best(found, n, FrameVerdict("", True, "", submap.id))
    if not found.keys() & set(numbers):
        raise InputError(
            sparse_map.source,
            f"its keyframes ({min(found)} to {max(found)}) are none of the {len(names)} frames ({min(numbers)} to "
            f"{max(numbers)})",
            "frames and keyframes meet by the number in their names",
        )
    missing = FrameVerdict("", False, NOT_IN_MAP)
    return [replace(found.get(n, missing), name=name) for n, name in zip(numbers, names, strict=True)]


def _best(found: dict[int, FrameVerdict], number: int, verdict: FrameVerdict) -> None:
    before = found.get(number)
    if before is None or (verdict.kept, verdict.matches or 0) > (before.kept, before.matches or 0):
        found[number] = verdict


def _counted(submap: Submap, points: int) -> np.ndarray:
    shared = covisibility(submap) >= points
    np.fill_diagonal(shared, False)
    return shared


def _listed(keyframes: list[int], given: Mapping[int, set[int]]) -> np.ndarray:
    pairs = np.array([[b in given.get(a, ()) or a in given.get(b, ()) for b in keyframes] for a in keyframes])
    np.fill_diagonal(pairs, False)
    return pairs


def published_pairs(folder: Path, sparse_map: SparseMap) -> dict[int, dict[int, set[int]]]:
    """The pairs of camerasModel.txt, where it is beside a model: for submaps by id, the frames covisible with each.

    A line is `NAME covisible covisible ...`, image names, itself among them. Raises InputError when one has no number.
    """
    pairs = {}
    for submap in sparse_map.submaps:
        places = [folder / str(submap.id), folder / "sparse" / str(submap.id)]
        places += [folder, folder / "sparse"] if len(sparse_map.submaps) == 1 else []
        files = [place / "camerasModel.txt" for place in places if (place / "camerasModel.txt").is_file()]
        if not files:
            continue
        try:
            lines = [line.split() for line in files[0].read_text(encoding="utf-8-sig").splitlines() if line.strip()]
        except (OSError, UnicodeDecodeError) as error:
            raise InputError(
                files[0], f"cannot be read ({error})", "expected lines NAME COVISIBLE COVISIBLE ..."
            ) from error
        try:
            pairs[submap.id] = {frame_number(first): {frame_number(n) for n in rest} for first, *rest in lines}
        except InputError as error:
            raise InputError(
                files[0], f"{error.where}: {error.found}", "expected lines NAME COVISIBLE COVISIBLE ..."
            ) from error
    return pairs
