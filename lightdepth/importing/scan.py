"""Every frame of a source measured, in its order."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lightdepth.errors import InputError
from lightdepth.image_quality import Measures, Meter, one_field
from lightdepth.importing.selection import Choice
from lightdepth.importing.source import Source
from lightdepth.reporting.batches import batches
from lightdepth.reporting.progress import Progress
from lightdepth.reporting.run import Run


@dataclass(frozen=True)
class Scan:
    """Measures and times [s] of the frames that were looked at; `rows` are their indices in the source."""

    rows: np.ndarray
    times: np.ndarray
    measures: Measures


def scanned(run: Run, source: Source, tissue: np.ndarray, choice: Choice, deinterlace: bool) -> Scan:
    """Raises InputError where no frame is within the seconds that were chosen."""
    start, end = choice.start, choice.end
    last = np.inf if end is None else end
    rows: list[int] = []
    times: list[float] = []
    first: list[float] = []  # the time of the first frame that could be read
    meter = Meter(tissue)
    for_sure = None if source.video is None else source.video.times - source.video.times[0]
    with Progress("Measuring", len(source)) as bar:
        for batch in batches(run, "measures", len(source)):
            if batch.finished:
                found = batch.arrays()
                rows += found["rows"].tolist()
                times += found["times"].tolist()
                first = found["first"].tolist()
                meter.go_on(found)
                bar.advance(len(batch))
                continue
            before = len(rows)
            for i in batch:
                bar.advance()
                if for_sure is not None and (for_sure[i] < start or for_sure[i] > last):
                    continue
                try:
                    pixels, time = _read(source, i, tissue.shape)
                except InputError:
                    rows.append(i)
                    times.append(np.nan)
                    meter.unreadable()
                    continue
                first = first or [time]
                if for_sure is None and (time - first[0] < start or time - first[0] > last):
                    continue
                rows.append(i)
                times.append(time)
                meter.add(one_field(pixels) if deinterlace else pixels)
            since = {"rows": np.array(rows[before:], int), "times": np.array(times[before:], float)}
            batch.finish(None, since | {"first": np.array(first, float)} | meter.since(before))
    if not rows:
        raise InputError(f"--start {start:g} --end {last:g}", "no frames between these seconds", "choose others")
    return Scan(np.array(rows), np.array(times), meter.result())


def _read(source: Source, i: int, shape: tuple[int, ...]) -> tuple[np.ndarray, float]:
    pixels, time = source.read(i)
    if pixels.shape[:2] != shape:
        raise InputError(f"frame {source.numbers[i]}", "it has another size than the first", "expected one size")
    return pixels, time


def write_measures(path: Path, source: Source, scan: Scan, fate: np.ndarray) -> None:
    columns = ("brightness", "saturated", "dark", "sharpness", "change", "combing")
    with path.open("w", newline="", encoding="utf-8", errors="surrogateescape") as file:
        writer = csv.writer(file)
        writer.writerow(["number", "seconds", "fate", *columns])
        for k, row in enumerate(scan.rows):
            values = [f"{getattr(scan.measures, column)[k]:.5g}" for column in columns]
            writer.writerow([source.numbers[row], f"{scan.times[k]:.6f}", fate[k], *values])
