"""Run folders: what a verb writes appears whole or not at all, and says how it was made.

Work goes to a hidden folder beside OUT, which is renamed when it is complete; run.json is written last, and lists the
files. A verb that fails leaves OUT as it was; one that can be resumed keeps its finished parts in the hidden folder.
"""

from __future__ import annotations

import stat
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any, TextIO

from lightdepth.command_line.dry import is_dry
from lightdepth.command_line.outcome import outcome
from lightdepth.command_line.warned import heard
from lightdepth.counting import counted, full_stop
from lightdepth.errors import InputError, PartialFailure
from lightdepth.files.lock import locked
from lightdepth.files.machine import machine_failure
from lightdepth.files.named_inputs import write_inputs
from lightdepth.files.replacing import (
    STATE,
    check_apart,
    check_replaceable,
    clear_notes,
    discard,
    read_record,
    real_output,
    recover,
    replace,
    stamp,
    try_place,
    unfinished_path,
)
from lightdepth.files.writing import folders_for, sync_below, usual_mode
from lightdepth.foreign_text import for_line, for_terminal
from lightdepth.reporting.names import KEPT, Names, names_of, spoken
from lightdepth.reporting.plan import Plan, Work, untouched
from lightdepth.reporting.record import write_run_json
from lightdepth.reporting.same import check_finished, check_same, compared, fingerprint, own_version
from lightdepth.reporting.same import input_hash as input_hash
from lightdepth.reporting.same import paths_in as paths_in
from lightdepth.reporting.same import plain as plain
from lightdepth.reporting.same import recorded as recorded
from lightdepth.reporting.unfinished import (
    Part,
    add_part,
    begin,
    begun_with,
    clean,
    finished_parts,
    new_files,
    put_finished,
)
from lightdepth.signals import finishing_first


