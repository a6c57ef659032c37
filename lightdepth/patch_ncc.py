"""How alike patches of one image are to what another shows at places that affine maps give: compiled, pixel by pixel.

The zero-mean normalised cross-correlation (NCC) of patch values a_q and b_q, q = 1 .. Q, with a of mean 0:

    sum a b / (|a| sqrt(sum b² - (sum b)² / Q)),

b bilinear at the exact place. Only patches that are seen are looked at, and no image of them is ever made.
"""

from __future__ import annotations

import numpy as np

from lightdepth.compiled import compiled


def ncc(
    image: np.ndarray, usable: np.ndarray, three: np.ndarray, known: np.ndarray, own: np.ndarray, apart: float
) -> tuple[np.ndarray, np.ndarray]:
    """NCC (n, k) of square patches, values `own` (n, q) less their mean, row by row, with `image` (h, w) float32; 0
    where there is none. And whether there is one (n, k): `known` (n, k), the patch within the image, its middle
    `usable` (h, w) there.

    `three` (n, k, 3, 2) are pixels of the image, the first centre at (0.5, 0.5): where a patch's middle is, and the
    places `apart` of its pixels to the right of it and below it.
    """
    seen = np.zeros(known.shape, bool)
    score = np.zeros(known.shape)
    own = np.ascontiguousarray(own, np.float32)
    _ncc(
        np.ascontiguousarray(image), usable, three, known, own, round((own.shape[1] ** 0.5 - 1) / 2), apart, seen, score
    )
    return score, seen


@compiled
def _ncc(
    image: np.ndarray,
    usable: np.ndarray,
    three: np.ndarray,
    known: np.ndarray,
    own: np.ndarray,
    half: int,
    apart: float,
    seen: np.ndarray,
    score: np.ndarray,
) -> None:
    height, width = image.shape
    pixels = (2 * half + 1) ** 2
    for i in range(len(own)):
        size = 0.0
        for q in range(pixels):
            size += own[i, q] * own[i, q]
        for j in range(known.shape[1]):
            if not known[i, j]:
                continue
            x0, y0 = three[i, j, 0, 0] - 0.5, three[i, j, 0, 1] - 0.5
            ax, ay = (three[i, j, 1, 0] - 0.5 - x0) / apart, (three[i, j, 1, 1] - 0.5 - y0) / apart
            bx, by = (three[i, j, 2, 0] - 0.5 - x0) / apart, (three[i, j, 2, 1] - 0.5 - y0) / apart
            across, down = half * (abs(ax) + abs(bx)), half * (abs(ay) + abs(by))
            if not (x0 >= across and y0 >= down and x0 + across <= width - 1 and y0 + down <= height - 1):
                continue
            if not usable[int(y0 + 0.5), int(x0 + 0.5)]:
                continue
            seen[i, j] = True
            both, total, square, q = 0.0, 0.0, 0.0, 0
            for gy in range(-half, half + 1):
                for gx in range(-half, half + 1):
                    x, y = x0 + gx * ax + gy * bx, y0 + gx * ay + gy * by
                    column, row = min(max(int(x), 0), width - 2), min(max(int(y), 0), height - 2)
                    u, v = np.float32(x - column), np.float32(y - row)
                    left, right = image[row, column], image[row, column + 1]
                    above = left + u * (right - left)
                    left, right = image[row + 1, column], image[row + 1, column + 1]
                    value = above + v * (left + u * (right - left) - above)
                    both += own[i, q] * value
                    total += value
                    square += value * value
                    q += 1
            varied = square - total * total / pixels
            if varied > 1e-9 * square and size > 0:
                score[i, j] = both / np.sqrt(size * varied)
