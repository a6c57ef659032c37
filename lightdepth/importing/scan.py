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
from lightdepth.reporting.progress import Progress


@dataclass(frozen=True)
class Scan:
    """Measures and times [s] of the frames that were looked at; `rows` are their indices in the source."""

    rows: np.ndarray
    times: np.ndarray
    measures: Measures


def scanned(source: Source, tissue: np.ndarray, choice: Choice, deinterlace: bool) -> Scan:
    start, end = choice.start, choice.end
    rows, times, meter, first = [], [], Meter(tissue), None
    last = np.inf if end is None else end
    for_sure = None if source.video is None else source.video.times - source.video.times[0]
    with Progress("Measuring", len(source)) as bar:
        for i in range(len(source)):
            bar.advance()
            if for_sure is not None and (for_sure[i] < start or for_sure[i] > last):
                continue
            try:
                pixels, time = source.read(i)
                if pixels.shape[:2] != tissue.shape:
                    raise InputError(
                        f"frame {source.numbers[i]}", "it has another size than the first", "expected one size"
                    )
            except InputError:
                rows.append(i)
                times.append(np.nan)
                meter.unreadable()
                continue
            first = time if first is None else first
            if for_sure is None and (time - first < start or time - first > last):
                continue
            rows.append(i)
            times.append(time)
            meter.add(one_field(pixels) if deinterlace else pixels)
    if not rows:
        raise InputError(f"--start {start:g} --end {last:g}", "no frames between these seconds", "choose others")
    return Scan(np.array(rows), np.array(times), meter.result())


def write_measures(path: Path, source: Source, scan: Scan, fate: np.ndarray) -> None:
    columns = ("brightness", "saturated", "dark", "sharpness", "change", "combing")
    with path.open("w", newline="", encoding="utf-8", errors="surrogateescape") as file:
        writer = csv.writer(file)
        writer.writerow(["number", "seconds", "fate", *columns])
        for k, row in enumerate(scan.rows):
            values = [f"{getattr(scan.measures, column)[k]:.5g}" for column in columns]
            writer.writerow([source.numbers[row], f"{scan.times[k]:.6f}", fate[k], *values])
