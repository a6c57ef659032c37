"""Fuzzing of all parsers: spoilt files are read, and nothing but an InputError may come of it.

    python tests/fuzz.py --seconds 60              every parser, in a process of its own
    python tests/fuzz.py --seconds 600 mask video  these alone

A process may take 1 GB of memory beyond what it has after its samples, and 5 seconds an input. What fails is kept in
tests/corpus/PARSER/, from where every run of the tests reads it again. With atheris installed (the extra `fuzz`),
inputs are chosen by the lines of ours that they reach; without it they are drawn blindly.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import random
import re
import resource
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
CORPUS = HERE / "corpus"
SECONDS_AN_INPUT = 5
MOST_BYTES = 1 << 30
_OWN_MB = 256
"""What the inputs that are kept to build on may take in a process, which is then ended, and another goes on."""
_FULL = 3
_NUMBERS = (
    *(b"nan", b"inf", b"-inf", b"1e308", b"-1e308", b"1e-300", b"0", b"-0", b"-1", b"1", b"1e5", b"1e13", b"65536"),
    *(b"2147483648", b"9223372036854775808", b"99999999999999999999", b"1" + b"0" * 30, b"0.5", b"1_0", b"0x10"),
    b"9" * 5000,
)
_WORDS = (
    *(b"", b"null", b"true", b"[]", b"{}", b'""', b"[", b"{", b"]", b":", b",", b"#", b"\0", b"\xff", b"\xef\xbb\xbf"),
    *("٣".encode(), "²".encode(), b"x" * 300, b"[" * 5000, b"{" * 300, b"\n", b"\r", b"- ", b"<a>", b"&amp;", b"../x"),
)
_ENDS = (0, 1, 2, 127, 128, 255, 256, 32767, 65535, 65536, 2**24, 2**31 - 1, 2**31, 2**32 - 1, 2**60, 2**63, 2**64 - 1)
_FLOATS = (float("nan"), float("inf"), -float("inf"), 0.0, -1.0, 1e308, 1e-300, 1e13, 1e38)
_NUMBER = re.compile(rb"-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
_WORD = re.compile(rb"[A-Za-z_]+|[\[\]{}:,<>/=\"']")


class Hang(BaseException):
    """An input took too long."""


@dataclass
class Found:
    """What a run of one parser came to."""

    parser: str
    inputs: int = 0
    refused: int = 0
    seconds: float = 0.0
    peak_mb: float = 0.0
    """resident memory beyond that after the samples, MB"""
    findings: dict[str, str] = field(default_factory=dict)
    """what was raised, by the kept input"""


def mutated(data: bytes, others: Sequence[bytes], rng: random.Random) -> bytes:
    """The bytes with one to six things changed."""
    for _ in range(rng.choice((1, 1, 1, 2, 3, 6))):
        text = not data[:64].strip(b"\t\r\n").translate(None, bytes(range(32, 127))).strip(b"\n\r\t")
        data = rng.choice(_TEXT if text and rng.random() < 0.8 else _BINARY)(data, others, rng)
    return data[: 1 << 20]


def _replaced(data: bytes, pattern: re.Pattern[bytes], new: bytes, rng: random.Random) -> bytes:
    places = [m.span() for m in pattern.finditer(data[:20000])]
    if not places:
        return data + new
    start, end = rng.choice(places)
    return data[:start] + new + data[end:]


def _number(data: bytes, others: Sequence[bytes], rng: random.Random) -> bytes:
    return _replaced(data, _NUMBER, rng.choice(_NUMBERS), rng)


def _word(data: bytes, others: Sequence[bytes], rng: random.Random) -> bytes:
    return _replaced(data, _WORD, rng.choice((*_WORDS, *_NUMBERS)), rng)


def _line(data: bytes, others: Sequence[bytes], rng: random.Random) -> bytes:
    lines = data.split(b"\n")
    i, j = rng.randrange(len(lines)), rng.randrange(len(lines))
    how = rng.randrange(4)
    if how == 0:
        del lines[i]
    elif how == 1:
        lines.insert(j, lines[i])
    elif how == 2:
        lines[i], lines[j] = lines[j], lines[i]
    else:
        words = lines[i].split(b" ")
        rng.shuffle(words)
        lines[i] = b" ".join(words)
    return b"\n".join(lines)


def _flip(data: bytes, others: Sequence[bytes], rng: random.Random) -> bytes:
    changed = bytearray(data or b"\0")
    for _ in range(rng.choice((1, 1, 2, 8))):
        changed[_place(changed, rng)] ^= 1 << rng.randrange(8)
    return bytes(changed)


def _byte(data: bytes, others: Sequence[bytes], rng: random.Random) -> bytes:
    changed = bytearray(data or b"\0")
    changed[_place(changed, rng)] = rng.choice((0, 1, 127, 128, 192, 220, 221, 222, 223, 254, 255, rng.randrange(256)))
    return bytes(changed)


def _whole(data: bytes, others: Sequence[bytes], rng: random.Random) -> bytes:
    size, order = rng.choice((1, 2, 4, 8)), rng.choice(("little", "big"))
    return _over(data, (rng.choice(_ENDS) % 256**size).to_bytes(size, order), rng)  # type: ignore[arg-type]


def _float(data: bytes, others: Sequence[bytes], rng: random.Random) -> bytes:
    import struct

    value, kind = rng.choice(_FLOATS), rng.choice(("<f", "<d", ">d"))
    return _over(data, struct.pack(kind, value if kind != "<f" or abs(value) < 3e38 else 1e38), rng)


def _cut(data: bytes, others: Sequence[bytes], rng: random.Random) -> bytes:
    start = rng.randrange(len(data) + 1)
    return data[:start] if rng.random() < 0.5 else data[:start] + data[start + rng.choice((1, 2, 4, 16, 200)) :]


def _insert(data: bytes, others: Sequence[bytes], rng: random.Random) -> bytes:
    start = rng.randrange(len(data) + 1)
    new = rng.choice((rng.randbytes(rng.choice((1, 4, 30))), rng.choice(_WORDS), b"\0" * rng.choice((1, 8, 4096))))
    return data[:start] + new + data[start:]


def _splice(data: bytes, others: Sequence[bytes], rng: random.Random) -> bytes:
    other = rng.choice(others) if others else data
    start, there = rng.randrange(len(data) + 1), rng.randrange(len(other) + 1)
    length = rng.choice((1, 4, 20, 200, 5000))
    return data[:start] + other[there : there + length] + data[start + rng.choice((0, length)) :]


def _place(data: Sequence[int], rng: random.Random) -> int:
    """Anywhere, with headers more often than what follows them."""
    return rng.randrange(min(len(data), rng.choice((16, 64, 512, 1 << 30))))


def _over(data: bytes, new: bytes, rng: random.Random) -> bytes:
    at = _place(data or b"\0", rng)
    return data[:at] + new + data[at + len(new) :]


_TEXT = (_number, _number, _number, _word, _word, _line, _cut, _insert, _splice, _byte)
_BINARY = (_flip, _flip, _byte, _byte, _whole, _whole, _float, _cut, _insert, _splice, _number)


# ---- one input


@contextmanager
def timed(seconds: float) -> Iterator[None]:
    """Ends what takes longer: a busy machine's other work does not count, ten times as long without working does."""
    began, worked = time.monotonic(), time.process_time()

    def ring(*_: object) -> None:
        left = seconds - (time.process_time() - worked)
        if left <= 0 or time.monotonic() - began > 10 * seconds:
            raise Hang(f"more than {seconds:g} s")
        signal.setitimer(signal.ITIMER_REAL, max(left, 0.1))

    before = signal.signal(signal.SIGALRM, ring)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def tried(parser: Any, sample: Any, data: bytes, folder: Path) -> tuple[bool, str]:
    """Whether the parser refused the data in the sample's place; and what it raised that it must not, or ""."""
    from lightdepth.errors import InputError

    target = folder / sample.target
    target.write_bytes(data)
    try:
        with timed(SECONDS_AN_INPUT), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            parser.read(target)
        return False, ""
    except InputError as error:
        cause: BaseException | None = error
        while cause is not None:
            if isinstance(cause, MemoryError) and not _refused_by_ffmpeg(cause, parser, target):
                return True, f"MemoryError behind: {error}"[:300]
            cause = cause.__cause__
        return True, ""
    except (Exception, Hang) as error:
        place = [f for f in traceback.extract_tb(error.__traceback__) if "site-packages" not in f.filename][-1]
        return True, f"{type(error).__name__} at {Path(place.filename).name}:{place.lineno}: {error}"[:300]