class Run:
    """An output folder in the making. `folder` is where to write, `output` what it becomes; `record` is what run.json
    will say besides."""

    def __init__(
        self,
        folder: Path,
        output: Path,
        verb: str,
        arguments: Mapping[str, Any],
        parts: Mapping[str, Part] | None = None,
    ) -> None:
        self._folder, self.output = folder, output
        self.record: dict[str, Any] = {"failures": [], "warnings": []}
        self.parts = None if parts is None else dict(parts)
        self.resumed = bool(parts)
        self._told: set[str] = set()  # finished parts whose reports are in the record
        self._begun: dict[str, tuple[int, int]] = {}  # failures and warnings when a part began: parts may lie in parts
        self._verb, self._given, self._start = verb, arguments, time.monotonic()
        self._arguments = plain(arguments)
        self.keep_names = False
        self._say: Callable[[str], str] | None = None
        self._warned: list[str] = []  # as they were told
        self._named = Names()
        self.unlisted: Mapping[str, Any] = {}  # inputs that do not stand among the arguments
        self.plan: Plan | None = None  # of a dry run, which writes nothing

    @property
    def folder(self) -> Path:
        """Where to write, which a dry run has not."""
        assert self.plan is None, "a dry run writes nothing"
        return self._folder

    @property
    def resumable(self) -> bool:
        """Whether finished parts are kept when the run is stopped."""
        return self.parts is not None

    @property
    def state(self) -> Path:
        """A folder for files of parts that only a run that is resumed reads: it is gone from the finished run."""
        return self.folder / STATE

    def begins(self, what: str, work: Work) -> None:
        """All that is read was checked, and the work begins, `what` in words. A dry run ends here."""
        if self.plan is not None:
            self.plan.ends(what, work)

    def done(self, part: str) -> bool:
        """Whether a part was finished before: its files are there, and its failures and warnings are in the record
        now, where they would be had it run. Else it begins here: what is reported from now on is its own."""
        found = (self.parts or {}).get(part)
        if found is None:
            self._begun[part] = (len(self.record["failures"]), len(self.record["warnings"]))
            return False
        if part not in self._told:
            self._told.add(part)
            self.record["failures"] += found.failures
            self.record["warnings"] += found.warnings
        return True

    def finish_part(self, part: str, files: Iterable[Path] | None = None, kept: Any = None) -> None:
        """A part is whole: its files are on the disk, and a run that is resumed does not make it again.

        `files` are the part's; None: all below the folder that no part has yet, which is slow where one folder holds
        thousands. `kept` (plain values) is what `kept_of` gives back later. Does nothing where a verb cannot resume.
        """
        if self.parts is None:
            return
        if files is None:
            sizes = new_files(self.folder, (name for each in self.parts.values() for name in each.files))
        else:
            sizes = {str(file.relative_to(self.folder)): file.stat().st_size for file in files}
        failures, warned = self._begun.get(part, (0, 0))
        made = Part(part, sizes, self.record["failures"][failures:], self.record["warnings"][warned:], plain(kept))
        add_part(self.folder, made, [self.folder / name for name in sizes])
        self.parts[part] = made
        self._told.add(part)

    def kept_of(self, part: str) -> Any:
        """What `finish_part` was given to keep, as JSON reads it back."""
        return (self.parts or {})[part].kept

    def log(self, message: str) -> None:
        """Lines for log.txt, and for the user, who reads the names of options in the place of their paths."""
        self._tell(message, for_terminal)

    def _tell(self, message: str, shown: Callable[[str], str], out: TextIO | None = None) -> None:
        self._say = self._say or (str if self.keep_names else spoken(self._given))
        said = shown(self._say(message))
        print(said, file=out, flush=True)
        outcome().stage(said)
        self._note(message, shown)

    def _note(self, message: str, shown: Callable[[str], str] = for_line) -> None:
        if self.plan is not None:
            return
        with (self.folder / "log.txt").open("a", encoding="utf-8", errors="backslashreplace") as file:
            file.write(f"{time.strftime('%H:%M:%S')} {shown(message)}\n")

    def fail(self, what: str, reason: str, now: bool = True) -> None:
        """Part of the work failed; the rest goes on (exit code 4 at the end). Not `now`: the last line tells it."""
        self.record["failures"].append({"what": what, "reason": reason})
        said = f"failed: {what}: {reason}"
        self._tell(said, for_line, outcome().doubts) if now else self._note(said)

    def warn(self, message: str) -> None:
        """Something is doubtful; the work goes on. It is in the log and in run.json."""
        self.record["warnings"].append(message)
        self._tell(f"warning: {message}", for_line, outcome().doubts)
        assert self._say is not None  # _tell has made it
        self._warned.append(self._say(message))
        outcome().warned(self._warned[-1])

    def warn_once(self, message: str) -> None:
        """As warn, unless that was said before."""
        if message not in self.record["warnings"]:
            self.warn(message)

    def hash_inputs(self, **paths: Path | None) -> None:
        """Notes what files and folders are read, by name; those that are None, or not there, are left out."""
        self.record.setdefault("inputs", {}).update(self._hashed(paths))
        self._note_inputs(self.record["inputs"])

    def check_inputs(self, **paths: Path | None) -> str:
        """As hash_inputs, for a verb that does not tell the names of files: run.json says nothing of them. Returns the
        `fingerprint` of the run."""
        # By no name of an argument: the arguments of such a verb have no paths.
        found = self._hashed({f"the {name}": path for name, path in paths.items()})
        self._note_inputs(found)
        return fingerprint(self._verb, self._given, found)

    def _hashed(self, paths: Mapping[str, Path | None]) -> dict[str, dict[str, str]]:
        found: dict[str, dict[str, str]] = {}
        for name, path in paths.items() if self.plan is None else ():
            with suppress(OSError):  # whoever reads it says what is wrong with it
                if path is not None and path.exists():
                    found[name] = {"path": str(path), "sha256": input_hash(path, self.output)}
        return found

    def _note_inputs(self, inputs: Mapping[str, Any]) -> None:
        """A run that is resumed compares them."""
        if self.parts is not None and not self.resumed and self.plan is None:
            self.begin(inputs)

    def begin(self, inputs: Mapping[str, Any] | None = None) -> None:
        """Notes what the run is begun with."""
        said = {"verb": self._verb, "version": own_version(), "arguments": compared(self._arguments)}
        begin(self.folder, {**said, "inputs": inputs or {}})

    @contextmanager
    def hearing(self) -> Iterator[None]:
        """What is warned of meanwhile, by whom ever, is in log.txt and run.json too."""

        def take(said: str) -> None:
            self.record["warnings"].append(said)
            self._note(f"warning: {said}")

        with heard(take, lambda said: said in self.record["warnings"]):  # a process that was killed heard it before
            yield

    def names(self) -> Names:
        """What the inputs are called in the run's files; no names where paths are kept."""
        if self.keep_names:
            return Names()
        inputs = (self.record.get("inputs") or {}).values()
        hashed = {known["path"]: known["sha256"] for known in inputs if "path" in known}
        argv = () if "command" in self.record else sys.argv
        return names_of(self._given, (self.output, self._folder), self.unlisted, argv, hashed)

    def settle(self) -> None:
        """All files but run.json are as they stay, and on the disk."""
        import yaml

        self._named = names = self.names()
        settings = yaml.safe_dump(names.hidden(self._arguments, exactly=True), sort_keys=False)
        (self.folder / "config.yaml").write_text(settings, encoding="utf-8")
        names.hide_below(self.folder)
        if names.paths:
            write_inputs(self.folder, names.paths)
        self.folder.chmod(usual_mode(self.folder))
        sync_below(self.folder)  # run.json says that the rest is whole: it comes last

    def finish(self) -> None:
        """The run says that it is whole."""
        write_run_json(self.folder, self._verb, self._arguments, self._start, self.record, self._named)
        clear_notes(self.folder)  # not before: a run that is killed until then goes on from its finished parts


