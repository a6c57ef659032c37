"""densify: depth and a sparse map in, dense maps out.

The public names are those of `__all__`; docs/api.md shows each at work.
"""

from typing import TYPE_CHECKING

from lightdepth import __version__ as __version__
from lightdepth.lazy import public

if TYPE_CHECKING:
    from densify.alignment import Alignment as Alignment
    from densify.config import DensifyConfig as DensifyConfig
    from densify.config import LiveConfig as LiveConfig
    from densify.dense_map import DenseMap as DenseMap
    from densify.dense_map import read_dense_map as read_dense_map
    from densify.evaluation.errors import compare_depth as compare_depth
    from densify.evaluation.errors import surface_errors as surface_errors
    from densify.evaluation.trajectory import align_trajectory as align_trajectory
    from densify.fusion.volume import TsdfVolume as TsdfVolume
    from densify.judging.config import JudgeConfig as JudgeConfig
    from densify.live.densifier import Densifier as Densifier
    from densify.pipeline import densify as densify
    from densify.similarity import Similarity as Similarity
    from densify.similarity import fit_similarity as fit_similarity


_HOMES = {
    "Alignment": "densify.alignment",
    "DenseMap": "densify.dense_map",
    "Densifier": "densify.live.densifier",
    "DensifyConfig": "densify.config",
    "JudgeConfig": "densify.judging.config",
    "LiveConfig": "densify.config",
    "Similarity": "densify.similarity",
    "TsdfVolume": "densify.fusion.volume",
    "align_trajectory": "densify.evaluation.trajectory",
    "compare_depth": "densify.evaluation.errors",
    "densify": "densify.pipeline",
    "fit_similarity": "densify.similarity",
    "read_dense_map": "densify.dense_map",
    "surface_errors": "densify.evaluation.errors",
}
__all__ = list(_HOMES)
__getattr__, __dir__ = public(__name__, _HOMES)
