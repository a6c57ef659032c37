"""Which sequences train, validate and test: one YAML file, by sequence or by patient, never by frame.

    dataset: c3vd                   # the folder in data/ whose dataset.yaml lists the sequences; may be left out
    unit: sequence                  # or patient: then none may be in two parts either, and `patients` says who is who
    patients: {trans: trans_*}      # names with * by patient
    parts:
      train: [cecum_t1_b, "desc_t4_a[0:74]"]        # folders below the data's root; [a:b] are frames a to b - 1
      val: [...]
      test: ["desc_t4_a[74:148]", ...]
    leaks: {desc_t4_a: why a sequence in two parts is borne}
    excluded: {dataset_4: why a sequence is in none}

Frame ranges are there for published splits that cut a sequence in two. Such a sequence has to be named under `leaks`,
whose reason is said in a warning wherever the split is used: frames next to each other are as good as the same.

A sequence is the same under other names: in upper or lower case, with `_under_review` behind it, or as C3VDv2 calls
those of the first edition (`c0_cecum_t1_v1` is `cecum_t1_a`); and so is the same folder by another way.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from lightdepth.datasets.catalogue import DatasetInfo, SequenceName, inside, read_dataset_yaml, read_yaml
from lightdepth.errors import InputError
from lightdepth.files.below import folders_in

PARTS = ("train", "val", "test")
_RANGE = re.compile(r"(.+?)\s*\[\s*(\d+)\s*:\s*(\d+)\s*\]")
_SEGMENTS = {"descending": "desc", "transverse": "trans"}


class _Parts(BaseModel):
    model_config = ConfigDict(extra="forbid")
    train: list[str] | None = None
    val: list[str] | None = None
    test: list[str] | None = None


class _SplitFile(BaseModel):
    model_config = ConfigDict(extra="forbid")
    dataset: Annotated[str, Field(pattern=r"^[\w.-]+$")] | None = None
    unit: Literal["sequence", "patient"] = "sequence"
    patients: dict[str, str | list[str]] = {}
    parts: _Parts
    leaks: dict[SequenceName, Annotated[str, Field(min_length=1)]] = {}
    excluded: dict[SequenceName, Annotated[str, Field(min_length=1)]] = {}


@dataclass(frozen=True)
class Chosen:
    """A sequence of a part: its name below the data's root, and the frames a to b - 1 where not all of them."""

    name: str
    frames: tuple[int, int] | None = None

    def __str__(self) -> str:
        return self.name if self.frames is None else f"{self.name}[{self.frames[0]}:{self.frames[1]}]"

    def takes(self, number: int) -> bool:
        return self.frames is None or self.frames[0] <= number < self.frames[1]


@dataclass(frozen=True)
class Split:
    """Sequences by part; `leaks` says for those in two parts why; `info` is the data set's, where there is one."""

    path: Path
    parts: Mapping[str, tuple[Chosen, ...]]
    leaks: Mapping[str, str]
    info: DatasetInfo | None = None

    def frame_count(self, name: str) -> int | None:
        """Frames that the sequence has in the data set, where that is known."""
        known = {} if self.info is None else {same_sequence(n): count for n, count in self.info.sequences.items()}
        return known.get(same_sequence(name))


def read_split(path: Path) -> Split:
    """The split in a file. Raises InputError for what is in two parts, leads outside, is unknown or empty; warns of
    what leaks."""
    path = Path(path)
    found = read_yaml(path, _SplitFile)
    parts = {
        part: tuple(_chosen(entry, f"{path}: {part}") for entry in entries)
        for part in PARTS
        if (entries := getattr(found.parts, part)) is not None
    }
    if not parts:
        raise InputError(path, "no parts in it", f"expected {', '.join(PARTS)}, at least one of them")
    for part, chosen in parts.items():
        if not chosen:
            raise InputError(path, f"{part} is empty", "name its sequences, or leave it out")
    info = _info(path, found.dataset)
    if info is not None:
        _check_known(path, [c.name for chosen in parts.values() for c in chosen] + list(found.leaks), info)
    _check_overlap(path, parts, found.leaks)
    _check_excluded(path, parts, found.excluded)
    if found.unit == "patient":
        _check_patients(path, parts, found.patients)
    elif found.patients:
        raise InputError(path, "patients, but unit is sequence", "expected unit: patient, or no patients")
    for name, why in found.leaks.items():
        warnings.warn(f"{path}: {name} leaks: {why}", stacklevel=2)
    return Split(path, parts, found.leaks, info)


