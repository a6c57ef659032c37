"""A run as a recording for the Rerun viewer: every map, its surface in all colours, points, path and keyframes.

`/MAP/surface/COLOUR` is a mesh, `/MAP/points/KIND` a cloud, `/MAP/camera` a keyframe's place, with its image, at the
number of its frame on the timeline `frame`, where `/MAP/predicted` has the row of pictures that `densify` wrote.
Coordinates are the map's (x right, y down, z ahead, of its first camera). A lens is drawn as a pinhole of its field.
It is made in memory, two and a half times its size: the package's own writer waits without end where the disk is full.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Sequence

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from densify.trust import vertex_normals
from densify.viewing.known import Known
from densify.viewing.places import LEFT_OUT, PATH, USED, centers, extent, vertex_colors
from densify.viewing.watched import ViewedMap
from lightdepth.errors import InputError
from lightdepth.foreign_text import for_terminal
from lightdepth.reporting.figures import jpeg
from lightdepth.reporting.progress import Progress

BEGINNING = "RRF2"
"""How such a file begins."""
TIMELINE = "frame"
_OFF = ("0", "false", "off", "no")
"""What the package takes for a switch in the variable RERUN."""


def recorded(maps: Sequence[ViewedMap], known: Known) -> bytes:
    """The file. Raises InputError where the package is switched off."""
    if os.environ.get("RERUN", "").lower() in _OFF:
        raise InputError("RERUN", "the environment switches the package off by it", "take it out of the environment")
    recording = rr.RecordingStream("lightdepth", send_properties=False)
    stream = rr.binary_stream(recording)
    try:
        recording.send_recording_name("a run of lightdepth")
        recording.set_log_time_enabled(False)
        recording.set_log_tick_enabled(False)
        first = rrb.Blueprint(rrb.Tabs(*map(_tab, maps)), collapse_panels=False)
        recording.send_blueprint(first, make_active=False, make_default=True)
        with Progress("Recording", sum(len(viewed.surface.poses) for viewed in maps)) as bar:
            for viewed in maps:
                _log_map(recording, viewed, known)
                for _ in _log_keyframes(recording, viewed, known):
                    bar.advance()
        made: bytes | None = stream.read()
        assert made, "nothing was recorded"
        return made
    finally:
        recording.disconnect()


def _tab(viewed: ViewedMap) -> rrb.Horizontal:
    """A map's scene, of which one colour is shown at first, beside its keyframe's pictures."""
    place, surface = f"/{viewed.name}", viewed.surface
    hidden = [f"{place}/surface/{entity(layer.title)}" for layer in surface.layers[1:]]
    hidden += [f"{place}/points/{entity(cloud.title)}" for cloud in surface.clouds]
    scene = rrb.Spatial3DView(
        origin=place,
        contents=["+ $origin/**", "- $origin/predicted"],  # pictures beside the image, which have no place
        name=for_terminal(surface.title),
        overrides={each: rrb.EntityBehavior(visible=False) for each in hidden},
    )
    image = rrb.Spatial2DView(origin=f"{place}/camera/image", name="Keyframe")
    row = rrb.Spatial2DView(origin=f"{place}/predicted", name="Predicted: distance, uncertainty, map points")
    return rrb.Horizontal(scene, rrb.Vertical(image, row), column_shares=[2, 1], name=for_terminal(surface.title))


def entity(title: str) -> str:
    """A title as a part of a path."""
    return re.sub(r"[^a-z0-9]+", "_", title.lower()).strip("_")


def _log_map(recording: rr.RecordingStream, viewed: ViewedMap, known: Known) -> None:
    place, surface, size = f"/{viewed.name}", viewed.surface, extent(viewed.surface)
    recording.log(place, rr.ViewCoordinates.RDF, static=True)
    recording.log(f"{place}/unit", rr.TextDocument(known.unit), static=True)
    normals = vertex_normals(surface.vertices, surface.triangles).astype(np.float32)
    for layer in surface.layers:
        mesh = rr.Mesh3D(
            vertex_positions=surface.vertices.astype(np.float32),
            triangle_indices=surface.triangles.astype(np.uint32),
            vertex_normals=normals,
            vertex_colors=np.rint(255 * vertex_colors(layer, len(surface.vertices))).astype(np.uint8),
        )
        recording.log(f"{place}/surface/{entity(layer.title)}", mesh, static=True)
    for cloud in surface.clouds:
        points = rr.Points3D(cloud.points.astype(np.float32), colors=cloud.color, radii=0.002 * size)
        recording.log(f"{place}/points/{entity(cloud.title)}", points, static=True)
    if len(places := centers(surface)) > 1:
        path = rr.LineStrips3D([places.astype(np.float32)], colors=PATH, radii=0.0008 * size)
        recording.log(f"{place}/path", path, static=True)


def _log_keyframes(recording: rr.RecordingStream, viewed: ViewedMap, known: Known) -> Iterator[None]:
    place, surface = f"/{viewed.name}", viewed.surface
    across, down = surface.tangents
    for pose, center, number in zip(surface.poses, centers(surface), viewed.read.numbers.tolist(), strict=True):
        recording.set_time(TIMELINE, sequence=int(number))
        turned = rr.Transform3D(translation=center, mat3x3=pose.cam_from_map[:3, :3].T)
        recording.log(f"{place}/camera", turned)
        image = known.pictures.large(int(number))
        height, width = (480, 640) if image is None else image.shape[:2]
        lens = rr.Pinhole(
            resolution=[width, height],
            focal_length=[width / (2 * across), height / (2 * down)],
            camera_xyz=rr.ViewCoordinates.RDF,
            image_plane_distance=0.05 * extent(surface),
            color=USED if pose.used else LEFT_OUT,
        )
        recording.log(f"{place}/camera/image", lens)
        if image is None:
            recording.log(f"{place}/camera/image", rr.Clear(recursive=False))
        else:
            recording.log(f"{place}/camera/image", _picture(image))
        row = known.pictures.row(int(number))
        recording.log(f"{place}/predicted", rr.Clear(recursive=False) if row is None else _picture(row))
        state = "" if pose.used else ", left out of the surface"
        recording.log(f"{place}/said", rr.TextDocument(for_terminal(f"{pose.name}{state}")))
        yield


def _picture(image: np.ndarray) -> rr.EncodedImage:
    return rr.EncodedImage(contents=jpeg(image), media_type="image/jpeg")
