"""Whether frames and a map belong together as they are read: the images vote, and the map's keypoints."""

from lightdepth.detective.asking import PairingConfig, check_pairing
from lightdepth.detective.investigate import investigate
from lightdepth.detective.verdict import Verdict

__all__ = ["PairingConfig", "Verdict", "check_pairing", "investigate"]
