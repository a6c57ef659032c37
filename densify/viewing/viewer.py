"""The viewer of a run: its maps in a scene, a panel that says what of them is shown, the path, and the ruler.

Everything here happens on threads of the server, one at a time.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import viser

from densify.judging.verdict import COLOURS
from densify.measure import Way
from densify.viewing.drawn import DrawnMap
from densify.viewing.known import Known
from densify.viewing.panel import Panel, lines, put_value
from densify.viewing.pictures import Pictures
from densify.viewing.places import CHOSEN, extent
from densify.viewing.ruler import Place, Ruler
from densify.viewing.watched import State, ViewedMap
from lightdepth.counting import counted, full_stop
from lightdepth.errors import InputError
from lightdepth.reporting.scene import Surface

_FOV = 2 * float(np.arctan(0.36))  # of a look from outside, up and down
_AROUND = 1.08  # of what is looked at from outside, with a little room
_WIDEST = 2.0  # radians, of a look from inside
_WAY = (214, 40, 120)
_SAID: dict[State, tuple[str, str]] = {
    "finished": ("", "The run has no surface now."),
    "at work": (
        "The run is at work: maps come as it finishes them.",
        "No surface yet: it comes when the run has finished its first map.",
    ),
    "stopped": (
        "The run was stopped: no more maps come unless it is resumed.",
        "The run was stopped before its first surface.",
    ),
    "gone": ("The run is no longer in its place.",) * 2,
}
"""What is said of a run's state: where there is a map, and where there is none."""


