"""One map of a run as nodes of viser's scene: its surface, points, path and cameras.

The surface goes as glTF, which alone has a colour for each vertex; it wants colours in linear light.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import viser
from viser import transforms

from densify.viewing.places import CHOSEN, LEFT_OUT, PATH, USED, centers, extent, vertex_colors
from densify.viewing.watched import ViewedMap
from lightdepth.reporting.scene import Layer, Pose, Surface

MOST_CAMERAS = 200
"""Cameras that are drawn of a map; of more, some are left out evenly."""


@dataclass(frozen=True)
class Parts:
    """What is shown of every map: the title of the surface's colours, whether the wall that faces away from the viewer
    is left out, which parts are there, by title, and the size of cameras beside the usual one."""

    layer: str
    through: bool
    shown: frozenset[str]
    size: float = 1.0


def gltf(surface: Surface, layer: Layer, through: bool) -> bytes:
    """A surface as binary glTF in the colours of a layer; `through` leaves out triangles that are seen from behind."""
    import trimesh

    shown = vertex_colors(layer, len(surface.vertices))
    light = np.where(shown > 0.04045, ((shown + 0.055) / 1.055) ** 2.4, shown / 12.92)
    mesh = trimesh.Trimesh(
        surface.vertices, surface.triangles, vertex_colors=np.rint(255 * light).astype(np.uint8), process=False
    )

    def finish(tree: Any) -> None:
        dull = {"metallicFactor": 0.0, "roughnessFactor": 1.0}
        tree["materials"] = [{"pbrMetallicRoughness": dull, "doubleSided": not through}]
        for part in (part for made in tree["meshes"] for part in made["primitives"]):
            part["material"] = 0

    data = mesh.export(file_type="glb", include_normals=True, tree_postprocessor=finish)
    assert isinstance(data, bytes)
    return data


class DrawnMap:
    """The nodes of one map. `on_camera` is called with its name and the number of a keyframe in its path when the
    camera of that is clicked."""

    def __init__(
        self, server: viser.ViserServer, viewed: ViewedMap, parts: Parts, on_camera: Callable[[str, int], None]
    ) -> None:
        self.viewed, self._scene = viewed, server.scene
        self._root = f"/{viewed.name}"
        surface = viewed.surface
        self.centers, self._usual = centers(surface), _camera_size(surface)
        self.frame = self._scene.add_frame(self._root, show_axes=False)
        self.surface = self._scene.add_glb(
            f"{self._root}/surface", self._gltf(parts), cast_shadow=False, receive_shadow=False
        )
        self._drawn = (parts.layer, parts.through)
        self.clouds = {
            cloud.title: self._scene.add_point_cloud(
                f"{self._root}/points/{i}",
                cloud.points.astype(np.float32),
                cloud.color,
                point_size=0.004 * extent(surface),
                point_shape="circle",
                precision="float32",
                point_shading="flat",
            )
            for i, cloud in enumerate(surface.clouds)
        }
        self.cameras = {i: self._camera(i, surface.poses[i], parts.size, on_camera) for i in _drawn_cameras(surface)}
        self.path = None
        if len(self.centers) > 1:
            steps = np.stack([self.centers[:-1], self.centers[1:]], 1)
            thick = 0.0012 * extent(surface)
            self.path = self._scene.add_line_segments(f"{self._root}/path", steps, PATH, thickness=thick)
        self._chosen: int | None = None
        self.show(parts)

    def show(self, parts: Parts, inside: bool = False) -> None:
        """Shows these parts; cameras and path would stand in the way of who looks from inside."""
        if (parts.layer, parts.through) != self._drawn:
            self.surface.glb_data = self._gltf(parts)
            self._drawn = (parts.layer, parts.through)
        self.surface.visible = "Surface" in parts.shown
        for title, cloud in self.clouds.items():
            cloud.visible = title in parts.shown
        for camera in self.cameras.values():
            camera.visible = "Cameras" in parts.shown and not inside
            camera.scale = parts.size * self._usual
        if self.path is not None:
            self.path.visible = "Path" in parts.shown and not inside

    def choose(self, keyframe: int | None) -> None:
        """Marks the camera of a keyframe, and no other."""
        for row, color in ((self._chosen, None), (keyframe, CHOSEN)):
            if row is not None and row in self.cameras:
                self.cameras[row].color = color or _color(self.viewed.surface.poses[row])
        self._chosen = keyframe

    def remove(self) -> None:
        self.frame.remove()

    def _gltf(self, parts: Parts) -> bytes:
        layers = self.viewed.surface.layers
        layer = next((layer for layer in layers if layer.title == parts.layer), layers[0])
        return gltf(self.viewed.surface, layer, parts.through)

    def _camera(
        self, number: int, pose: Pose, size: float, on_camera: Callable[[str, int], None]
    ) -> viser.CameraFrustumHandle:
        across, down = self.viewed.surface.tangents
        handle = self._scene.add_camera_frustum(
            f"{self._root}/cameras/{number}",
            fov=2 * float(np.arctan(down)),
            aspect=across / down,
            scale=size * self._usual,
            thickness=1.5,
            thickness_units="screen",
            color=_color(pose),
            wxyz=transforms.SO3.from_matrix(pose.cam_from_map[:3, :3].T).wxyz,
            position=self.centers[number],
            cast_shadow=False,
            receive_shadow=False,
        )
        handle.on_click(lambda _: on_camera(self.viewed.name, number))
        return handle


def _color(pose: Pose) -> tuple[int, int, int]:
    return USED if pose.used else LEFT_OUT


def _drawn_cameras(surface: Surface) -> list[int]:
    count = len(surface.poses)
    return sorted(set(np.linspace(0, count - 1, min(count, MOST_CAMERAS)).round().astype(int).tolist()))


def _camera_size(surface: Surface) -> float:
    """Of a camera on the path: about the way to the next one that is drawn, within bounds that can be seen."""
    places, size = centers(surface)[_drawn_cameras(surface)] if surface.poses else np.zeros((0, 3)), extent(surface)
    steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
    return float(np.clip(np.median(steps) if len(steps) else 0.0, 0.015 * size, 0.05 * size))
