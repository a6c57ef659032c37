"""The stages, each described once: what is done, in which step of densify, its load, what it is measured against."""

from __future__ import annotations

import base64
import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
import torch

from densify.agreement import agree
from densify.evaluation.errors import compare_depth, surface_errors, true_depth
from densify.fusion.rectify import surface_view
from densify.judging.columns import hidden_ratios
from densify.live.packed import PackedView, Packing
from densify.speed import loads, references
from densify.speed.given import Given
from densify.speed.machine import Kind, Load
from lightdepth.decline import BLUR, log_closed_form
from lightdepth.files.images import to_bgr8
from lightdepth.geometry import depth_from_distance
from lightdepth.models import NetworkModel
from lightdepth.observations import observed_distances
from lightdepth.parallax import HYPOTHESES, measured, textured
from lightdepth.robust import lmeds_scale

Work = Callable[[Given], object]


@dataclass(frozen=True)
class Stage:
    """A piece of work of one frame, keyframe, submap or round."""

    name: str
    what: str
    """what is done, and on how much; in words"""
    run: Work
    load: Callable[[Given], Load]
    reference: str
    """what it is measured against; in words"""
    plain: Work
    """the reference"""
    step: str = ""
    """of densify, by its clock (densify.pipeline); empty where densify does no such thing"""
    network: bool = False
    """whether there is such a stage for networks alone"""
    with_model: bool = False
    """whether it runs where the model does; the others stay on the processor"""


def _in_bfloat16(work: Work) -> Work:
    def run(given: Given) -> object:
        with torch.autocast(given.device.type, torch.bfloat16):
            return work(given)

    return run


def _predict(given: Given) -> object:
    return given.model(given.frame)


@torch.inference_mode()
def _plain_forward(given: Given) -> object:
    assert isinstance(given.model, NetworkModel)
    return given.model.network.estimate(given.batch.image, given.batch.mask, given.batch.rays, given.batch.light)


def _network_load(kind: Kind) -> Callable[[Given], Load]:
    def load(given: Given) -> Load:
        assert isinstance(given.model, NetworkModel)
        return loads.network(given.model.network, given.batch, given.pixels, kind)

    return load


def _kernel(given: Given) -> int:
    """Width of the closed form's blur, pixels."""
    return 2 * int(3 * BLUR * given.closed_batch.image.shape[-2] + 0.5) + 1


def _closed_pixels(given: Given) -> int:
    return given.closed_batch.image[0, 0].numel()


@torch.inference_mode()
def _closed_form(given: Given) -> object:
    batch = given.closed_batch
    return log_closed_form(batch.image, batch.mask, batch.rays, batch.light)


def _two_blurs(given: Given) -> None:
    image, size = given.closed_batch.image[0, 0].cpu().numpy(), _kernel(given)
    for _ in range(2):
        cv2.GaussianBlur(image, (size, size), BLUR * image.shape[0])


