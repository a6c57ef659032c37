"""A viewer at work: a run is read, served, and followed until a signal ends it."""

from __future__ import annotations

import time
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from densify.viewing.known import Known, known_of
from densify.viewing.local_server import Listening, local_server
from densify.viewing.ruler import Ruler
from densify.viewing.viewer import Viewer
from densify.viewing.watched import ViewedMap, WatchedRun
from lightdepth.command_line.heartbeat import at_work
from lightdepth.command_line.outcome import Outcome, outcome
from lightdepth.errors import InputError
from lightdepth.signals import Received

POLL_S = 1.0
"""Seconds between two looks at the run's files."""


@dataclass(frozen=True)
class Viewing:
    """A run that is to be shown, as it was when it was first read."""

    watched: WatchedRun
    maps: tuple[ViewedMap, ...]
    known: Known
    data: Path | None = None
    mm_per_unit: float | None = None
    result: dict[str, object] = field(default_factory=dict)
    """where it was to be seen, its maps, and what was measured, as `lightdepth measure` records it"""

    @classmethod
    def of(cls, run: Path, data: Path | None, mm_per_unit: float | None, triangles: int) -> Viewing:
        """Raises InputError where there is nothing to show."""
        if data is not None and not data.exists():
            raise InputError(data, "no such file or folder", "give the frames that the run was made of")
        watched = WatchedRun(run, triangles)
        maps = tuple(watched.first())
        known = known_of(watched, data, mm_per_unit)
        return cls(watched, maps, known, data, mm_per_unit, {"maps": [m.name for m in maps], "lengths": []})

    def serve(self, host: str, port: int, received: Received) -> None:
        """Until a signal is received. Raises InputError and MachineFailure as `local_server` does."""
        with local_server(host, port) as here, at_work(lambda now: ""):
            viewer = Viewer(here.server, self.known, Ruler(self.mm_per_unit or 1.0), partial(self._measured, outcome()))
            viewer.put(self.maps)
            self._ready(here)
            try:
                while not received.signal:
                    time.sleep(POLL_S)
                    self.follow(viewer)
            finally:
                viewer.close()

    def follow(self, viewer: Viewer) -> None:
        """Brings a viewer to what the run's files are now. A run that took the place of the one that was shown may have
        another unit and other frames. Raises InputError where it cannot be shown as it was asked for."""
        found, gone = self.watched.changed()
        known, state = viewer.known, self.watched.state
        if state == "gone":
            known = replace(known, state=state)
        elif found or gone or state != known.state:
            known = known_of(self.watched, self.data, self.mm_per_unit)
        if found or gone:
            viewer.put(found, gone)
        if known != viewer.known:
            viewer.tell(known)

    def _ready(self, here: Listening) -> None:
        call = outcome()
        self.result.update(url=here.url, port=here.port)
        if not here.is_local:
            warnings.warn(f"anyone on the network can see the images at {here.url}", stacklevel=2)
        call.last(f"open {here.url}")
        if here.is_local:
            there = here.host if here.host.startswith("127.") and here.host != "127.0.0.1" else "localhost"
            tunnel = f"ssh -L {here.port}:{there}:{here.port} HOST"
            call.last(f"from another machine: {tunnel}, then open http://localhost:{here.port} there")
        print("Ctrl-C ends it.", flush=True)

    def _measured(self, call: Outcome, record: Mapping[str, Any], words: str) -> None:
        """On a thread of the server, which does not know of which call it is."""
        lengths = self.result["lengths"]
        assert isinstance(lengths, list)
        lengths.append(dict(record))
        call.last(words)
