"""What a verb does with the verdict: refuse, warn, note."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

from lightdepth.camera import CameraModel
from lightdepth.datasets.sequence import FrameSequence
from lightdepth.detective.investigate import investigate
from lightdepth.detective.verdict import Verdict
from lightdepth.errors import InputError
from lightdepth.maps.convention import MapReading
from lightdepth.reporting.run import Run
from lightdepth.sparse_map import SparseMap


@dataclass(frozen=True)
class PairingConfig(MapReading):
    """How frames are matched with a map's keyframes, and what is required of them."""

    trust_map: bool = False
    """true: where the images say that the map was made from other frames than these, a warning is given and the run
    goes on. false: the run stops with an error."""


def check_pairing(
    sparse_map: SparseMap,
    frames: FrameSequence,
    config: PairingConfig = PairingConfig(),
    run: Run | None = None,
    given: CameraModel | None = None,
) -> Verdict:
    """Raises InputError where keyframes and frames do not belong together as they are read, naming the reading that
    fits better where there is one; warns where that is doubtful. The verdict goes into the run's record as
    `pairing`."""
    verdict = investigate(sparse_map, frames, given)
    if run is not None:
        run.record["pairing"] = verdict.record()
        run.log(f"pairing of frames and map: {verdict.judgement}: {verdict.sentence}")
    if verdict.judgement == "wrong" and not config.trust_map:
        raise InputError(sparse_map.source, verdict.sentence, verdict.cure)
    if verdict.judgement in ("wrong", "doubtful"):
        warnings.warn(f"{sparse_map.source}: {verdict.sentence}; {verdict.cure}", stacklevel=2)
    return verdict
