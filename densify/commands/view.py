"""The verb view: a run in a browser."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from densify.scene import TRIANGLES
from lightdepth.command_line.outcome import end
from lightdepth.errors import InputError
from lightdepth.ranges import above, at_least
from lightdepth.signals import finishing_first


def view(
    run: Path,
    host: str = "127.0.0.1",
    port: Annotated[int, at_least(0, up_to=65535)] = 8080,
    data: Path | None = None,
    mm_per_unit: Annotated[float | None, above(0)] = None,
    triangles: Annotated[int, at_least(100)] = TRIANGLES,
) -> None:
    """A run in a browser: surfaces, points, cameras with their pictures, lengths between two clicks.

    Args:
        run: Run folder made by `lightdepth densify`, `live` or `demo`, also one that is still at work, or one of its
            map folders.
        host: Address of this machine to listen at. Only this machine's own programs reach 127.0.0.1; at 0.0.0.0,
            everyone on the network sees the images.
        port: Number of the port to listen at; 0 takes any that is free. Another one lets a second viewer run beside.
        data: Frames of the run, for the pictures of its keyframes; left out, those that the run names, where they still
            are.
        mm_per_unit: Millimetres that a unit of the surface stands for, where the run did not know it; lengths are then
            in mm. A larger one makes them longer in proportion. It is refused where the surface is in mm already.
        triangles: Number of triangles that are drawn of each surface at most; lengths are measured on all that there
            are. More show finer detail and take a browser longer.
    """
    try:
        from densify.viewing.work import Viewing
    except ModuleNotFoundError as error:
        raise InputError("view", f"{error.name} is not installed", "pip install 'lightdepth[view]'") from error
    viewing = Viewing.of(run, data, mm_per_unit, triangles)
    with finishing_first() as received:
        viewing.serve(host, port, received)
        end(then="lightdepth measure RUN --points '[[X, Y, Z], [X, Y, Z]]' -o lengths.json", result=viewing.result)
        received.stop("nothing was written")
