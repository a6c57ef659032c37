"""One unit, made: a run folder, or a record of why there is none. What goes wrong with one stops no other."""

from __future__ import annotations

import gc
import json
import traceback
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from densify.batch.units import Unit
from densify.dense_run import dense_run, unheard
from lightdepth.checkpoint import ModelSource
from lightdepth.command_line.warned import warnings_as_sentences
from lightdepth.errors import AlreadyFinished, InputError, InUse, PartialFailure
from lightdepth.files.lock import is_live, lock_path
from lightdepth.files.machine import machine_failure
from lightdepth.files.replacing import read_record
from lightdepth.files.writing import write_whole
from lightdepth.models import DepthModel
from lightdepth.reporting.names import Names

SEQUENCES, FAILED = "sequences", "failed"
"""Folders of an output: the run of each unit, and a record of each that failed."""
GOES_ON = "the same command goes on"
TRIES = 2
"""How often a unit is tried where something other than its input is at fault."""

State = Literal["done", "in part", "failed", "elsewhere"]


@dataclass(frozen=True)
class Ended:
    """What came of a unit."""

    state: State
    """elsewhere: another run is at it."""
    error: str = ""


@dataclass(frozen=True)
class Maker:
    """What a process needs to make units; started, it has the checkpoint, which serves for all that it makes."""

    predicting: ModelSource
    output: Path
    keep_names: bool

    def __call__(self) -> Callable[[Unit], Ended]:
        model = self.predicting.load(details=False)
        return lambda unit: self.make(unit, model)

    def make(self, unit: Unit, model: DepthModel) -> Ended:
        """Makes a unit, and notes it where it failed."""
        with unheard(["lightdepth", "batch"], GOES_ON, self.keep_names), warnings_as_sentences():
            return self._made(unit, model)

    def _made(self, unit: Unit, model: DepthModel) -> Ended:
        place = self.output / SEQUENCES / unit.name
        if unit.trouble:
            return self.failed(unit, unit.trouble, 1)
        for tries in range(1, TRIES + 1):
            try:
                dense_run(unit.asked, model, place, resume=True)
            except (AlreadyFinished, PartialFailure):
                break
            except InUse as error:
                return Ended("elsewhere", str(error))
            except InputError as error:
                return self.failed(unit, str(error), 1)
            except Exception as error:  # whatever it is, the next sequence may well go through
                failure = machine_failure(error)
                if tries == TRIES:
                    trace = "" if failure is not None else traceback.format_exc()
                    said = f"{type(error).__name__}: {error}" if failure is None else str(failure)
                    return self.failed(unit, said, tries, trace)
            else:
                break
            finally:
                gc.collect()  # one sequence at a time is all that there is room for
        return ended_before(unit, self.output) or Ended("failed", "its run.json cannot be read")

    def failed(self, unit: Unit, error: str, tries: int, trace: str = "") -> Ended:
        """Notes that a unit failed; without paths, unless they are wanted."""
        names = Names() if self.keep_names else Names(unit.paths, (self.output,))
        record = {"error": names.text(error), "tries": tries, "trace": names.text(trace).splitlines()}
        write_whole(_note_of(unit, self.output), json.dumps(record, indent=1) + "\n")
        return Ended("failed", error)


def ended_before(unit: Unit, output: Path) -> Ended | None:
    """What is known of a unit from the files of whoever made it; None where nobody has."""
    record = read_record(output / SEQUENCES / unit.name)
    if record is not None and record["verb"] == "densify":
        _note_of(unit, output).unlink(missing_ok=True)  # it failed before
        listed = record.get("failures")
        failures = [each for each in listed if isinstance(each, dict)] if isinstance(listed, list) else []
        if not failures:
            return Ended("done")
        return Ended("in part", "; ".join(f"{each.get('what')}: {each.get('reason')}" for each in failures))
    try:
        note = json.loads(_note_of(unit, output).read_text(encoding="utf-8"))
        return Ended("failed", str(note["error"]))
    except (OSError, ValueError, KeyError, TypeError):
        return None


def clear_locks(units: Iterable[Unit], output: Path) -> None:
    """Removes what the killed left of the locks of units that are done: nobody takes these again."""
    for unit in units:
        place = output / SEQUENCES / unit.name
        if not is_live(place):
            lock_path(place).unlink(missing_ok=True)


def _note_of(unit: Unit, output: Path) -> Path:
    return output / FAILED / f"{unit.name}.json"
