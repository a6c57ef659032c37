"""Inputs by names that tell nobody: `data-3f9a1c2b`, the option and eight digits of the contents' SHA-256.

Paths are often names of patients. What a run writes calls its inputs so; the paths stand in inputs.json alone
(`files/named_inputs.py`), unless `--keep-names` was given.
"""

from __future__ import annotations

import html
import json
import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextvars import ContextVar
from dataclasses import dataclass, field, is_dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import Any

from lightdepth.command_line.config_words import configs
from lightdepth.files.named_inputs import INPUTS, real_inputs
from lightdepth.files.replacing import BEGUN, PARTS, STATE
from lightdepth.files.writing import PARTIAL
from lightdepth.foreign_text import for_line, for_terminal
from lightdepth.reporting.same import input_hash

OUTPUT = "OUT"
"""What the run's own folder is called in its files, as in the documents."""

KEPT: ContextVar[bool] = ContextVar("kept", default=False)
"""Whether `--keep-names` was given. How a run is written is the command line's matter, not the verbs'."""

TEXTS = (".json", ".md", ".html", ".txt", ".csv", ".yaml", ".tum", ".xml", ".tex")
"""Endings of files that are looked through for paths."""

_ALSO_TEXT = ("checkpoint", "checkpoints", "light", "poses", "what", "start", "sequences", "val_sequences")
"""Options of type text that may name a file in the working folder, without a slash."""

_CHOICES = ("format", "to", "output", "overwrite", "resume", "keep_names")
"""Options whose words are no paths, whatever files are called."""

_USUAL = re.compile(r"lightdepth.*|c3vd\w*|simcol\w*|map_\d+|joined_\d+|seed_\d+|model\.\w+", re.IGNORECASE)
"""Names of files and folders that this program, or a data set, gives."""


@dataclass(frozen=True)
class Names:
    """What the inputs of a run are called. `paths` has the path of each as it was given, by its name."""

    paths: dict[str, str] = field(default_factory=dict)
    output: tuple[Path, ...] = ()
    """the run's folder, and where it is made"""
    unlisted: dict[str, str] = field(default_factory=dict)
    """more of the kind of `paths`, which no inputs.json is to have"""

    def __getstate__(self) -> dict[str, Any]:
        """Without what is made when it is first asked for: processes that load data are given a copy."""
        return {key: value for key, value in vars(self).items() if key in ("paths", "output", "unlisted")}

    def hidden(self, value: Any, exactly: bool = False) -> Any:
        """A plain value with names in the place of paths, also in the keys of mappings. `exactly`: of arguments, a
        text that is one of the paths, and no more than a single word, is one too."""
        if isinstance(value, Mapping):
            return {
                self._of_paths(str(key)): each if exactly and key in _CHOICES[:2] else self.hidden(each, exactly)
                for key, each in value.items()
            }
        if isinstance(value, list | tuple):
            return [self.hidden(each, exactly) for each in value]
        if not isinstance(value, str):
            return value
        if exactly and (name := self._forms.get(os.path.normpath(value)) if value else None) is not None:
            return name
        return self.text(value)

    def text(self, text: str) -> str:
        """A text with names in the place of paths and of words in them that tell."""
        return self._words(self._of_paths(text))

    def of(self, path: str) -> str:
        """The name of a path; itself where it has none."""
        return str(self.hidden(path, exactly=True))

    def command(self, words: Iterable[str]) -> list[str]:
        """The words of a command line, an option's value after a sign of equality too."""
        found = []
        for word in words:
            option, sign, value = word.partition("=") if word.startswith("--") else ("", "", word)
            parts = re.split(r"([\[\], \"']+)", value)
            found.append(f"{option}{sign}{self.text(''.join(self.hidden(part, True) for part in parts))}")
        return found

    def hide_below(self, folder: Path) -> None:
        """Puts names in the place of paths in the texts of a run folder in the making."""
        if not self._forms:
            return
        for place, folders, files in os.walk(folder):
            folders[:] = [name for name in folders if name != STATE]
            for name in files:
                path = Path(place) / name
                if path.suffix.lower() in TEXTS and name not in (INPUTS, BEGUN, PARTS) and not path.is_symlink():
                    self._hide_in(path)

    def _hide_in(self, path: Path) -> None:
        """Some lines at a time: the points of a sparse map may be a file of hundreds of megabytes."""
        made, changed = path.with_name(f"{PARTIAL}{path.name}"[:250]), False
        with path.open("rb") as old, made.open("wb") as new:
            page = path.suffix == ".html"  # one that is parted by lines may be parted within its program
            while lines := old.read() if page else b"".join(old.readlines(1 << 24)):
                before = lines.decode("utf-8", "surrogateescape")
                after = self._page(before) if page else self.text(before)
                changed |= after != before
                new.write(after.encode("utf-8", "surrogateescape"))
        if changed:
            os.replace(made, path)
        else:
            made.unlink()

    def _page(self, text: str) -> str:
        """As `text`, but for the style and the program of a page: they hold no name, and a word changed breaks them."""
        parts = re.split(r"(<style>.*?</style>|<script>.*?</script>)", text, flags=re.DOTALL)
        return "".join(part if i % 2 else self.text(part) for i, part in enumerate(parts))

    @cached_property
    def _forms(self) -> dict[str, str]:
        """The name for each way to write a path of an input or of the output, and of the folders above it."""
        forms: dict[str, str] = {}
        pairs = [(path, name) for name, path in (self.paths | self.unlisted).items()]
        pairs += [(str(path), OUTPUT) for path in self.output]
        for path, name in pairs:
            forms.setdefault(os.path.normpath(path), name)
            for whole in _whole(path):
                forms.setdefault(str(whole), name)
        for path, name in pairs:
            for whole in _whole(path):
                for up, parent in enumerate(whole.parents, 1):
                    if len(parent.parts) > 2 or tells(parent.name):
                        forms.setdefault(str(parent), name + "/.." * up)
        return forms

    @cached_property
    def _of_paths(self) -> Callable[[str], str]:
        """Replaces paths; those of a single word are left to arguments, where it is known that a path is meant."""
        several = {form: name for form, name in self._forms.items() if len(Path(form).parts) > 1 and form != os.sep}
        return _replacing(several, before=r"[\w.-]", relative=r"[\w/.-]", after=r"(?![\w-])")

    @cached_property
    def _words(self) -> Callable[[str], str]:
        """Replaces what tells of the parts of the inputs' paths, where it stands alone; but no keys of JSON."""
        words: dict[str, str] = {}
        for name, path in (self.paths | self.unlisted).items():
            for whole in (Path(path), *_whole(path)):
                for up, part in enumerate(reversed(whole.parts)):
                    for word in (part, Path(part).stem) if up == 0 else (part,):
                        if tells(word):
                            words.setdefault(word, name + "/.." * up)
        return _replacing(words, before=r"[\w-]", relative=r"[\w-]", after=r'(?![\w-])(?!"\s*:)')


