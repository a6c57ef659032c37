"""A lazy sequence of frames, and how images, masks and truth are read from files."""

from __future__ import annotations

import re
import warnings
from collections import Counter
from collections.abc import Callable, Container, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import overload

import cv2
import numpy as np

from lightdepth.datasets.counting import BY_NUMBER, Counting
from lightdepth.datasets.glare import rim_of_glare
from lightdepth.errors import InputError
from lightdepth.files.headers import Header, header_of, what_is_there
from lightdepth.files.images import ARRAY_SUFFIXES, PICTURE_SUFFIXES, image_size, read_image, read_raw
from lightdepth.files.masks import read_two_parts
from lightdepth.files.reading import reading
from lightdepth.frame import Frame, frame_number, readable
from lightdepth.option_names import option
from lightdepth.sparse_map import Keyframe

IMAGE_SUFFIXES = (*PICTURE_SUFFIXES, *ARRAY_SUFFIXES)


class FrameSequence(Sequence[Frame]):
    """Frames by index, each read from disk when it is asked for. `names` and `numbers` cost no reading.

    `sampled` are the frames by which the sequence is checked when it is opened: first, middle and last where left out.
    `load_blind` loads a frame without its true distance, and without a true pose that cannot be read; `combs_said` that
    interlacing was looked for by the reader, who sees more than single frames.
    """

    def __init__(
        self,
        names: Sequence[str],
        load: Callable[[int], Frame],
        source: str,
        sampled: Sequence[int] | None = None,
        load_blind: Callable[[int], Frame] | None = None,
        combs_said: bool = False,
    ):
        if not names:
            raise InputError(source, "no frames in it", "expected images with a number in their names")
        self.names = list(names)
        self.numbers = [frame_number(name) for name in names]
        self.source = source
        self._load = load
        self._load_blind = load_blind
        self.combs_said = combs_said
        self.sampled = tuple(sorted({0, len(names) // 2, len(names) - 1})) if sampled is None else tuple(sampled)
        twice = {n for n in self.numbers if self.numbers.count(n) > 1} if len(set(self.numbers)) < len(names) else set()
        if twice:
            same = [name for name, n in zip(self.names, self.numbers, strict=True) if n == min(twice)]
            raise InputError(
                source,
                f"{' and '.join(same)} have the same number",
                "frames are told apart by it: rename or remove one",
            )

    def __len__(self) -> int:
        return len(self.names)

    def __repr__(self) -> str:
        return f"FrameSequence({len(self)} frames, {self.names[0]} to {self.names[-1]}, of {self.source})"

    @overload
    def __getitem__(self, index: int) -> Frame: ...
    @overload
    def __getitem__(self, index: slice) -> FrameSequence: ...
    def __getitem__(self, index: int | slice) -> Frame | FrameSequence:
        if isinstance(index, slice):
            return self.at(range(len(self))[index])
        index = range(len(self))[index]
        with reading(f"{self.source}: {self.names[index]}", "a frame that can be read"):
            return self._load(index)

    def at(self, rows: Sequence[int]) -> FrameSequence:
        """The frames at these rows, in this order."""
        blind = None if self._load_blind is None else _Rows(self._load_blind, rows)
        return FrameSequence([self.names[i] for i in rows], _Rows(self._load, rows), self.source, load_blind=blind)

    def without_truth(self) -> FrameSequence:
        """The frames without their true distance, which is not read: whatever is wrong with it, or with their true
        poses, does not matter."""
        if self._load_blind is None:
            return self
        return FrameSequence(self.names, self._load_blind, self.source, self.sampled)

    def first(self) -> Frame:
        """The first frame that can be read, for what all have in common. Raises InputError, the very first one's, where
        none of the first hundred can."""
        found = next(readable(self, range(min(len(self), 100))), None)
        return self[0] if found is None else found

    def image_size(self) -> tuple[int, int]:
        """Width and height of the frames."""
        first = self.first()
        return first.camera.width, first.camera.height

    def by_number(self, number: int) -> Frame | None:
        """The frame with this number, or None."""
        return self[self.numbers.index(number)] if number in self.numbers else None

    def of_keyframe(self, keyframe: Keyframe, counting: Counting = BY_NUMBER) -> Frame:
        """The image of a keyframe under the map's own camera, which knows best. Raises InputError where there is none,
        or it cannot be read."""
        number = counting.number(keyframe)
        frame = self.by_number(number)
        if frame is None:
            raise InputError(self.source, f"no frame number {number}", "expected the frames that the map was made from")
        return replace(frame, camera=keyframe.camera)


@dataclass(frozen=True)
class _Rows:
    """Loads a slice's frames; unlike a closure it can be pickled, where the loader behind it can."""

    load: Callable[[int], Frame]
    rows: Sequence[int]

    def __call__(self, i: int) -> Frame:
        return self.load(self.rows[i])


def list_images(folder: Path) -> list[Path]:
    """Image files with a number in their names, by that number. Masks and thumbnails have none and are left out, and so
    are hidden files, such as the ._NAME that macOS puts beside each file on other disks."""
    numbered = [p for p in folder.iterdir() if any(c.isdigit() for c in p.stem) and not p.name.startswith(".")]
    images: list[Path] = []
    for kinds in (PICTURE_SUFFIXES, ARRAY_SUFFIXES):
        images = images or [p for p in numbered if p.suffix.lower() in kinds and not p.is_dir()]
    return sorted(images, key=lambda p: (frame_number(p.name), p.name))


def no_images(folder: Path) -> str:
    """What a folder without frames holds instead, for messages."""
    names = sorted(p.name + "/" * p.is_dir() for p in folder.iterdir())
    if not names:
        return "the folder is empty"
    found = ", ".join(names[:4]) + (f" and {len(names) - 4} more" if len(names) > 4 else "")
    return f"no images with a number in their names (found {found})"


def numbered_files(folder: Path, pattern: str) -> dict[int, Path]:
    """Files whose whole name matches `pattern`, by the integer in its first group; 12 and 0012 are the same."""
    found: dict[int, Path] = {}
    for file in sorted(folder.iterdir()) if folder.is_dir() else ():
        match = re.fullmatch(pattern, file.name, re.DOTALL)
        if match:
            number = int(match[1])
            if number in found:
                raise InputError(
                    folder, f"{found[number].name} and {file.name} have the same number", "rename or remove one"
                )
            found[number] = file
    return found


def read_code(path: Path, ray_z: np.ndarray, whose: str) -> np.ndarray:
    """(H, W) uint16 depth as the file codes it, of the size of the rays. `whose` names the data set in errors."""
    code = read_raw(path)
    if code.dtype != np.uint16 or code.ndim != 2:
        raise InputError(path, f"{code.dtype} of shape {code.shape}", f"{whose}'s depth is one channel of 16 bits")
    if code.shape != ray_z.shape:
        raise InputError(
            path,
            f"depth is {code.shape[1]}x{code.shape[0]}, the image {ray_z.shape[1]}x{ray_z.shape[0]}",
            "expected the same size",
        )
    return code


def along_ray(depth: np.ndarray, known: np.ndarray, ray_z: np.ndarray) -> np.ndarray:
    """(H, W) float32 distance of what lies at `depth` along the axis; 0 where unknown, or far to the side."""
    known = known & (ray_z > 0.05)
    return np.where(known, depth / np.where(known, ray_z, 1), 0).astype(np.float32)


def read_mask(path: Path, image: Path | None = None) -> np.ndarray:
    """(H, W) bool, True where tissue shows, of the size of the image where one is given. Files come in both polarities:
    the centre of the image decides."""
    bright = read_two_parts(path, "expected an image, white where tissue shows")
    height, width = bright.shape
    if image is not None and image_size(image) != (width, height):
        wide, high = image_size(image)
        raise InputError(
            path,
            f"the mask is {width}x{height}, but {image.name} is {wide}x{high}",
            "expected a mask of the images' size",
        )
    centre = bright[int(height * 0.45) : int(height * 0.55) + 1, int(width * 0.45) : int(width * 0.55) + 1]
    mask = bright if centre.mean() >= 0.5 else ~bright
    mask.flags.writeable = False  # one for all frames of a sequence
    if not bright.any():
        raise InputError(path, "the mask is black everywhere", "expected white where tissue shows")
    return mask


def legible(images: Sequence[Path]) -> Path | None:
    """The first image whose size can be told: a broken one is refused when it is read, and the others are not."""
    for image in images:
        with suppress(InputError):
            image_size(image)
            return image
    return None


def check_files(images: Sequence[Path]) -> None:
    """Raises InputError where a frame is no file: a named pipe would be waited for without end."""
    for image in images:
        if image.exists() and not image.is_file():
            raise InputError(image, what_is_there(image), "expected an image file: remove it, or rename it")


def warn_of_orientation(source: Path, images: Sequence[Path]) -> None:
    """Warns of pictures whose files ask to be turned: pixels are taken as they are stored."""
    step = max(1, len(images) // 32)
    found = [(image, head) for image in images[::step] if (head := _header(image)) and head.orientation > 1]
    if found:
        image, head = found[0]
        warnings.warn(
            f"{source}: {image.name} has EXIF orientation {head.orientation} ({len(found)} of {len(images[::step])} "
            "checked); it is ignored: pixels are taken as they are stored, and so are camera and mask",
            stacklevel=6,
        )


def warn_of_border(source: Path, mask: np.ndarray) -> None:
    """Says that a black border was found, and left out."""
    warnings.warn(
        f"{source}: {1 - float(mask.mean()):.0%} of the image is a black border, which is left out; give "
        f"{option('mask')} to choose another",
        stacklevel=6,
    )


def _header(image: Path) -> Header | None:
    with suppress(InputError, OSError):
        return header_of(image)
    return None


def check_one_size(images: Sequence[Path]) -> None:
    """Raises InputError, naming an odd one, when images of one sequence differ in size. Of many, some hundred are
    looked at: the others are refused when they are read."""
    step = max(1, len(images) // 256)
    sizes: dict[Path, tuple[int, int]] = {}
    for image in [*images[::step], images[-1]]:
        with suppress(InputError):  # an image that cannot be read is refused when it is
            sizes[image] = image_size(image)
    counts = Counter(sizes.values())
    if len(counts) > 1:
        usual = counts.most_common(1)[0][0]
        odd = [image for image, size in sizes.items() if size != usual]
        example = next(image for image, size in sizes.items() if size == usual)
        width, height = sizes[odd[0]]
        raise InputError(
            odd[0],
            f"is {width}x{height}, but {example.name} is {usual[0]}x{usual[1]} ({len(odd)} of {len(sizes)} images "
            "differ)",
            "expected one size in a sequence: sort them into folders by size",
        )


def warn_of_gaps(source: Path, numbers: Sequence[int], known: Container[int]) -> None:
    """Warns of frames without the depth that others have."""
    without = [number for number in numbers if number not in known]
    if 0 < len(without) < len(numbers):
        warnings.warn(
            f"{source}: no depth for {len(without)} of {len(numbers)} frames, the first is frame {without[0]}; they "
            "have no truth. Is the data set complete?",
            stacklevel=5,
        )


def found_mask(images: Sequence[Path], white: float | None = None, count: int = 8) -> np.ndarray | None:
    """`border_mask` of a sequence's image files, from `count` of them spread over it; None where there is no border, or
    none of them can be read. `white` is as for `read_image`."""
    read = spread_images(images, white, count)
    mask = border_mask(read) if read else np.ones((1, 1), bool)
    return None if mask.all() else mask


def spread_images(images: Sequence[Path], white: float | None = None, count: int = 8) -> list[np.ndarray]:
    """`count` images (H, W, 3) spread over a sequence's files, those of them that can be read."""
    read = []
    for image in images[:: max(1, len(images) // count)][:count]:
        with suppress(InputError):  # refused by name when it is asked for
            read.append(read_image(image, white))
    return read


def border_mask(images: Sequence[np.ndarray]) -> np.ndarray:
    """(H, W) bool: `border_region` shrunk by 0.4 % of the height, away from the halo of compression, and without a rim
    of glare. Read-only."""
    region = border_region(images)
    if region.all():
        region.flags.writeable = False
        return region  # no border to keep away from
    shrink = 2 * max(1, round(0.004 * region.shape[0])) + 1
    padded = cv2.copyMakeBorder(region.astype(np.uint8), 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=0)
    mask = cv2.erode(padded, np.ones((shrink, shrink), np.uint8), borderValue=1)[1:-1, 1:-1].astype(bool)
    mask &= ~rim_of_glare(images, region)
    mask.flags.writeable = False  # one for all frames of a sequence
    return mask


def border_region(images: Sequence[np.ndarray]) -> np.ndarray:
    """(H, W) bool: what is not the black border, found in images (H, W, 3) of one camera by their brightest values.

    The largest bright region with its holes filled (a dark lumen is tissue too), without bulges narrower than 5 % of
    the height (text at its rim). A border that is black but noisy raises the threshold. Images of another size than
    the first are left out: Frame refuses them by name.
    """
    tops = [image.max(-1) for image in images if image.shape == images[0].shape]
    height = len(tops[0])
    # The median takes noise and thin text away before the brightest value over the images is taken.
    smooth = [cv2.medianBlur(np.rint(255 * top).astype(np.uint8), 3) for top in tops]
    brightest = np.max(smooth, axis=0)
    patch = max(2, height // 40)
    dark = np.concatenate([brightest[rows, columns].ravel() for rows, columns in corners(patch)])
    level = float(np.median(dark))
    threshold = 16.0 if level >= 16 else min(40.0, max(16.0, level + 1.5 * (np.quantile(dark, 0.9) - level) + 6))
    size = max(3, round(0.01 * height)) | 1
    closed = cv2.morphologyEx(
        (brightest > threshold).astype(np.uint8), cv2.MORPH_CLOSE, np.ones((size, size), np.uint8)
    )
    contours, _ = cv2.findContours(closed, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    if not contours:
        return np.ones(brightest.shape, bool)
    filled = cv2.drawContours(np.zeros_like(closed), [max(contours, key=cv2.contourArea)], -1, 1, cv2.FILLED)
    bulge = max(3, round(0.05 * height)) | 1
    padded = cv2.copyMakeBorder(filled, bulge, bulge, bulge, bulge, cv2.BORDER_REPLICATE)
    opened = cv2.morphologyEx(padded, cv2.MORPH_OPEN, np.ones((bulge, bulge), np.uint8))
    opened = opened[bulge:-bulge, bulge:-bulge]
    return (opened if opened.any() else filled).astype(bool)


def corners(size: int) -> list[tuple[slice, slice]]:
    """Rows and columns of the four corners of an image, `size` pixels wide and high."""
    first, last = slice(0, size), slice(-size, None)
    return [(first, first), (first, last), (last, first), (last, last)]