@contextmanager
def run_folder(
    output: Path,
    verb: str,
    arguments: Mapping[str, Any],
    overwrite: bool = False,
    resume: bool | None = None,
    inputs: Sequence[object] = (),
    keep_names: bool | None = None,
) -> Iterator[Run]:
    """A Run whose folder becomes `output` when the block ends well.

    `resume` None: a verb that cannot be resumed; what it wrote goes when the block fails. Else finished parts
    (`Run.finish_part`) are kept when it is killed or the machine fails, and `resume` True goes on from them. `inputs`
    are those that do not stand among the arguments, which are looked through for others. `keep_names` writes paths as
    they are; None: as the command line says. Raises InputError when `output` is in use, is or holds an input, or holds
    what is not of such a run; AlreadyFinished; MachineFailure, with what was kept.
    """
    if resume and overwrite:
        raise InputError("--resume, --overwrite", "they contradict each other", "give one of them")
    real = real_output(output)
    run = None
    try:
        with untouched(real) if is_dry() else _held(real), ExitStack() as ending:
            parts = _checked(real, verb, arguments, overwrite, resume, [*paths_in(arguments), *paths_in(inputs)])
            before = stamp(real)
            run = Run(unfinished_path(real), real, verb, arguments, None if resume is None else parts)
            run.keep_names = KEPT.get() if keep_names is None else keep_names
            run.unlisted = {"input": inputs}
            if is_dry():
                run.plan = Plan(output, len(parts))
                yield run
                raise AssertionError(f"{verb} does not say where its work begins")
            with kept_or_gone(run, real, resume is not None), run.hearing():
                _begin(run)
                yield run
                run.settle()
                received = ending.enter_context(finishing_first())  # a signal waits until the result is in its place
                run.finish()
            replace(run.folder, real, before)
            outcome().made(output, [*run.record["warnings"], *run._warned])
            received.stop(f"it was at its last step, and {real.name} is whole")
    except OSError as error:
        failure = machine_failure(error, place=real)
        if failure is not None:
            raise failure from error
        if run is not None:
            raise
        cure = f"give a folder in it: -o {output / 'run'}" if real.is_dir() else "choose another -o"
        raise InputError(output, f"cannot be made ({error.strerror})", cure) from error
    if failures := run.record["failures"]:
        first = full_stop(f"the first: {failures[0]['what']}: {failures[0]['reason']}")
        raise PartialFailure(f"{counted(len(failures), 'part')} failed, {first} The rest is in {output}")