class Viewer:
    """What browsers see. `measured` is given each length that is measured, as a record and in words."""

    def __init__(
        self,
        server: viser.ViserServer,
        known: Known,
        ruler: Ruler,
        measured: Callable[[Mapping[str, Any], str], None] = lambda record, words: None,
    ) -> None:
        self._server, self.known, self._ruler, self._measured = server, known, ruler, measured
        self._lock = threading.RLock()
        self.maps: dict[str, DrawnMap] = {}
        self.on: dict[str, viser.GuiCheckboxHandle] = {}
        self.stations: list[tuple[str, int]] = []
        self._places: list[Place] = []
        self._marks: list[viser.SceneNodeHandle] = []
        self._more = threading.Event()
        self._over = False
        scene = server.scene
        scene.configure_default_lights(True, cast_shadow=False)
        self.panel = panel = Panel.of(server.gui)
        panel.layer.on_update(lambda _: self._show())
        panel.size.on_update(lambda _: self._show())
        for box in panel.parts.values():
            box.on_update(lambda _: self._show())
        panel.keyframe.on_update(lambda event: self._ride(event.client))
        panel.inside.on_update(lambda event: self._ride(event.client, leave=True))
        panel.outside.on_click(lambda event: self._leave(event.client))
        panel.measuring.on_update(lambda _: self._listen())
        panel.clear.on_click(lambda _: self._clear())
        self.tell(known)
        self._filling = threading.Thread(target=self._fill_cameras, name="pictures", daemon=True)
        self._filling.start()

    def tell(self, known: Known) -> None:
        """What is known now."""
        with self._lock:
            self.known = known
            self._note()
            self._station(None)
        self._more.set()

    def close(self) -> None:
        """No more pictures are read. The server may stop then."""
        self._over = True
        self._more.set()
        self._filling.join()

    def put(self, maps: Sequence[ViewedMap], gone: Sequence[str] = ()) -> None:
        """Maps that are new, or others than before, and the names of those that are no more."""
        with self._lock, self._server.atomic():
            first = not self.maps
            for name in [*gone, *(viewed.name for viewed in maps)]:
                if name in self.maps:
                    self.maps.pop(name).remove()
                if name in gone and name in self.on:
                    self.on.pop(name).remove()
            for viewed in maps:
                self.maps[viewed.name] = DrawnMap(self._server, viewed, self.panel.chosen(), self._on_camera)
            self.maps = dict(sorted(self.maps.items()))
            for viewed in maps:
                self._offer(viewed)
            self.panel.offer([drawn.viewed.surface for drawn in self.maps.values()])
            if first and self.maps:
                for name in self.maps:
                    put_value(self.on[name], name == self._best())
                self._look_first()
            if any(place.map in {*gone, *(viewed.name for viewed in maps)} for place in self._places):
                self._clear()
            self._note()
            self._show()
        self._more.set()

    def _offer(self, viewed: ViewedMap) -> None:
        if viewed.name not in self.on:
            with self.panel.maps:
                read, used = viewed.read, sum(pose.used for pose in viewed.surface.poses)
                hint = f"{used} of {counted(len(read.numbers), 'keyframe')}, {len(read.vertices)} vertices"
                self.on[viewed.name] = self._server.gui.add_checkbox(
                    viewed.surface.title, len(self.maps) == 1, hint=hint
                )
            self.on[viewed.name].on_update(lambda _: self._show())

    def _best(self) -> str:
        """The map that is shown first: a joined one before single ones, then that with the best verdict, then that with
        most triangles."""

        def merit(name: str) -> tuple[bool, int, int]:
            viewed = self.maps[name].viewed
            worse = COLOURS.index(viewed.colour) if viewed.colour in COLOURS else len(COLOURS)
            return name.startswith("joined_"), -worse, len(viewed.read.triangles)

        return max(self.maps, key=merit)

    def shown(self) -> list[DrawnMap]:
        """The maps that are on."""
        return [drawn for name, drawn in self.maps.items() if self.on[name].value]

    def _show(self) -> None:
        """Brings the scene to what the panel says."""
        with self._lock, self._server.atomic():
            shown, parts = self.shown(), self.panel.chosen()
            inside = bool(self.panel.inside.value)
            for name, drawn in self.maps.items():
                drawn.frame.visible = bool(self.on[name].value)
                drawn.show(parts, inside)
            surfaces = [drawn.viewed.surface for drawn in shown]
            self.panel.explain(surfaces)
            self.panel.together.visible = len(shown) > 1
            chosen = self._station_now()
            self.stations = [(d.viewed.name, row) for d in shown for row in range(len(d.centers))]
            self.panel.keyframe.max = max(1, len(self.stations) - 1)
            self._station(chosen)

    # The path

    def _station_now(self) -> tuple[str, int] | None:
        place = int(self.panel.keyframe.value)
        return self.stations[place] if place < len(self.stations) else None

    def _station(self, wanted: tuple[str, int] | None) -> None:
        """Chooses a keyframe; one that is not there, the one at the slider's place."""
        if not self.stations:
            self.panel.picture.visible = self.panel.row.visible = self.panel.row_said.visible = False
            self.panel.caption.content = ""
            return
        if wanted in self.stations:
            place = self.stations.index(wanted)
        else:
            place = min(int(self.panel.keyframe.value), len(self.stations) - 1)
        put_value(self.panel.keyframe, place)
        name, row = self.stations[place]
        for drawn in self.maps.values():
            drawn.choose(row if drawn.viewed.name == name else None)
        viewed = self.maps[name].viewed
        pose, number = viewed.surface.poses[row], int(viewed.read.numbers[row])
        picture = self.known.pictures.large(number)
        self.panel.picture.visible = picture is not None
        if picture is not None:
            self.panel.picture.image = picture
        beside = self.known.pictures.row(number)
        self.panel.row.visible = self.panel.row_said.visible = beside is not None
        if beside is not None:
            self.panel.row.image = beside
        state = "" if pose.used else ", left out of the surface"
        self.panel.caption.content = lines(f"{viewed.surface.title}, keyframe {pose.name}{state}")

    def _on_camera(self, name: str, row: int) -> None:
        """A click on a camera."""
        with self._lock:
            if not self.panel.measuring.value:
                self._station((name, row))

    def _ride(self, client: viser.ClientHandle | None, leave: bool = False) -> None:
        with self._lock:
            self._station(self._station_now())
            if leave:
                self._show()
        if client is None or not self.stations:
            return
        if self.panel.inside.value:
            self._enter(client)
        elif leave:
            self._from_outside(client)

    def _enter(self, client: viser.ClientHandle) -> None:
        """Looks from where a keyframe was taken."""
        with self._lock:
            if (now := self._station_now()) is None:
                return
            drawn = self.maps[now[0]]
        surface, center = drawn.viewed.surface, drawn.centers[now[1]]
        _, down, ahead = surface.poses[now[1]].cam_from_map[:3, :3]
        tangent = max(surface.tangents[1], surface.tangents[0] / max(client.camera.aspect, 0.1))
        with client.atomic():
            client.camera.position = center
            client.camera.look_at = center + 0.1 * extent(surface) * ahead
            client.camera.up_direction = -down
            client.camera.fov = min(2 * float(np.arctan(tangent)), _WIDEST)

    def _leave(self, client: viser.ClientHandle | None) -> None:
        if self.panel.inside.value:
            put_value(self.panel.inside, False)
            self._show()
        if client is not None and self.maps:
            self._from_outside(client)

    def _outside(self, aspect: float = 1.0) -> tuple[Surface, np.ndarray, np.ndarray]:
        """The surface that is looked at, the eye, and the middle of it with its cameras, which all fit in a window of
        this width over height."""
        drawn = (self.shown() or [self.maps[self._best()]])[0]
        axes = drawn.viewed.surface.axes
        places = np.concatenate([drawn.viewed.surface.vertices, drawn.centers]) @ axes.T
        low, high = places.min(0), places.max(0)
        half = (high - low) / 2
        away = half[2] + _AROUND * max(half[0] / aspect, half[1]) / float(np.tan(_FOV / 2))
        middle = axes.T @ ((low + high) / 2)
        return drawn.viewed.surface, middle - away * axes[2], middle

    def _from_outside(self, client: viser.ClientHandle) -> None:
        surface, eye, middle = self._outside(max(client.camera.aspect, 0.1))
        with client.atomic():
            client.camera.position = eye
            client.camera.look_at = middle
            client.camera.up_direction = -surface.axes[1]
            client.camera.fov = _FOV

    def _look_first(self) -> None:
        surface, eye, middle = self._outside()
        size, camera = extent(surface), self._server.initial_camera
        self._server.scene.set_up_direction(-surface.axes[1])
        camera.position, camera.look_at, camera.up = eye, middle, -surface.axes[1]
        camera.fov, camera.near, camera.far = _FOV, 1e-3 * size, 50 * size
        for client in self._server.get_clients().values():
            self._from_outside(client)

    def _fill_cameras(self) -> None:
        """Puts pictures on cameras, as they come, for as long as the viewer is there."""
        done: dict[str, tuple[DrawnMap, Pictures]] = {}
        while not self._over:
            self._more.wait()
            self._more.clear()
            with self._lock:
                pictures = self.known.pictures
                waiting = [drawn for name, drawn in self.maps.items() if done.get(name) != (drawn, pictures)]
            for drawn in waiting:
                for row, camera in drawn.cameras.items():
                    if not self._is_wanted(drawn, pictures):
                        break
                    picture = pictures.small(int(drawn.viewed.read.numbers[row]))
                    with self._lock:  # a camera that was removed takes no picture
                        if not self._is_wanted(drawn, pictures):
                            break
                        if picture is not None:
                            camera.image = picture
                else:
                    done[drawn.viewed.name] = (drawn, pictures)

    def _is_wanted(self, drawn: DrawnMap, pictures: Pictures) -> bool:
        return not self._over and self.known.pictures is pictures and drawn in self.maps.values()

    # The ruler

    def _listen(self) -> None:
        """Clicks are places while the box is on."""
        with self._lock:
            self._clear()
            self._server.scene.remove_click_callback("all")
            if self.panel.measuring.value:
                self._server.scene.on_click()(self.click)
                for drawn in self.shown():
                    self._ruler.wall(drawn.viewed)

    def click(self, event: viser.SceneClickEvent) -> None:
        """A click in the scene: the first of two places, or the second."""
        with self._lock:
            eye, ray = np.array(event.ray_origin), np.array(event.ray_direction)
            maps = [drawn.viewed for drawn in self.shown()]
            place = self._ruler.place(maps, eye, ray, self.panel.chosen().through)
            if place is None:
                self.panel.measured.content = lines("No wall there.", *self._waiting())
                return
            if len(self._places) == 2 or (self._places and self._places[0].map != place.map):
                self._clear()
            self._places.append(place)
            self.panel.clear.visible = True
            self._mark(place)
            self.panel.measured.content = lines(*self._waiting())
            if len(self._places) == 2:
                self._measure(self.maps[place.map].viewed)

    def _waiting(self) -> list[str]:
        if not self.panel.measuring.value or len(self._places) == 2:
            return []
        return ["Click the second place." if self._places else "Click the first place on the wall."]

    def _measure(self, viewed: ViewedMap) -> None:
        try:
            found = self._ruler.between(viewed, *(place.point for place in self._places))
        except InputError as error:
            self.panel.measured.content = lines(full_stop(f"{error.found}; {error.cure}"))
            return
        unit, way = self.known.unit, found.found
        assert isinstance(way, Way)
        words = found.summary(unit)
        self.panel.measured.content = lines(words)
        points = way.scaled(1 / self._ruler.scale).points
        thick = 0.003 * extent(viewed.surface)
        scene = self._server.scene
        steps = np.stack([points[:-1], points[1:]], 1)
        self._marks.append(scene.add_line_segments("/measured/way", steps, _WAY, thickness=thick))
        label = f"{way.length:.4g} {unit}"
        self._marks.append(scene.add_label("/measured/length", label, position=points[len(points) // 2]))
        record = {"map": viewed.name, "unit": unit, **found.record()}
        self._measured(record, f"{viewed.surface.title}: {words}")

    def _mark(self, place: Place) -> None:
        radius = 0.006 * extent(self.maps[place.map].viewed.surface)
        name = f"/measured/{len(self._places)}"
        mark = self._server.scene.add_icosphere(name, radius=radius, color=CHOSEN, position=place.point)
        self._marks.append(mark)

    def _clear(self) -> None:
        with self._lock:
            for mark in self._marks:
                mark.remove()
            self._marks, self._places = [], []
            self.panel.clear.visible = False
            self.panel.measured.content = lines(*self._waiting())

    def _note(self) -> None:
        """What is to be said of the run as a whole."""
        said = [_SAID[self.known.state][not self.maps]]
        fewer = [d.viewed.surface for d in self.maps.values() if d.viewed.surface.made is not None]
        if any(len(s.triangles) < (s.made or 0) for s in fewer):
            drawn, made = sum(len(s.triangles) for s in fewer), sum(s.made or 0 for s in fewer)
            said.append(f"Drawn with {drawn} of {made} triangles; lengths are measured on all.")
        hidden = [d for d in self.maps.values() if len(d.cameras) < len(d.centers)]
        if hidden:
            drawn, made = sum(len(d.cameras) for d in hidden), sum(len(d.centers) for d in hidden)
            said.append(f"{drawn} of {made} cameras are drawn; the slider has all.")
        self.panel.note.content = lines(*said, *self.known.notes)