@cache
def _distances(points: int) -> tuple[np.ndarray, np.ndarray]:
    """Mapped and predicted distances, 30 % of them wrong, 3 % noise."""
    rng = np.random.default_rng(points)
    predicted = rng.uniform(15, 100, points)
    mapped = 2.5 * predicted * np.exp(0.03 * rng.normal(size=points))
    wrong = rng.permutation(points)[: 3 * points // 10]
    mapped[wrong] = 2.5 * rng.uniform(5, 300, len(wrong))
    return mapped, predicted


def _lmeds(points: int) -> Stage:
    return Stage(
        f"LMedS, n = {points}",
        "the scale with the least median of squares",
        lambda given: lmeds_scale(*_distances(points)),
        lambda given: loads.lmeds(points),
        "every proposal, np.partition",
        lambda given: references.lmeds_by_partition(*_distances(points)),
        "align",
    )


def _point_counts(given: Given) -> list[int]:
    return [len(each.view.observed) for each in given.alone if each.view is not None]


def _agree(given: Given) -> object:
    views = [each.view for each in given.alone if each.view is not None]
    config = replace(given.config.agreement, rounds=1)
    return agree(views, given.shared, config, given.config.bending)


def _agreement_equations(given: Given) -> None:
    parts = [(n, given.unknowns) for n in _point_counts(given)]
    parts += [(n, 2 * given.unknowns) for n in given.overlaps]
    references.normal_equations(tuple(parts), len(given.alone) * given.unknowns)


def _hidden_equations(given: Given) -> None:
    folds = given.config.judge.folds
    rows = len(given.observed) * (folds - 1) // folds
    references.normal_equations(((rows, given.unknowns),), given.unknowns, 2 * folds)


def _patches(given: Given) -> int:
    return len(textured(given.looks[0], given.config.judge.parallax))


def _parallax_load(given: Given) -> Load:
    look, others = given.looks[0], len(given.looks) - 1
    side = given.config.judge.parallax.patch
    return loads.parallax(_patches(given), len(HYPOTHESES), others, side, look.brightness.size)


def _as_many_values(given: Given) -> None:
    look, *others = given.looks
    count = _patches(given) * len(HYPOTHESES) * given.config.judge.parallax.patch**2
    for _ in others:
        references.remapped(look.brightness, count)


def _exponentials(given: Given) -> None:
    config, shape = given.config.bending, given.prediction.distance.shape
    references.exponentials((shape[0], shape[1]), config.layers + 1)


def _packed(given: Given) -> PackedView:
    packing = Packing(given.frame.image)
    packing.round(given.prediction)
    return packing.done()


def _plain_packing(given: Given) -> object:
    half = given.prediction.distance.astype(np.float16)
    _, jpeg = cv2.imencode(".jpg", to_bgr8(given.frame.image), [cv2.IMWRITE_JPEG_QUALITY, 95])
    return jpeg, zlib.compress(half.tobytes(), level=1)


def _plain_integration(given: Given) -> None:
    given.plain_volume.integrate(*given.plain_depth, given.keyframe.cam_from_map)


def _marching_load(given: Given) -> Load:
    mesh = given.volume.extract_mesh()
    return loads.marching_cubes(given.blocks, len(mesh.vertices), len(mesh.triangles))


def _three_errors(given: Given) -> object:
    ray_z = given.frame.camera.rays()[0][..., 2]
    truth, known = true_depth(given.frame, 100.0)
    return references.three_errors(depth_from_distance(given.prediction.distance, ray_z), truth, known)


def _nearest(given: Given) -> None:
    references.nearest(given.vertices_mm, given.wall.tree, given.wall.cloud)


def _write_page(given: Given) -> None:
    with TemporaryDirectory() as folder:
        given.page(Path(folder) / "report.html")


def _write_bytes(given: Given) -> None:
    """Of a page, encoded as those of pictures are, which are most of it, and written."""
    content = given.page_bytes
    with TemporaryDirectory() as folder:
        (Path(folder) / "report.html").write_bytes(base64.b64encode(content[: 3 * len(content) // 4]))


STAGES = (
    Stage(
        "decode",
        "a frame's PNG becomes an image of float32",
        lambda given: given.frames.of_keyframe(given.keyframe),
        lambda given: loads.decode(given.pixels, given.file.stat().st_size),
        "cv2.imread",
        lambda given: cv2.imread(str(given.file)),
        "read",
    ),
    Stage(
        "network, float32",
        "distance and its uncertainty at every pixel",
        _predict,
        _network_load("float32"),
        "the network's forward alone",
        _plain_forward,
        "predict",
        network=True,
        with_model=True,
    ),
    Stage(
        "network, bfloat16",
        "the same under autocast, which densify does not use",
        _in_bfloat16(_predict),
        _network_load("bfloat16"),
        "the network's forward alone",
        _in_bfloat16(_plain_forward),
        network=True,
        with_model=True,
    ),
    Stage(
        "closed form",
        "log distance by the decline of the light",
        _closed_form,
        lambda given: loads.closed_form(_closed_pixels(given), _kernel(given)),
        "two cv2.GaussianBlur",
        _two_blurs,
        with_model=True,
    ),
    Stage(
        "sampling",
        "predicted distance where a keyframe's points are seen",
        lambda given: observed_distances(given.keyframe, given.submap, given.prediction),
        lambda given: loads.sampling(len(given.observed)),
        "as many values by cv2.remap",
        lambda given: references.remapped(given.prediction.distance, len(given.observed)),
        "align",
    ),
    _lmeds(1000),
    _lmeds(3000),
    Stage(
        "agreement, a round",
        "one step of all keyframes' bends together, on points and overlaps",
        _agree,
        lambda given: loads.agreement(_point_counts(given), given.overlaps, given.unknowns),
        "the same products and solution by BLAS and LAPACK",
        _agreement_equations,
        "agree",
    ),
    Stage(
        "bending",
        "a keyframe's bend applied to its depth",
        lambda given: given.bend.applied(given.prediction),
        lambda given: loads.bending(given.pixels, given.config.bending),
        "as many np.exp",
        _exponentials,
        "integrate",
    ),
    Stage(
        "judge, hidden points, a round",
        "one step of a keyframe's alignments without each fold of its points",
        lambda given: hidden_ratios(given.aligned_view, given.fold, given.method),
        lambda given: loads.hidden(len(given.observed), given.config.judge.folds, given.unknowns),
        "the same products and solutions by BLAS and LAPACK",
        _hidden_equations,
        "judge",
    ),
    Stage(
        "judge, parallax",
        "distances of a keyframe's patches by its neighbours' images",
        lambda given: measured(
            given.looks[0], given.looks[1:], given.guess, given.small_prediction, given.config.judge.parallax
        ),
        _parallax_load,
        "as many values by cv2.remap",
        _as_many_values,
        "judge",
    ),
    Stage(
        "packing",
        "image and prediction as live keeps them",
        _packed,
        lambda given: loads.packing(given.pixels, _packed(given).size),
        "cv2.imencode, and zlib of float16",
        _plain_packing,
    ),
    Stage(
        "rectification",
        "a plane and a weight for every pixel",
        lambda given: surface_view(given.applied, given.frame.image, given.config.rectify, given.far),
        lambda given: loads.rectification(given.pixels, len(given.view.weights)),
        "normals by np.gradient and np.cross",
        lambda given: references.plane_by_gradients(given.applied.distance, given.frame.camera.rays()[0]),
        "integrate",
    ),
    Stage(
        "integration",
        "a view into the volume",
        lambda given: given.volume.integrate(given.view, given.keyframe.cam_from_map),
        lambda given: loads.integration(given.voxels, len(given.view.weights)),
        "Open3D's VoxelBlockGrid, the same voxels",
        _plain_integration,
        "integrate",
    ),
    Stage(
        "marching cubes",
        "the surface of one keyframe's volume",
        lambda given: given.volume.extract_mesh(),
        _marching_load,
        "Open3D's VoxelBlockGrid, the same voxels",
        lambda given: given.plain_volume.extract_mesh(),
        "extract",
    ),
    Stage(
        "evaluation, depth",
        "errors of a keyframe's depth against the truth",
        lambda given: compare_depth(given.prediction, given.frame).errors(["median"]),
        lambda given: loads.depth_errors(given.pixels),
        "three errors in plain NumPy",
        _three_errors,
    ),
    Stage(
        "evaluation, surface",
        "the map's surface against a quarter of the true points",
        lambda given: surface_errors(given.vertices_mm, given.wall),
        lambda given: loads.surface_errors(len(given.vertices_mm), len(given.wall.cloud)),
        "SciPy's cKDTree, one thread",
        _nearest,
    ),
    Stage(
        "report",
        "the page of the map",
        _write_page,
        lambda given: loads.report(len(given.page_bytes)),
        "as many bytes encoded and written",
        _write_bytes,
    ),
)
"""In the order of the way from a file to a page."""
