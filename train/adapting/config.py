"""How a checkpoint is adapted."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from lightdepth.ranges import BETWEEN, SEED, above, at_least, checked

from .module import What

HOLD = 20.0
"""Weight of the anchor where the loss is the only teacher: a map sees what it does at its points alone."""
POINTS = 100.0
"""Weight of a map's points where none is given: the light's loss, whose weights are about 1, has little say then."""


@dataclass(frozen=True)
@checked
class AdaptConfig:
    """Which part of the network learns, from what, and for how long."""

    steps: Annotated[int, at_least(1)] = 300
    """Number of training steps. More move the network further from the checkpoint, for better or worse, and take
    longer."""
    learning_rate: Annotated[float, above(0, up_to=1)] = 5e-4
    """Highest learning rate, above 0, which training climbs to and then falls from. A larger one changes the weights
    more in every step: the network learns faster, and less steadily."""
    batch_size: Annotated[int, at_least(1, up_to=100_000)] = 4
    """Number of frames in a batch, from which each step learns. More make steadier steps and take more time and
    memory."""
    size: Annotated[tuple[int, int] | None, at_least(16, up_to=10_000)] = None
    """Width and height that images are resized to for training, pixels; left out, the height that the checkpoint was
    trained at, and the width that goes with it. A larger one shows finer detail and takes longer."""
    what: What = "all"
    """Which weights learn: all (except those of the uncertainty head); decoder, those after the encoder (the part that
    reads the image); norms, only scale and shift of the normalisations; low_rank, a small addition to each layer (see
    --rank). The fewer learn, the less can change."""
    rank: Annotated[int, at_least(1, up_to=10_000)] = 4
    """Number of ranks (independent directions) of what --what low_rank adds to each layer; without that it has no
    effect. More let the network change further."""
    anchor: Annotated[float | None, at_least(0)] = None
    """Weight of the term that keeps the shape of each distance map as the checkpoint gave it before; 0 leaves it out.
    Left out, half of --points where a map teaches and something judges; else 0 where true distance judges, and 20 where
    it does not. A larger one holds it more firmly."""
    replay: Annotated[int, at_least(0, up_to=1_000_000)] = 0
    """Number of synthetic colons of the kind that the checkpoint was trained on, whose frames fill half of each batch,
    so that what it knew is not lost; 0 for none. More show more variety and take longer to render."""
    points: Annotated[float | None, at_least(0)] = None
    """Weight of the map's points as teachers of distance (up to one factor per image); left out, 100 where there is a
    map; at 0 they teach nothing. Points that a held-out frame saw, and a fifth of the others in whole blocks of wall,
    only judge. A larger one follows the points more closely."""
    overlap: Annotated[float, at_least(0)] = 0.0
    """Weight of the term that makes the distances of two of the map's keyframes agree where both see the same wall; 0
    leaves it out. A larger one makes them agree better. Above 0 it needs a map, given or made."""
    judge: Literal["auto", "none"] = "auto"
    """What tells whether the adapted network is better: auto takes true distance where the frames have it, else the map
    of --map, else one that is made from the frames. none does the same but makes no map, so that without truth and
    --map nothing judges."""
    held_out: Annotated[float, BETWEEN] = 0.2
    """Share of each sequence, above 0 and below 1, at its end, that judges and is never trained on. A larger one judges
    more surely and trains on less."""
    seed: Annotated[int, SEED] = 0
    """Number that seeds all randomness: order of frames, augmentation, replayed colons, blocks of wall that judge,
    first weights of low_rank. Another one makes another run, better or worse by chance alone."""

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