def folders(split: Split, root: Path, parts: Iterable[str]) -> dict[str, list[tuple[Path, Chosen]]]:
    """The folders of the parts asked for, below `root`, by part. A sequence is found under its other names too.

    Raises InputError listing all that are not there, and where two sequences are one folder (by a link).
    """
    root = Path(root)
    if not root.is_dir():
        raise InputError(root, "no such folder", f"expected the one that holds the sequences of {split.path}")
    found = {part: [(located(root, c.name), c) for c in chosen] for part, chosen in split.parts.items()}
    asked = [part for part in parts if part in found]
    missing = [c.name for part in asked for folder, c in found[part] if folder is None]
    if missing:
        raise InputError(
            root,
            f"{len(missing)} of the sequences of {split.path} are not there: {', '.join(missing)}",
            "download them, or correct --data.root",
        )
    _check_same_folder(split, found)
    return {part: [(folder, c) for folder, c in found[part] if folder is not None] for part in asked}


def check_apart(train: Iterable[str | Path], val: Iterable[str | Path]) -> None:
    """Raises InputError when a folder to validate on is one to train on, lies in one, or holds one."""
    for a in train:
        for b in val:
            one, other = Path(a).resolve(), Path(b).resolve()
            if one == other or one in other.parents or other in one.parents:
                raise InputError(
                    b,
                    f"is validated on, but also trained on{'' if str(a) == str(b) else f' (as {a})'}",
                    "give other sequences: a validation on frames of the training says nothing",
                )


def _chosen(entry: str, where: str) -> Chosen:
    match = _RANGE.fullmatch(entry.strip())
    name, frames = entry.strip(), None
    if match:
        name, frames = match[1], (int(match[2]), int(match[3]))
        if frames[0] >= frames[1]:
            raise InputError(f"{where}: {entry}", f"no frames in [{match[2]}:{match[3]}]", "expected [first:last + 1]")
    try:
        return Chosen(inside(name), frames)
    except InputError as error:
        raise error.within(where) from error


def same_sequence(name: str) -> str:
    """What a sequence's other names have in common."""
    *above, last = name.lower().split("/")
    last = last.removesuffix("_under_review")
    match = re.fullmatch(r"c0_([a-z]+)_t(\d)_v([1-9])", last)
    if match:  # C3VDv2's name of a sequence of the first edition
        segment = _SEGMENTS.get(match[1], match[1])
        last = (
            f"screening_t{match[2]}" if segment == "full" else f"{segment}_t{match[2]}_{'abcdefghi'[int(match[3]) - 1]}"
        )
    return "/".join([*above, last])


def _info(path: Path, dataset: str | None) -> DatasetInfo | None:
    """dataset.yaml of a split that lies in <dataset>/splits/."""
    if dataset is None:
        return None
    file = path.resolve().parent.parent / "dataset.yaml"
    if path.resolve().parent.parent.name != dataset or not file.is_file():
        return None
    return read_dataset_yaml(file)


def _check_known(path: Path, names: list[str], info: DatasetInfo) -> None:
    if not info.sequences:
        return
    known = {same_sequence(name) for name in info.sequences}
    strange = [name for name in names if same_sequence(name) not in known]
    if strange:
        import difflib

        close = difflib.get_close_matches(strange[0], info.sequences, 1)
        hint = f"is {close[0]} meant?" if close else f"it has {', '.join(list(info.sequences)[:6])}, ..."
        raise InputError(path, f"{info.name} has no sequence {', '.join(strange)}", hint)