def _refused_by_ffmpeg(error: MemoryError, parser: Any, target: Path) -> bool:
    """FFmpeg says the same of a table longer than any that it makes as of memory that the limit withholds. So it
    is asked again without the limit: whether it needs less then than a process may take."""
    if not type(error).__module__.startswith("av."):
        return False
    limit, peak = resource.getrlimit(resource.RLIMIT_AS), _peak()
    resource.setrlimit(resource.RLIMIT_AS, (limit[1], limit[1]))
    try:
        with suppress(Exception):
            parser.read(target)
    finally:
        resource.setrlimit(resource.RLIMIT_AS, limit)
    return (_peak() - peak) * 2**20 < MOST_BYTES


def laid_out(sample: Any, folder: Path) -> None:
    for name, content in sample.files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)


def kept(parser: Any) -> list[tuple[int, bytes]]:
    """The corpus of a parser: which sample an input is for, and its bytes."""
    names = [sample.target.replace("/", "+") for sample in parser.samples()]
    found = []
    for file in sorted((CORPUS / parser.name).glob("*")):
        name = file.name.split("~", 1)[1]
        if name in names:
            found.append((names.index(name), file.read_bytes()))
    return found


def keep(parser: Any, sample: Any, data: bytes) -> str:
    name = f"{hashlib.sha256(data).hexdigest()[:8]}~{sample.target.replace('/', '+')}"
    (CORPUS / parser.name).mkdir(parents=True, exist_ok=True)
    (CORPUS / parser.name / name).write_bytes(data)
    return name


