"""Bytes and operations of each stage, by what goes in and what comes out. docs/speed.md has them as a table.

They are what has to be done by the way that is taken (a sort, a product of matrices, a look at each voxel), not what
the program happens to do besides: arrays that are made in between, calls, and what is read twice are its own affair,
and that is what the ratio to the floor shows. Counts are of one frame, keyframe, submap or round, as the stage says.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch.utils.flop_counter import FlopCounterMode

from densify.bending import BendingConfig
from densify.speed.machine import Kind, Load, comparisons
from lightdepth.frame import FrameBatch
from lightdepth.network import DepthNetwork

IMAGE, DISTANCE, MASK = 12, 4, 1
"""Bytes of a pixel: three float32, one float32, one bool."""
_PER_PIXEL = 14  # of the closed form beside its blur: largest channel, log, the light's spread, the sum of logarithms
_PER_POINT = 63
"""Of a sampled point: 18 to turn and move it, 6 to project it and 6 for its distance through a pinhole, 32 for the
bilinear mean of four logarithms, and one exponential."""
LOOK_UP, PLANE = 28, 27
"""Of a voxel: the cell of its direction (densify.fusion.rectify._look_up), and what its pixel's plane says of it
(densify.fusion.volume._add_view)."""
_VOXEL = 10
"""Bytes of a voxel's sums, but for colour: weight, distance, views."""
_COLOUR = 16
_PIXEL_OF_A_VIEW = 16 + 1 + 4
"""Bytes of what a view says of a pixel: plane, weight, colour."""
_NORMAL = 60
"""Operations of a pixel's plane: eight differences, their sums, the product of two vectors, its length, three
products."""
VERTEX, TRIANGLE = 52, 24
"""Bytes of a mesh: place, colour, weight and number of views; three whole numbers."""
_PATCH = 15
"""Operations of a pixel of a patch at one hypothesis: 8 to interpolate, 2 for the mean, 5 for sums of products."""


def decode(pixels: int, file: int) -> Load:
    """A file of so many bytes becomes an image of float32. Inflating a file is no arithmetic, so nothing is counted."""
    return Load(bytes=file + IMAGE * pixels)


def network(network: DepthNetwork, batch: FrameBatch, pixels: int, kind: Kind) -> Load:
    """One prediction: products and convolutions as PyTorch counts them; the weights once, the image of so many pixels
    once, and what comes out at its size. What lies between layers could stay in the cache."""
    with torch.inference_mode(), FlopCounterMode(display=False) as counter:
        estimate = network.estimate(batch.image, batch.mask, batch.rays, batch.light)
    outputs = 1 + (estimate.log_sigma is not None)
    of_weight = 2 if kind == "bfloat16" else 4
    weights = of_weight * sum(p.numel() for p in network.parameters())
    moved = weights + pixels * (IMAGE + MASK + DISTANCE * outputs)
    return Load({kind: float(counter.get_total_flops())}, float(moved))


def blur(pixels: int, kernel: int) -> float:
    """Operations of a Gaussian blur, along rows and then along columns, of values and their weights."""
    return 2 * 2 * 2.0 * kernel * pixels


def closed_form(pixels: int, kernel: int) -> Load:
    """Image, mask and rays in, log distance out."""
    return Load({"float32": blur(pixels, kernel) + _PER_PIXEL * pixels}, pixels * (2 * IMAGE + MASK + DISTANCE))


def sampling(points: int) -> Load:
    """Points with their ids in; four pixels of distance and validity each; id, two distances, pixel and ray out."""
    read, looked_at, written = 8 * 4, 4 * (DISTANCE + MASK), 8 * 8
    return Load({"float64": _PER_POINT * points}, points * (read + looked_at + written))


def lmeds(points: int) -> Load:
    """One sort of two lists of distances of float64: less no exact search needs."""
    return Load({"comparison": comparisons(points)}, 16 * points)


def products(rows: int, unknowns: int) -> float:
    """Operations of J' W J and J' W r for so many rows; of the first, which is symmetrical, one half."""
    return float(rows * unknowns * (unknowns + 1) + 2 * rows * unknowns)