def _check_overlap(path: Path, parts: Mapping[str, tuple[Chosen, ...]], leaks: Mapping[str, str]) -> None:
    """No sequence twice; in two parts only where `leaks` says so, and then with no frame in both."""
    allowed = {same_sequence(name) for name in leaks}
    before: dict[str, list[tuple[str, Chosen]]] = {}
    for part, chosen in parts.items():
        for c in chosen:
            key = same_sequence(c.name)
            for other_part, other in before.setdefault(key, []):
                also = "" if other.name == c.name else f", which is {other.name},"
                if other_part == part:
                    raise InputError(path, f"{part} has {c}{also} twice", "remove one of the two")
                found = f"{c} of {part}{also} is in {other_part} too"
                if key not in allowed:
                    raise InputError(
                        path,
                        found,
                        "a sequence belongs to one part. A published split that cuts it in two says so under leaks",
                    )
                if c.frames is None or other.frames is None or _meet(c.frames, other.frames):
                    raise InputError(path, f"{found} ({other}), with frames in both", "give ranges that do not overlap")
            before[key].append((part, c))
    pointless = [name for name in leaks if len(before.get(same_sequence(name), [])) < 2]
    if pointless:
        raise InputError(path, f"leaks: {pointless[0]} is not in two parts", "leave it out")


def _meet(a: tuple[int, int], b: tuple[int, int]) -> bool:
    return a[0] < b[1] and b[0] < a[1]


def _check_excluded(path: Path, parts: Mapping[str, tuple[Chosen, ...]], excluded: Mapping[str, str]) -> None:
    for part, chosen in parts.items():
        for c in chosen:
            for name, why in excluded.items():
                if f"{same_sequence(c.name)}/".startswith(f"{same_sequence(name)}/"):
                    raise InputError(path, f"{c.name} is in {part}, but excluded ({why})", "leave it out of one")


def _check_patients(
    path: Path, parts: Mapping[str, tuple[Chosen, ...]], patients: Mapping[str, str | list[str]]
) -> None:
    seen: dict[str, tuple[str, Chosen]] = {}
    for part, chosen in parts.items():
        for c in chosen:
            key = same_sequence(c.name)
            of = [who for who, names in patients.items() if _matches(key, names)]
            if len(of) != 1:
                found = f"patients {' and '.join(of)}" if of else "no patient"
                raise InputError(path, f"{c.name} has {found}", "expected one, under patients")
            other_part, other = seen.setdefault(of[0], (part, c))
            if other_part != part:
                raise InputError(
                    path,
                    f"{c.name} of {part} and {other.name} of {other_part} are of the same patient, {of[0]}",
                    "a patient belongs to one part",
                )


def _matches(key: str, names: str | list[str]) -> bool:
    return any(fnmatchcase(key, name.lower()) for name in ([names] if isinstance(names, str) else names))


def located(root: Path, name: str) -> Path | None:
    """The folder of this name, or the one below the same folder whose name means the same sequence.

    Raises InputError where a link leads out of `root`: a file that names what is read names nothing else."""
    found = _located(root, name)
    if found is not None and not found.resolve().is_relative_to(root.resolve()):
        raise InputError(
            found,
            f"is a link that leads out of {root}, to {found.resolve()}",
            "put the folder itself there",
        )
    return found


def _located(root: Path, name: str) -> Path | None:
    if (root / name).is_dir():
        return root / name
    above = (root / name).parent
    key = same_sequence(name)
    siblings = folders_in(above) if above.is_dir() else []
    same = [p for p in siblings if same_sequence(f"{name.rpartition('/')[0]}/{p.name}".lstrip("/")) == key]
    if len(same) > 1:
        raise InputError(above, f"{' and '.join(p.name for p in same)} are both {name}", "keep one")
    return same[0] if same else None


def _check_same_folder(split: Split, found: Mapping[str, list[tuple[Path | None, Chosen]]]) -> None:
    """Names that lead to one folder, by a link, are one sequence."""
    before: dict[Path, tuple[str, Chosen]] = {}
    for part, located in found.items():
        for folder, c in located:
            if folder is None:
                continue
            other_part, other = before.setdefault(folder.resolve(), (part, c))
            if same_sequence(other.name) != same_sequence(c.name):
                raise InputError(
                    folder,
                    f"{c.name} of {part} is the same folder as {other.name} of {other_part} in {split.path}",
                    "a sequence belongs to one part",
                )
