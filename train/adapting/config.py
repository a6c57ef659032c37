"""How a checkpoint is adapted."""

from __future__ import annotations

from dataclasses import dataclass

from lightdepth.errors import InputError

from .module import What


@dataclass(frozen=True)
class AdaptConfig:
    """What of the network learns, from what, and for how long."""

    steps: int = 300
    """number of training steps; more of them learn more, and forget more of what the checkpoint knew"""
    learning_rate: float = 5e-4
    """the highest learning rate of its one cycle; a higher one learns faster, and goes astray sooner"""
    batch_size: int = 4
    """number of frames in a step"""
    size: tuple[int, int] | None = None
    """width and height that it learns at, pixels; left out, the rows of the checkpoint"""
    what: What = "all"
    """part of the network that learns: all, decoder, norms (scale and shift of the normalisations) or low_rank"""
    rank: int = 4
    """rank of what low_rank adds to every convolution; a higher one can learn more"""
    anchor: float = 0.0
    """weight that holds the shape of each distance map to what the checkpoint said before; 0 lets it go"""
    replay: int = 0
    """number of synthetic colons of the kind that the checkpoint learned from, which fill half of each batch"""
    points: float = 0.0
    """weight of the map's points as teachers; those that a held-out frame saw only judge"""
    overlap: float = 0.0
    """weight of where two keyframes of the map see the same tissue; 0 leaves it out"""
    held_out: float = 0.2
    """share of each sequence, at its end, that judges and is never trained on"""
    seed: int = 0
    """number that draws order, augmentation, replayed colons and low-rank additions"""

    def __post_init__(self) -> None:
        if min(self.steps, self.batch_size) < 1 or not self.learning_rate > 0 or self.replay < 0:
            raise InputError(
                f"--steps {self.steps}, --batch-size {self.batch_size}, --learning-rate {self.learning_rate}, "
                f"--replay {self.replay}; expected positive numbers, and 0 or more colons"
            )
        if not (self.points >= 0 and self.overlap >= 0):
            raise InputError(f"--points {self.points}, --overlap {self.overlap}; expected weights of 0 or more")
        if not 0 < self.held_out < 1:
            raise InputError(f"--held-out {self.held_out}; expected a share above 0 and below 1")

    @property
    def taught(self) -> bool:
        """Whether a map teaches."""
        return self.points + self.overlap > 0