# ---- many inputs


class Fuzzing:
    """Inputs of one parser, one after the other, in one folder. An input is the number of a sample and bytes."""

    def __init__(self, parser: Any, folder: Path, seed: int, keeping: bool = True):
        self.parser, self.folder, self.rng = parser, folder, random.Random(f"{parser.name} {seed}")
        self.keeping = keeping
        self.found, self.known = Found(parser.name), set()  # type: ignore[var-annotated]
        self.samples = parser.samples()
        self.corpus = [(i, sample.content) for i, sample in enumerate(self.samples)] + kept(parser)

    def again(self) -> None:
        """Samples and corpus, as they are."""
        for i, data in self.corpus:
            self.one(i, data)

    def drawn(self) -> tuple[int, bytes]:
        i, data = self.rng.choice(self.corpus)
        others = [content for j, content in self.corpus if j == i]
        data = mutated(data, others, self.rng)
        return i, self.parser.repaired(data) if self.rng.random() < 0.85 else data

    def one(self, i: int, data: bytes) -> bool:
        """Whether the input was refused; what else comes of it is noted, and kept."""
        sample = self.samples[i]
        place = self.folder / str(i)
        if not place.is_dir():
            laid_out(sample, place)
        (self.folder / "current").write_text(f"{i}")
        refused, wrong = tried(self.parser, sample, data, place)
        self.found.inputs += 1
        self.found.refused += refused
        kind = re.sub(r"\d{3,}|0x\w+|'.*'", "", wrong.split(": ")[0])
        if wrong and kind not in self.known:
            self.known.add(kind)
            name = keep(self.parser, sample, data) if self.keeping else f"input {self.found.inputs}"
            self.found.findings[name] = wrong
        return refused


def _peak() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def _resident() -> float:
    """Megabytes now; 0 where the system does not say."""
    status = Path("/proc/self/statm")
    return int(status.read_text().split()[1]) * resource.getpagesize() / 2**20 if status.is_file() else 0.0


