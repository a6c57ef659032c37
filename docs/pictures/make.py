"""The pictures of the README, from what `make demo` made: python docs/pictures/make.py runs/demo"""

from __future__ import annotations

import base64
import re
import sys
from pathlib import Path

import cv2
import numpy as np

FIGURE = re.compile(r'src="data:image/(?:png|jpeg|webp);base64,([^"]+)"[^>]*><figcaption>([^<]*)')
TILES = re.compile(r'<figure class="tiles".*?</div><figcaption>')
HERE = Path(__file__).parent
HEIGHT, GAP = 300, 12


def figures(report: Path, map_id: int) -> dict[str, np.ndarray]:
    """The pictures (H, W, 3) of a map in a report, by the beginning of their caption, and its first row of tiles."""
    text = report.read_text(encoding="utf-8")
    section = text[text.index(f">Map {map_id}</h2>") :]
    found: dict[str, np.ndarray] = {}
    for data, caption in FIGURE.findall(TILES.sub("", section)):
        found.setdefault(re.split(r"[:,;(]", caption)[0].strip(), on_white(data))
    tiles = TILES.search(section)
    assert tiles is not None, f"{report}: map {map_id} has no pictures of keyframes"
    found["keyframe"] = row([on_white(data) for data, _ in FIGURE.findall(tiles.group())])
    return found


def on_white(data: str) -> np.ndarray:
    """A picture (H, W, 3) from base64, white where it is clear."""
    picture = cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_UNCHANGED)
    if picture.shape[2] == 3:
        return picture
    share = picture[..., 3:] / 255
    return np.rint(share * picture[..., :3] + 255 * (1 - share)).astype(np.uint8)


def row(pictures: list[np.ndarray]) -> np.ndarray:
    """Pictures side by side, of one height, with white between them."""
    gap = np.full((HEIGHT, GAP, 3), 255, np.uint8)
    scaled = [
        cv2.resize(p, (round(p.shape[1] * HEIGHT / len(p)), HEIGHT), interpolation=cv2.INTER_AREA) for p in pictures
    ]
    return np.concatenate([each for picture in scaled for each in (picture, gap)][:-1], 1)


def main(run: Path) -> None:
    found = figures(run / "report.html", 1)
    inside = next(picture for caption, picture in found.items() if caption.startswith("From keyframe"))
    cv2.imwrite(str(HERE / "frames.jpg"), row([found["keyframe"], inside]), [cv2.IMWRITE_JPEG_QUALITY, 85])
    surface = found["Surface of map 1 from outside"]
    error = cv2.imread(str(run / "map_001_error.png"))
    cv2.imwrite(str(HERE / "surface.jpg"), row([surface, error]), [cv2.IMWRITE_JPEG_QUALITY, 85])


if __name__ == "__main__":
    main(Path(sys.argv[1]))
