"""The report of a densify run: frames with depth, points over images, scales, surfaces, errors, times."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from densify.aligned import AlignedKeyframe
from densify.dense_map import DenseMap
from densify.evaluation.records import ErrorMesh, MapFigures
from densify.joining import Merged, joined_name
from densify.judging.verdict import spoke
from densify.pipeline import SubmapResult
from densify.predictions import SeenKeyframe
from densify.scale_file import MmPerUnit, factor
from densify.scene import KINDS, SURFACE_FILES, TRUSTED, seen_kinds, surface_of, tangents
from densify.thumbnails import Thumbnails, said
from lightdepth.camera import CameraModel
from lightdepth.counting import full_stop
from lightdepth.reporting.figures import (
    BAD,
    GOOD,
    MeshView,
    chart,
    chart_png,
    colored_distance,
    jpeg,
    marked_points,
    thumbnail,
    webp,
)
from lightdepth.reporting.report import Report, Tile, number
from lightdepth.reporting.scene import Scene, Surface
from lightdepth.sparse_map import SparseMap, Submap

PICTURED = 12
"""The most maps that have pictures in a report, some half a megabyte each."""


class Gallery:
    """Pictures of a few keyframes of every submap, taken as they pass, and small ones of more keyframes."""

    def __init__(self, sparse_map: SparseMap, per_map: int = 3):
        self._chosen = {
            (s.id, s.keyframes[i].number)
            for s in sparse_map.submaps
            for i in np.linspace(0, len(s.keyframes) - 1, per_map + 2).astype(int)[1:-1]
        }
        self.pictures: dict[int, list[tuple[list[Tile], str]]] = {s.id: [] for s in sparse_map.submaps}
        self.thumbnails = Thumbnails(sparse_map)

    def __call__(self, submap: Submap, aligned: AlignedKeyframe, seen: SeenKeyframe) -> None:
        self.thumbnails(aligned, seen)
        if (submap.id, aligned.keyframe.number) not in self._chosen or seen.frame is None or seen.prediction is None:
            return
        assert aligned.observed is not None
        a = aligned.alignment
        good, bad = (np.isin(aligned.observed.point_ids, ids) for ids in (a.inlier_ids, a.outlier_ids))
        if not seen.frame.valid.any():
            return
        rows, columns = (np.flatnonzero(seen.frame.valid.any(axis)) for axis in (1, 0))
        part = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
        image, corner = seen.frame.image[part], np.array([columns[0], rows[0]])
        depth = thumbnail(colored_distance(seen.prediction.distance[part], seen.prediction.valid[part]), 480)
        pixels = aligned.observed.pixels - corner
        points = marked_points(image, [(pixels[bad], BAD), (pixels[good], GOOD)])
        shown = {
            "image": thumbnail(image, 480),
            "predicted distance, yellow near": depth,
            "map points, green in, red out": points,
        }
        state = f"scale {number(a.scale)}, {len(a.inlier_ids)} of {a.points} points inliers" if a.ok else a.reason
        tiles = [Tile(jpeg(picture), label) for label, picture in shown.items()]
        self.pictures[submap.id].append((tiles, f"{aligned.keyframe.name}: {state}"))


def densify_page(
    title: str,
    results: Sequence[SubmapResult],
    gallery: Gallery,
    notes: Sequence[str],
    figures: Sequence[MapFigures] | None = None,
    mm_per_unit: MmPerUnit = None,
    merged: Merged | None = None,
    errors: Sequence[ErrorMesh] = (),
) -> Report:
    """The whole page. `figures` are their errors where there is truth, and `errors` those of vertices; areas are in mm²
    where the unit of the maps is known."""
    page = Report(title)
    for note in notes:
        page.text(note)
    scene = Scene.of(_surfaces(results, merged, errors), gallery.thumbnails.found, said())
    if scene is not None:
        page.heading("The surface in three dimensions")
        page.scene(scene)
    if figures is not None:
        _errors(page, figures)
    page.heading("Surfaces")
    rows = []
    for result in results:
        d = result.dense
        aligned = f"{len(d.aligned)} of {len(d.alignments)}"
        judged, inlier = d.judged_points()
        points = f"{int(inlier.sum())} in, {int((judged & ~inlier).sum())} out, {int((~judged).sum())} not judged"
        rows.append([f"map {d.submap.id}", aligned, points, len(d.vertices), d.voxel, result.seen_share])
    headers = [
        "",
        "keyframes aligned",
        "sparse points",
        "surface vertices",
        "voxel [map units]",
        "share of pixels that show it",
    ]
    page.table(headers, rows)
    if any(r.coverage for r in results):
        _coverage(page, results, mm_per_unit)
    if any(r.judgement for r in results):
        _judged(page, results)
    pictured = sorted(results, key=lambda r: -len(r.dense.triangles))[:PICTURED]
    if len(pictured) < len(results):
        page.text(f"Pictures are of the {len(pictured)} largest maps, so that this page stays small.")
    for result in results:
        _submap(page, result, gallery, any(result is one for one in pictured))
    _times(page, results)
    return page


def joined_section(page: Report, merged: Merged) -> None:
    """Which submaps met and how, which did not and why, and the surfaces that they make together."""
    page.heading("Joined submaps")
    rows = []
    for j in merged.tried:
        gap = j.surfaces.gap if j.surfaces else None
        state = "joined" if j.ok else f"not joined: {j.reason}"
        rows.append([f"maps {j.target} and {j.source}", j.by, f"{j.agreeing} of {j.matches}", gap, state])
    page.table(["", "by", "correspondences that agree", "gap between the surfaces, share of the distance", ""], rows)
    for place, (result, group) in enumerate(zip(merged.results, merged.groups, strict=True)):
        maps = ", ".join(map(str, sorted(group)))
        page.heading(f"Maps {maps} as one ({joined_name(result)})")
        page.text(f"In the frame of reference and unit of map {next(iter(group))}; fused anew from all keyframes.")
        if len(result.dense.triangles) and place < PICTURED:
            for row in mesh_pictures(result.dense, f"maps {maps}"):
                page.figures(row)


def _surfaces(results: Sequence[SubmapResult], merged: Merged | None, errors: Sequence[ErrorMesh]) -> list[Surface]:
    """The joined surfaces, then those of submaps that are in none of them, the green ones first."""
    joined = [] if merged is None else list(zip(merged.results, merged.groups, strict=True))
    joined = [(result, group) for result, group in joined if len(result.dense.triangles)]
    within = {map_id for _, group in joined for map_id in group}
    distances = {mesh.name: mesh.distance for mesh in errors}
    surfaces = [
        surface_of(f"{joined_name(result)}: maps {', '.join(map(str, sorted(group)))} as one", result.dense)
        for result, group in joined
    ]
    alone = [r for r in results if r.dense.submap.id not in within]
    for dense in (r.dense for r in sorted(alone, key=lambda r: r.verdict is None or r.verdict.colour != "green")):
        number = dense.submap.id
        surfaces.append(surface_of(f"map {number}", dense, distances.get(f"map_{number:03d}")))
    return surfaces


FILES = {
    "joined_*/mesh.*": "the joined surface",
    **SURFACE_FILES,
    "*_error.ply": "the surface coloured by its distance from the truth",
    "metrics.md": "errors against the truth, in tables",
    "metrics.json": "the same, for programs",
    "cumulative_error.png": "the share of the surface within each error",
    "scale.json": "millimetres per unit of each map, with an interval, or why none",
    "uncertainty.json": "the factor that calibrates the predicted uncertainty",
}
"""What the files of a run are, by pattern."""


def _errors(page: Report, figures: Sequence[MapFigures]) -> None:
    page.heading("Errors against the truth")
    page.text(
        "RMS and median of the distances from each model point to the closest true point, after the Sim(3) that aligns "
        "the trajectories, and the trajectory's own error (ATE). All in mm."
    )
    rows = []
    for entry in figures:
        if entry.aligned is None:
            page.text(f"Map {entry.map_id} could not be evaluated: {entry.error}")
            continue
        if entry.surface_error:
            page.text(f"Map {entry.map_id}: {entry.surface_error}")
        for key, name in (
            ("sparse", "sparse map"),
            ("sparse_inliers", "sparse, inliers only"),
            ("dense", "dense surface"),
        ):
            found = entry.clouds.get(key)
            if found is not None:
                ate = entry.aligned.rms_ate_mm
                rows.append([f"map {entry.map_id}", name, found.points, found.rms_mm, found.median_mm, ate])
    page.table(["", "model", "points", "RMS", "median", "ATE"], rows)


def _coverage(page: Report, results: Sequence[SubmapResult], mm_per_unit: MmPerUnit) -> None:
    page.heading("Coverage")
    page.text(
        "Wall was seen well if enough keyframes saw it, not too slanted and neither clipped nor in the dark, and if "
        "the map has points near enough to hold it: depth of far wall may be wrong in all keyframes alike. "
        "Holes are wall that no keyframe saw, with surface around them; the open ends of a piece of tube do not count. "
        "The last column names the frame to look at again."
    )
    unit = "mm²" if mm_per_unit else "map units²"
    rows, regions = [], []
    for result in results:
        if result.coverage is None:
            continue
        map_id = result.dense.submap.id
        name, c = f"map {map_id}", result.coverage.scaled(factor(mm_per_unit, map_id))
        rows.append(
            [name, c.area, 100 * c.well_share, len(c.weak), sum(r.area for r in c.weak), len(c.holes), c.hole_area]
        )
        kinds = [("hole", r) for r in c.holes[:5]] + [("seen weakly", r) for r in c.weak[:5]]
        regions += [[name, kind, r.area, r.frame] for kind, r in kinds]
    headers = [
        "",
        f"surface [{unit}]",
        "seen well [%]",
        "weak patches",
        f"their area [{unit}]",
        "holes",
        f"their area [{unit}]",
    ]
    page.table(headers, rows)
    if regions:
        page.text("The largest of each kind:")
        page.table(["", "", f"area [{unit}]", "frame"], regions)


def _judged(page: Report, results: Sequence[SubmapResult]) -> None:
    page.heading("Agreement")
    page.text(
        "Each figure is the median difference between the distances of single keyframes and distances that they were "
        "not fitted to, as a share of the distance. This is agreement, not error: map, images and surface may be wrong "
        "together, above all by one factor or its slow drift. Map, hidden blocks: points in blocks of wall that were "
        "hidden from every keyframe in turn. Map, drawn points: points hidden one by one, which lie beside points that "
        "were used, so their figures flatter. Images: distances by parallax between keyframes. As delivered: with the "
        "part of its bend that each keyframe kept, without the finer grid; log and evaluate show these figures. A "
        "constant distance gets the same help, one scale or a bend: where it does as well, the map did the work and "
        "not the prediction. The surface itself uses every point."
    )
    rows: list[list[Any]] = []
    for result in results:
        j, name = result.judgement, f"map {result.dense.submap.id}"
        if j is None:
            continue
        for what, c in (("map, hidden blocks", j.blocks), ("map, drawn points", j.drawn), ("images", j.images)):
            if c.count:
                delivered = j.hidden.median if c is j.blocks and j.hidden is not None else None
                ways = [c.one_scale, c.bent, delivered, c.constant_one_scale, c.constant_bent]
                rows.append([name, what, c.count, *ways])
    headers = ["", "agreement with", "distances", "one scale", "bent", "as delivered", "constant, one scale"]
    headers += ["constant, bent"]
    page.table(headers, rows)
    for result in results:
        j = result.judgement
        if j is None:
            continue
        said = [full_stop(str(result.verdict))] if len(results) > 1 else []  # a single one is said above
        if j.surface is not None:
            missed = f"{100 * j.surface.miss:.0f} % of the rays to places that the images measured miss the surface"
            few = "" if spoke(j.surface) else f" ({j.surface.points} pixels, too few to judge by)"
            said.append(f"{missed}{few}.")
        braked = [a for a in result.dense.alignments if a.unbent_because]
        if braked:
            kept = f"{j.undone} keyframes lost their bend (one scale is left), {j.lessened} kept a part of it"
            said.append(full_stop(f"{kept}. Keyframe {braked[0].keyframe}: {braked[0].unbent_because}"))
        if said:
            page.text(f"Map {result.dense.submap.id}: {' '.join(said)}")


def _submap(page: Report, result: SubmapResult, gallery: Gallery, pictured: bool) -> None:
    dense = result.dense
    page.heading(f"Map {dense.submap.id}")
    left_out = [a for a in dense.alignments if not a.ok]
    for a in left_out[:5]:
        page.text(f"Keyframe {a.keyframe} left out: {a.reason}")
    if len(left_out) > 5:
        page.text(f"… and {len(left_out) - 5} more (keyframes.csv)")
    if not pictured:
        return
    for row in mesh_pictures(dense):
        page.figures(row)
    page.wide_figures(
        [
            (
                _scale_chart(dense),
                "Scale of each keyframe; bars: how far its points scatter",
            )
        ]
    )
    for tiles, caption in gallery.pictures[dense.submap.id]:
        page.tiles(tiles, caption)


def mesh_pictures(dense: DenseMap, name: str = "") -> list[list[tuple[bytes, str]]]:
    """The surface from outside, then from the place of the middle keyframe: in its colours, its shape alone, and by how
    well it was seen."""
    name = name or f"map {dense.submap.id}"
    middle = dense.submap.keyframes[len(dense.submap.keyframes) // 2]
    mesh, axes, focal = (dense.vertices, dense.triangles), middle.cam_from_map[:3, :3], _focal_to_see(middle.camera)
    inside = MeshView.of(*mesh, origin=middle.center, axes=axes, focal=focal)
    views = {
        f"Surface of {name} from outside": MeshView.of(*mesh),
        f"From keyframe {middle.name}; empty where there is no surface": inside,
    }
    ways: list[tuple[np.ndarray | None, str]] = [(dense.colors, ""), (None, "Its shape, without its colour")]
    if (kinds := seen_kinds(dense)) is not None:
        ways.append((KINDS[kinds], f"Seen well (green), weakly (orange), or of a confidence below {TRUSTED} (red)"))
    return [[(webp(view.cutout(c)), text or said) for c, text in ways] for said, view in views.items()]


def _focal_to_see(camera: CameraModel) -> float:
    """The focal length, over the width of a picture of 4 by 3, with which a pinhole shows all that a camera sees, up to
    some 120 degrees."""
    across, down = tangents(camera)
    wanted = 0.5 / max(across, 4 / 3 * down)
    return float(np.clip(wanted, 0.28, 1.5))


def _scale_chart(dense: DenseMap) -> bytes:
    figure, axes = chart((6.4, 2.6))
    numbers = np.array([k.number for k in dense.submap.keyframes])
    ok = np.array([a.ok for a in dense.alignments])
    scale = np.array([a.scale for a in dense.alignments])
    spread = np.array([a.sigma / max(a.range_90, 1e-12) for a in dense.alignments]) * scale
    axes.errorbar(numbers[ok], scale[ok], yerr=spread[ok], fmt="o-", markersize=4, capsize=2, color="#2a6f97")
    axes.set_xlabel("frame")
    axes.xaxis.get_major_locator().set_params(integer=True)
    axes.set_ylabel("map units per predicted unit")
    axes.set_ylim(bottom=0)
    return chart_png(figure)


def _times(page: Report, results: Sequence[SubmapResult]) -> None:
    page.heading("Time")
    count = sum(len(r.dense.alignments) for r in results)
    steps = list(dict.fromkeys(step for r in results for step in r.seconds))
    totals = {step: sum(r.seconds.get(step, 0.0) for r in results) for step in steps}
    page.table(
        ["step", "seconds", "ms per keyframe"], [[step, t, 1000 * t / max(count, 1)] for step, t in totals.items()]
    )