def child(parser: Any, seconds: float, seed: int, folder: Path, guided: Any) -> None:
    """One parser in this process, until the time is over. `folder/found.json` is kept up to date."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # what libraries print of broken files
    os.dup2(1, 2)
    fuzzing = Fuzzing(parser, folder, seed)
    fuzzing.again()
    status = Path("/proc/self/statm")
    if status.is_file():
        pages = int(status.read_text().split()[0])
        resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + MOST_BYTES, resource.RLIM_INFINITY))
    before, peak, began, said = _resident(), _peak(), time.process_time(), 0.0

    def note() -> None:
        fuzzing.found.seconds = time.process_time() - began
        fuzzing.found.peak_mb = max(0.0, _peak() - peak)
        (folder / "found.json").write_text(json.dumps(asdict(fuzzing.found)))

    def one(data: bytes) -> None:
        nonlocal said
        if data:
            fuzzing.one(data[0] % len(fuzzing.samples), data[1:])
        now = time.process_time() - began
        if now > said + 1 or now > seconds:
            said = now
            note()
            if _resident() - before > _OWN_MB:
                os._exit(_FULL)
        if now > seconds:
            os._exit(0)

    def changed(data: bytes, most: int, seed: int) -> bytes:
        rng = random.Random(seed)
        if len(data) < 2 or rng.random() < 0.2:
            i, data = rng.choice(fuzzing.corpus)
        else:
            i, data = data[0] % len(fuzzing.samples), data[1:]
        data = mutated(data, [content for j, content in fuzzing.corpus if j == i], rng)
        data = fuzzing.parser.repaired(data) if rng.random() < 0.85 else data
        return (bytes([i]) + data)[:most]

    if guided is None:
        while True:
            i, data = fuzzing.drawn()
            one(bytes([i]) + data)
    inputs = folder / "inputs"
    inputs.mkdir(exist_ok=True)
    for n, (i, data) in enumerate(fuzzing.corpus):
        (inputs / str(n)).write_bytes(bytes([i]) + data)
    options = ["-max_len=1100000", "-rss_limit_mb=0", "-timeout=300", f"-seed={seed + 1}", "-len_control=0"]
    guided.Setup([sys.argv[0], *options, str(inputs)], one, custom_mutator=changed)
    guided.Fuzz()


def run(parser: Any, seconds: float, seed: int, guided: Any) -> Found:
    """One parser in processes of their own: one that dies or hangs is a finding, and another goes on."""
    total, left = Found(parser.name), seconds
    parser.samples()
    while left > 1:
        with tempfile.TemporaryDirectory(prefix="fuzz-") as place:
            folder = Path(place)
            process = os.fork()
            if process == 0:
                child(parser, left, seed, folder, guided)
                os._exit(0)
            died, full = _waited_for(process, folder)
            found = Found(parser.name)
            if (folder / "found.json").is_file():
                found = Found(**json.loads((folder / "found.json").read_text()))
            if died and (folder / "current").is_file():
                i = int((folder / "current").read_text())
                sample = parser.samples()[i]
                found.findings[keep(parser, sample, (folder / str(i) / sample.target).read_bytes())] = died
            total.inputs, total.refused = total.inputs + found.inputs, total.refused + found.refused
            total.seconds, total.peak_mb = total.seconds + found.seconds, max(total.peak_mb, found.peak_mb)
            total.findings |= found.findings
            left -= max(found.seconds, 5) if died or full else left
            seed += 1
    return total


def _waited_for(process: int, folder: Path) -> tuple[str, bool]:
    """How the process ended, "" where as it should, and whether it was full of what it keeps. One whose input takes a
    five minutes is stuck in a library."""
    began, current = time.monotonic(), folder / "current"
    while True:
        ended, status = os.waitpid(process, os.WNOHANG)
        if ended:
            code = os.waitstatus_to_exitcode(status)
            return "" if code in (0, _FULL) else f"the process ended with {code}", code == _FULL
        since = max(began, current.stat().st_mtime - time.time() + time.monotonic() if current.is_file() else began)
        if time.monotonic() - since > 300:
            os.kill(process, signal.SIGKILL)
            os.waitpid(process, 0)
            return "it hung in a library", False
        time.sleep(0.2)


def main() -> int:
    parse = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parse.add_argument("parsers", nargs="*", help="names of parsers; all of them where left out")
    parse.add_argument("--seconds", type=float, default=60, help="of processor time, for each parser")
    parse.add_argument("--seed", type=int, default=0)
    parse.add_argument("--blind", action="store_true", help="without atheris, though it is installed")
    asked = parse.parse_args()
    guided: Any = None
    if not asked.blind:
        with suppress(ImportError):
            import atheris as guided
    with guided.instrument_imports(include=["lightdepth", "densify"]) if guided is not None else nullcontext():
        import strangers

    unknown = set(asked.parsers) - set(strangers.PARSERS)
    if unknown:
        parse.error(f"no parser {', '.join(sorted(unknown))}; known are {', '.join(strangers.PARSERS)}")
    failed = False
    for name in asked.parsers or strangers.PARSERS:
        found = run(strangers.PARSERS[name], asked.seconds, asked.seed, guided)
        failed |= bool(found.findings)
        share = f"{found.refused / max(found.inputs, 1):.0%} refused, {found.peak_mb:.0f} MB more"
        print(f"{name}: {found.inputs} inputs in {found.seconds:.0f} s of processor time, {share}", flush=True)
        for file, wrong in found.findings.items():
            print(f"    {file}: {wrong}", flush=True)
    return int(failed)


if __name__ == "__main__":
    sys.path.insert(0, str(HERE))
    sys.exit(main())