def tells(word: str) -> bool:
    """Whether a part of a path may stand for somebody: it is no number, and no word that this program uses itself."""
    if len(word) < 3 or not any(letter.isalpha() for letter in word) or _USUAL.fullmatch(word):
        return False
    if re.fullmatch(r"[a-z.]+", word):  # a report would be spoilt by a name in the place of each of its "data"
        return any(len(part) > 3 and part not in _own_words() for part in word.split("."))
    return not re.fullmatch(r"[\d.]+e\d+", word)


@cache
def _own_words() -> frozenset[str]:
    """Words of lower-case letters in this program's sources, of which its reports are made."""
    home, words = Path(__file__).resolve().parents[2], set[str]()
    for package in ("lightdepth", "densify", "train"):
        for path in (*(home / package).rglob("*.py"), *(home / package / "weights").glob("*.md")):
            words |= set(re.findall(r"[a-z]{4,}", path.read_text(encoding="utf-8", errors="replace")))
    return frozenset(words)


def names_of(
    arguments: Mapping[str, Any],
    output: Sequence[Path] = (),
    unlisted: Mapping[str, Any] | None = None,
    argv: Iterable[str] = (),
    hashed: Mapping[str, str] | None = None,
) -> Names:
    """Names for all files and folders that stand among arguments, in `unlisted`, or after `--config` in `argv`, by the
    names of their options; two of the same contents are told apart by a number. `output` is the run's folder, then
    where it is made; `hashed` are SHA-256 that are known, by path."""
    names: dict[str, str] = {}
    known = {os.path.realpath(folder) for folder in output}
    listed = [*_inputs(arguments), *_config_files(argv)]
    for option, path in [*listed, *_inputs(unlisted or {})]:
        if os.path.realpath(path) in known:
            continue
        known.add(os.path.realpath(path))
        digits = (hashed or {}).get(path, "")[:8] or _digits(Path(path), output[0] if output else None)
        name = spare = f"{option.replace('_', '-').lower()}-{digits}"
        number = 1
        while name in names:
            number += 1
            name = f"{spare}-{number}"
        names[name] = path
    others = {name: path for name, path in names.items() if path not in {each for _, each in listed}}
    for path in names.values():  # a run that is read, and says what it was made of
        for folder in (Path(path), Path(path).parent):
            others = {name: each for name, each in real_inputs(folder).items() if name not in names} | others
    return Names({name: path for name, path in names.items() if name not in others}, tuple(output), others)


