"""The mapping of matched images: COLMAP's incremental mapper, its global one (GLOMAP), or one after the other.

The incremental mapper adds image by image and gives up where no next one fits. The global one solves for all rotations,
then for all places at once, and may place what was left. With one thread and a seed both give equal models every time.
Features are SIFT: the wheel of pycolmap 4.2 also names ALIKED and LightGlue, and aborts the process when they are asked
for.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lightdepth.native import pycolmap
from lightdepth.sfm.config import Progress, SfmConfig
from lightdepth.sfm.features import quiet

# Points in an image, in the median of a model. Of synthetic videos whose frames hardly overlap, second tries with 14 to
# 30 had the centres wrong by 8 to 34 % of the reach of the path; the incremental mapper's own models have 50 and more.
_HELD = 40


def mapped(work: Path, names: Sequence[str], config: SfmConfig, progress: Progress) -> int:
    """Maps the images of work/database.db; writes the models as text to work/models/<i>, the largest first, returns how
    many."""
    pc = pycolmap()
    models: list[Any] = []
    with quiet(pc):
        if config.mapper != "global":
            models += _large(_incremental(pc, work, len(names), config, progress), config)
        left = sorted(set(names) - {name for model in models for name in _names(model)})
        if config.mapper != "incremental" and len(left) >= config.min_model_size:
            found = _large(_global(pc, work, left if models else [], config), config)
            models += found if config.mapper == "global" else [m for m in found if _held(m)]
        for index, model in enumerate(sorted(models, key=lambda m: -m.num_reg_images())):
            write_model(model, work, index)
    progress("mapping", len(names), len(names))
    return len(models)


def _incremental(pc: Any, work: Path, count: int, config: SfmConfig, progress: Progress) -> list[Any]:
    registered = 0

    def one_more() -> None:
        nonlocal registered
        registered = min(registered + 1, count)
        progress("mapping", registered, count)

    (work / "colmap").mkdir()
    options = mapping_options(pc, config)
    found = pc.incremental_mapping(
        work / "database.db", work / "images", work / "colmap", options, next_image_callback=one_more
    )
    return list(found.values())


def _global(pc: Any, work: Path, names: Sequence[str], config: SfmConfig) -> list[Any]:
    """Models of the images of these names; of all where there are none."""
    (work / "global").mkdir()
    options = global_options(pc, config)
    options.image_names = list(names)
    return list(pc.global_mapping(work / "database.db", work / "images", work / "global", options).values())


def _large(models: Sequence[Any], config: SfmConfig) -> list[Any]:
    enough = [m for m in models if m.num_reg_images() >= config.min_model_size]
    return [m for m in enough if m.num_points3D() >= config.min_points]


def _held(model: Any) -> bool:
    """Whether the points of a second try hold its images."""
    seen = [model.image(i).num_points3D for i in model.reg_image_ids()]
    return float(np.median(seen)) >= _HELD


def _names(model: Any) -> list[str]:
    return [model.image(i).name for i in model.reg_image_ids()]


def write_model(model: Any, work: Path, index: int) -> None:
    """A model as text in work/models/<index>."""
    folder = work / "models" / str(index)
    folder.mkdir()
    model.write_text(folder)


def mapping_options(pc: Any, config: SfmConfig) -> Any:
    """The settings of the incremental mapper, also of what triangulates at its poses."""
    options = pc.IncrementalPipelineOptions()
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = config.seed
    options.num_threads = options.mapper.num_threads = config.num_threads
    options.multiple_models, options.min_model_size = True, config.min_model_size
    # The calibration is given: refining it on a short endoscopic sequence would trade it against the shape.
    options.ba_refine_focal_length = options.ba_refine_principal_point = options.ba_refine_extra_params = False
    options.mapper.abs_pose_refine_focal_length = options.mapper.abs_pose_refine_extra_params = False
    options.mapper.init_min_tri_angle = config.init_min_tri_angle
    options.mapper.init_min_num_inliers = config.init_min_num_inliers
    options.mapper.init_max_forward_motion = 1.0  # an endoscope moves forward: COLMAP would refuse such first pairs
    return options


def global_options(pc: Any, config: SfmConfig) -> Any:
    """The settings of the global mapper, with the calibration held as it was given."""
    options = pc.GlobalPipelineOptions()
    mapper, adjustment = options.mapper, options.mapper.bundle_adjustment
    options.random_seed = mapper.random_seed = mapper.retriangulation.random_seed = config.seed
    mapper.rotation_averaging.random_seed = mapper.global_positioning.random_seed = config.seed
    options.num_threads = mapper.num_threads = adjustment.ceres.solver_options.num_threads = config.num_threads
    options.multiple_models, options.min_model_size = True, config.min_model_size
    adjustment.refine_focal_length = adjustment.refine_principal_point = adjustment.refine_extra_params = False
    mapper.global_positioning.use_gpu = adjustment.ceres.use_gpu = False
    return options
