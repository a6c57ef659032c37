"""The verb view: a run in a browser, or as a recording."""

from __future__ import annotations

from pathlib import Path
from shlex import quote
from typing import Annotated

from densify.scene import TRIANGLES
from lightdepth.command_line.following import PLACES, Input, command
from lightdepth.command_line.outcome import end, outcome
from lightdepth.errors import InputError
from lightdepth.files.replacing import check_rewritable
from lightdepth.files.writing import write_whole
from lightdepth.ranges import above, at_least
from lightdepth.signals import finishing_first


def view(
    run: Path,
    host: str = "127.0.0.1",
    port: Annotated[int, at_least(0, up_to=65535)] = 8080,
    data: Path | None = None,
    mm_per_unit: Annotated[float | None, above(0)] = None,
    triangles: Annotated[int, at_least(100)] = TRIANGLES,
    rerun: Path | None = None,
    overwrite: bool = False,
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
        triangles: Largest number of triangles drawn of each surface; lengths are measured on all that there are. More
            show finer detail and take a browser longer.
        rerun: File, ending in .rrd, to write as a recording for the Rerun viewer (extra `rerun`), with the images,
            instead of opening a page. Left out, none is written.
        overwrite: Replace a recording made before. Without it, one that is already there is refused.
    """
    if rerun is not None:
        _record(run, data, mm_per_unit, triangles, rerun, overwrite)
        return
    if overwrite:
        raise InputError(
            "--overwrite", "given without --rerun: nothing is written", "add --rerun FILE, or leave it out"
        )
    try:
        from densify.viewing.work import Viewing
    except ModuleNotFoundError as error:
        raise InputError("view", f"{error.name} is not installed", "pip install 'lightdepth[view]'") from error
    viewing = Viewing.of(run, data, mm_per_unit, triangles)
    with finishing_first() as received:
        viewing.serve(host, port, received)
        unit = {} if mm_per_unit is None else {"--mm-per-unit": f"{mm_per_unit:g}"}
        then = command("measure", Input("RUN", run), options={**unit, "--points": PLACES, "-o": "lengths.json"})
        end(then=then, result=viewing.result)
        received.stop("nothing was written")


def _record(
    run: Path, data: Path | None, mm_per_unit: float | None, triangles: int, output: Path, overwrite: bool
) -> None:
    """Writes a recording of the maps that there are now."""
    if output.suffix != ".rrd":
        raise InputError("--rerun", f"{output} does not end in .rrd", "the Rerun viewer opens no other files")
    try:
        from densify.viewing.recording import BEGINNING, recorded
    except ModuleNotFoundError as error:
        raise InputError("--rerun", f"{error.name} is not installed", "pip install 'lightdepth[rerun]'") from error
    from densify.viewing.known import known_of
    from densify.viewing.watched import WatchedRun

    check_rewritable(output, BEGINNING, [run, data])
    if output.exists() and not overwrite:
        raise InputError(output, "already there", "choose another name, or give --overwrite")
    watched = WatchedRun(run, triangles)
    if not (maps := watched.first()):
        raise InputError(run, "no surface yet", "begin again when the run has finished its first map")
    known = known_of(watched, data, mm_per_unit)
    write_whole(output, recorded(maps, known))
    for note in known.notes:
        outcome().last(note)
    result = {"recording": str(output), "maps": [each.name for each in maps], "unit": known.unit}
    end(output, then=f"rerun {quote(str(output))}", result=result)