def told(text: str, **inputs: object) -> str:
    """A sentence as a report has it, of a verb that makes no run folder: without the paths of its inputs, unless
    `--keep-names` was given."""
    return text if KEPT.get() else names_of(inputs).text(text)


def spoken(arguments: Mapping[str, Any]) -> Callable[[str], str]:
    """A function from a text to what a terminal is told: names of options where their paths stand, as nothing is hashed
    for that, unless `--keep-names` was given; but the output as it was typed."""
    if KEPT.get():
        return lambda text: text
    names = Names({option.replace("_", "-"): path for option, path in reversed([*_inputs(arguments)])})
    output = str(arguments.get("output") or "")

    def said(text: str) -> str:
        return output.join(map(names.text, text.split(output))) if output else names.text(text)

    return said


def _inputs(value: Any, option: str = "input") -> Iterator[tuple[str, str]]:
    """What exists among arguments, with the option that names it."""
    if isinstance(value, Path):
        yield from [(option, str(value))] if _is_there(str(value)) else []
    elif isinstance(value, str):
        if (os.sep in value or option in _ALSO_TEXT) and _is_there(value):
            yield option, value
    elif is_dataclass(value) and not isinstance(value, type):
        yield from _inputs(vars(value), option)
    elif isinstance(value, Mapping):
        for key, each in value.items():
            name = str(key).rpartition(".")[2]
            if name not in _CHOICES:
                yield from _inputs(each, name if re.fullmatch(r"[A-Za-z][\w-]*", name) else option)
    elif isinstance(value, list | tuple | set | frozenset):
        for each in value:
            yield from _inputs(each, option)


def _config_files(words: Iterable[str]) -> Iterator[tuple[str, str]]:
    for path in configs(list(words)):
        if path and "\n" not in path and _is_there(path):
            yield "config", path


def _is_there(path: str) -> bool:
    """Whether it is a file or folder of the user's; configs/ are settings that come with the program."""
    try:
        return path not in ("", os.sep) and Path(path).parts[:1] != ("configs",) and Path(path).exists()
    except (OSError, ValueError):  # a text that is no path
        return False


def _digits(path: Path, without: Path | None) -> str:
    if not (path.is_file() or path.is_dir()):
        return "0" * 8  # a pipe or a device has no contents that stay
    try:
        return input_hash(path, without)[:8]
    except OSError:
        return "0" * 8


def _whole(path: str) -> tuple[Path, ...]:
    """The path from the root, as it was given and with links followed."""
    return tuple(dict.fromkeys((Path(os.path.abspath(path)), Path(os.path.realpath(path)))))


def _replacing(forms: Mapping[str, str], before: str, relative: str, after: str) -> Callable[[str], str]:
    """A function that replaces texts, the longest first, also as HTML, JSON, YAML and LaTeX spell them; not where a
    letter of `before` stands before them, or of `relative` before those that do not begin at the root."""
    spelled: dict[str, str] = {}
    for form, name in forms.items():
        in_json = json.dumps(form)[1:-1]
        in_yaml = re.sub(r"\\u00([0-9a-f]{2})", lambda found: rf"\x{found[1].upper()}", in_json)
        shown = form.encode("utf-8", "backslashreplace").decode()
        said = for_terminal(form), for_line(form)
        in_html = (html.escape(each) for each in (form, shown, *said))
        for text in (form, *in_html, in_json, in_yaml, shown, *said, form.replace("_", r"\_")):
            spelled.setdefault(text, name)
    if not spelled:
        return lambda text: text
    ways = []  # what may not stand before is asked last: a pattern that begins with letters is found much faster
    for text in sorted(spelled, key=lambda text: (-len(text), text)):
        word, unlike = re.escape(text), before if text.startswith(os.sep) else relative
        ways.append(f"{word}(?<!{unlike}{word})")
    pattern, hints = re.compile(f"(?:{'|'.join(ways)}){after}"), tuple(spelled)
    return lambda text: (
        pattern.sub(lambda found: spelled[found[0]], text) if any(hint in text for hint in hints) else text
    )