@contextmanager
def _held(output: Path) -> Iterator[None]:
    """The folder that it is in is made, and no other run writes to it."""
    with folders_for([output]), locked(output):
        yield


def _checked(
    output: Path,
    verb: str,
    arguments: Mapping[str, Any],
    overwrite: bool,
    resume: bool | None,
    inputs: Iterable[Path],
) -> dict[str, Part]:
    """The finished parts that a run goes on from, after all that can be refused before any work."""
    if not is_dry() and recover(output):
        print(f"{output.name} was finished by an earlier run, which was killed at its last step", flush=True)
    made = unfinished_path(output)
    begun, parts = begun_with(made), finished_parts(made)
    if output.is_dir() and any(output.iterdir()):
        if resume and not is_dry() and read_record(made) is not None:
            put_finished(made, output, verb, arguments, inputs)
        if overwrite or (resume and begun is not None and parts):  # what goes on may have been begun by --overwrite
            check_apart(output, inputs)
            check_replaceable(output, verb)
        elif resume:
            check_finished(output, verb, arguments)
        else:
            choices = "give --overwrite" if resume is None else "give --resume or --overwrite"
            raise InputError(output, "already there and not empty", f"choose another -o, or {choices}")
    parts = going_on(output, verb, arguments, overwrite, bool(resume), "holds an unfinished run")
    if not is_dry():
        try_place(output)
    return parts


def going_on(
    output: Path, verb: str, arguments: Mapping[str, Any], overwrite: bool, resume: bool, found: str
) -> dict[str, Part]:
    """The finished parts that a run to `output` goes on from; what none goes on from is removed. Raises InputError,
    saying what was `found`, where nobody said what is to become of them, or they are of another run."""
    made = unfinished_path(output)
    begun, parts = begun_with(made), finished_parts(made)
    if begun is not None and parts and not overwrite:
        if not resume:
            cure = f"--overwrite starts anew, and {begun['verb']} --resume goes on"
            raise InputError(output, f"{found} of {begun['verb']}", cure)
        check_same(output, begun, verb, arguments)
        return parts
    if is_dry():
        return {}
    discard(made)
    if resume and not output.is_file():  # a file that is there may be the finished one
        print("nothing to resume: starting anew", flush=True)
    return {}


def _begin(run: Run) -> None:
    """Its folder is made, or freed of what no finished part has."""
    if run.parts:
        clean(run.folder, run.parts)
        run.log(f"resumed: {kept_parts(run.parts)}")
        return
    run.folder.mkdir(mode=0o700)
    special = stat.S_IMODE(run.folder.stat().st_mode) & ~0o777  # a folder of a group hands its group on
    run.folder.chmod(special | 0o700)  # until it is finished its files name the inputs
    run.begin()


def kept_parts(parts: Mapping[str, Part]) -> str:
    """How many finished parts of a run there are, in words."""
    return f"{counted(len(parts), 'finished part')} {'is' if len(parts) == 1 else 'are'} kept"


@contextmanager
def kept_or_gone(run: Run, output: Path, resumable: bool) -> Iterator[None]:
    """A block that fails leaves nothing, or, of a run that can be resumed, its finished parts."""
    try:
        yield
    except BaseException as error:
        kept = bool(resumable and run.parts and not isinstance(error, InputError))
        said = outcome().keeping(kept_parts(run.parts or {})) if kept else ""
        none = f"Nothing of it is kept; {output.name} is as it was" if outcome().goes_on else ""
        failure = machine_failure(error, run.folder, said or none, output)
        if not kept:
            with finishing_first():
                discard(run.folder)
        elif failure is None:
            error.add_note(said)
            if hasattr(error, "kept"):  # a signal, which is told with it
                error.kept = said
        if failure is not None:
            raise failure from error
        raise
