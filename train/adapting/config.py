"""How a checkpoint is adapted."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from lightdepth.errors import InputError

from .module import What

HOLD = 20.0
"""Weight of the anchor where the loss is the only teacher: a map sees what it does at its points alone."""
POINTS = 100.0
"""Weight of a map's points where none is given: the light's loss, whose weights are about 1, has little say then."""


@dataclass(frozen=True)
class AdaptConfig:
    """What of the network learns, from what, and for how long."""

    steps: int = 300
    """Number of training steps. More adapt further and take longer."""
    learning_rate: float = 5e-4
    """Rate of learning at the top of its one cycle, a number above 0. A higher one learns faster, and less
    steadily."""
    batch_size: int = 4
    """Number of frames in a step. More make steadier steps and take more time and memory."""
    size: tuple[int, int] | None = None
    """Width and height that the network learns at, pixels; left out, the rows of the checkpoint. A larger one shows
    finer detail and takes longer."""
    what: What = "all"
    """Which part of the network learns: all, decoder, norms (scale and shift of the normalisations) or low_rank."""
    rank: int = 4
    """Number of ranks of what low_rank adds to every convolution. More let it change further."""
    anchor: float | None = None
    """Weight that holds the shape of each distance map to what the checkpoint said before; left out, half of that of
    the map's points; where none teach, 0 under true distance and else 20. A larger one holds it more firmly."""
    replay: int = 0
    """Number of synthetic colons of the kind that the checkpoint learned from, which fill half of each batch; 0 for
    none. More show more variety and take longer to render."""
    points: float | None = None
    """Weight of the map's points as teachers; left out, 100 where there is a map. Those that a held-out frame saw, and
    a fifth of the others in whole blocks of wall, only judge. A larger one follows the points more closely."""
    overlap: float = 0.0
    """Weight of the places where two keyframes of the map see the same tissue. A larger one makes their depths agree
    better."""
    judge: Literal["auto", "none"] = "auto"
    """What judges besides the loss: auto, true distance or a map, and where there is neither a map is made of the
    frames; none makes no map, so that without truth and --map nothing judges."""
    held_out: float = 0.2
    """Share of each sequence, at its end, that judges and is never trained on. A larger one judges more surely and
    trains on less."""
    seed: int = 0
    """Number that draws order, augmentation, replayed colons and low-rank additions. Another one makes another
    run."""

    def __post_init__(self) -> None:
        if min(self.steps, self.batch_size) < 1 or not self.learning_rate > 0 or self.replay < 0:
            raise InputError(
                "--steps",
                f"{self.steps}, --batch-size {self.batch_size}, --learning-rate {self.learning_rate}, --replay "
                f"{self.replay}",
                "expected positive numbers, and 0 or more colons",
            )
        if not ((self.points is None or self.points >= 0) and self.overlap >= 0):
            raise InputError("--points", f"{self.points}, --overlap {self.overlap}", "expected weights of 0 or more")
        if not 0 < self.held_out < 1:
            raise InputError("--held-out", f"{self.held_out}", "expected a share above 0 and below 1")

    def taught_by(self, has_map: bool) -> float:
        """The weight of a map's points, by whether there is a map."""
        return (POINTS if self.points is None else self.points) if has_map else 0.0

    def held_on(self, points: float, by_truth: bool) -> float:
        """The weight of the anchor, by the weight of the points that teach and by whether truth judges."""
        if self.anchor is not None:
            return self.anchor
        if points:
            return points / 2
        return 0.0 if by_truth else HOLD

    @property
    def taught(self) -> bool:
        """Whether a map is asked to teach, so that one is needed."""
        return (self.points or 0.0) + self.overlap > 0