def solution(unknowns: int) -> float:
    """Operations of Cholesky's way through so many equations."""
    return unknowns**3 / 3 + 2 * unknowns**2


def agreement(points: Sequence[int], overlaps: Sequence[int], unknowns: int) -> Load:
    """One round over keyframes with so many points each and pairs that share so many pixels, each keyframe with so many
    unknowns: a pair's rows know the unknowns of two keyframes."""
    operations = sum(products(n, unknowns) for n in points) + sum(products(n, 2 * unknowns) for n in overlaps)
    moved = 8 * unknowns * (sum(points) + 2 * sum(overlaps))
    return Load({"float64": operations + solution(len(points) * unknowns)}, float(moved))


def hidden(points: int, folds: int, unknowns: int) -> Load:
    """One round of all alignments of a keyframe that its hidden points are judged by: of each fold, by the prediction
    and by a constant."""
    rows = points * (folds - 1) // folds
    each = products(rows, unknowns) + solution(unknowns)
    return Load({"float64": 2 * folds * each}, float(2 * folds * 8 * unknowns * rows))


def parallax(patches: int, hypotheses: int, others: int, side: int, pixels: int) -> Load:
    """Patches of side x side pixels at every hypothesis in every other image, all of so many pixels."""
    operations = patches * hypotheses * others * side**2 * _PATCH
    return Load({"float32": float(operations)}, float((others + 1) * DISTANCE * pixels))


def bending(pixels: int, config: BendingConfig) -> Load:
    """The field over an image, and its exponential times the distance: for each bump across a product and a sum, for
    each layer seven more, and nine for logarithm, slope and exponential."""
    across = sum(config.grids) + config.layers * config.columns
    operations = pixels * (2 * across + 7 * config.layers + 9)
    return Load({"float32": float(operations)}, float(pixels * (2 * DISTANCE + MASK)))


def packing(pixels: int, kept: int) -> Load:
    """Image, distance, uncertainty and validity in, so many bytes out; of two fields a logarithm, its step and its
    residual, eight operations."""
    return Load({"float32": float(2 * 8 * pixels)}, float(pixels * (IMAGE + 2 * DISTANCE + MASK) + kept))


def rectification(pixels: int, merged: int) -> Load:
    """Image, distance, uncertainty and validity in; of so many merged pixels a point and a plane each out."""
    moved = pixels * (IMAGE + 2 * DISTANCE + MASK) + merged * (IMAGE + _PIXEL_OF_A_VIEW)
    return Load({"float32": float(_NORMAL * merged)}, float(moved))


def integration(voxels: int, pixels: int) -> Load:
    """Voxels in the blocks that a view of so many pixels touches: sums are read and written, the view is read once.
    Colour, which those beside the surface take, is left out."""
    moved = 2 * _VOXEL * voxels + _PIXEL_OF_A_VIEW * pixels
    return Load({"float32": float((LOOK_UP + PLANE) * voxels)}, float(moved))


def marching_cubes(blocks: int, vertices: int, triangles: int) -> Load:
    """Bits of all voxels and their neighbours' places in; of each vertex two voxels in; the mesh out. Names of vertices
    are sorted, so that each is there once, and each is placed by ten operations."""
    read = blocks * (2 * 64 + 2 * 32) + vertices * 2 * (_VOXEL + _COLOUR)
    operations: dict[Kind, float] = {"comparison": comparisons(vertices), "float64": 10.0 * vertices}
    return Load(operations, float(read + VERTEX * vertices + TRIANGLE * triangles))


def depth_errors(pixels: int) -> Load:
    """Predicted and true distance with validity in; three errors, ten operations of a pixel."""
    return Load({"float32": 10.0 * pixels}, float(pixels * 2 * (DISTANCE + MASK)))


def surface_errors(vertices: int, true: int) -> Load:
    """The way from every vertex to the closest of the true points and back, in trees that halve their points with each
    comparison."""
    ways = vertices * np.log2(max(true, 2)) + true * np.log2(max(vertices, 2))
    return Load({"comparison": float(ways)}, float(24 * (vertices + true)))


def report(page: int) -> Load:
    """A page of so many bytes, written once."""
    return Load(bytes=float(page))
