"""Which frames show the same wall: a global descriptor per frame, and matches between two frames.

A descriptor is a unit vector; the cosine of two says how alike two frames are. A matcher keeps of a frame what matching
needs (`keep`), and counts what agrees between two such (`agree`): the number of matches, and the share of the image
that they spread over, in cells of an 8 x 8 grid. Sizes in pixels are after resizing to the configuration's width.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple, Protocol

import cv2
import numpy as np

from lightdepth.camera import CameraModel
from lightdepth.errors import InputError
from lightdepth.files.weights import check_header, read_pickled
from lightdepth.frame import Frame, resized_mask
from lightdepth.ranges import COUNT, SHARE, above, at_least, checked

_CELLS = 8


class MatchAgreement(NamedTuple):
    """matches: that agree with one motion of the camera; spread: share of the image's cells with one of them."""

    matches: int
    spread: float


class Descriptor(Protocol):
    """A frame -> a unit vector (n,)."""

    def __call__(self, frame: Frame) -> np.ndarray: ...


class Matcher(Protocol):
    """What is kept of a frame, how many features that is (None where there are none), and what two have in common."""

    def keep(self, frame: Frame) -> Any: ...

    def count(self, kept: Any) -> int | None: ...

    def agree(self, one: Any, other: Any) -> MatchAgreement: ...


@dataclass(frozen=True)
@checked
class SiftSettings:
    """Features and their geometry."""

    width: Annotated[int, at_least(16, up_to=10_000)] = 480
    """Width that images are reduced to for matching, pixels; smaller ones stay as they are. A larger one finds finer
    features and takes longer."""
    features: Annotated[int, COUNT] = 800
    """Largest number of features taken of a frame, the strongest ones. More find more matches and take longer."""
    contrast: Annotated[float, at_least(0)] = 0.02
    """Least contrast of a feature, with brightness in [0, 1] (OpenCV's contrastThreshold). A higher one finds fewer,
    more distinct features."""
    largest: Annotated[float, above(0)] = 0.02
    """Largest size of a feature, as a share of the image's width: larger ones survive blur, and would let blurred
    frames pass. A larger one takes in more features."""
    ratio: Annotated[float, above(0, up_to=1)] = 0.8
    """Largest ratio, up to 1, of the difference between a feature and its best match to that between it and its second
    best, for the match to count. A larger one takes in more matches, wrong ones among them."""
    angle: Annotated[float, at_least(0, up_to=180)] = 0.5
    """Largest angle, degrees, by which a match may miss the plane in which the camera's motion lets it lie (its
    epipolar plane). A larger one takes in more matches, wrong ones among them."""
    highlight: Annotated[float, SHARE] = 0.95
    """Brightness, in [0, 1], above which red, green and blue must all be for a pixel to be a highlight, where no
    feature is taken. A higher one takes fewer pixels for highlights."""
    border: Annotated[float, at_least(0, below=0.5)] = 0.01
    """Width of the strip inside the border of the visible image and around highlights where no feature is taken, as a
    share of the image's width. A larger one leaves out more of the image."""


@dataclass(frozen=True)
class SiftFeatures:
    """Unit rays (n, 3), RootSIFT descriptors (n, 128) unit, cell of the grid (n,), and how many cells are in view."""

    rays: np.ndarray
    descriptors: np.ndarray
    cells: np.ndarray
    cells_in_view: int


class SiftMatcher:
    """RootSIFT with ratio test, mutual, verified by an essential matrix on unit rays: any lens will do."""

    def __init__(self, settings: SiftSettings = SiftSettings()):
        self.settings = settings
        self._sift = cv2.SIFT.create(settings.features, contrastThreshold=settings.contrast)

    def keep(self, frame: Frame) -> SiftFeatures:
        settings, camera = self.settings, frame.camera
        grey, usable, scale = _prepared(frame, settings)
        keypoints, found = self._sift.detectAndCompute(grey, usable)
        chosen = [i for i, k in enumerate(keypoints) if k.size <= settings.largest * grey.shape[1]]
        pixels = np.array([keypoints[i].pt for i in chosen]).reshape(-1, 2)
        pixels = (pixels + 0.5) / scale  # cv2 puts the first pixel's centre at (0, 0)
        descriptors = np.zeros((0, 128), np.float32) if found is None else found[chosen]
        descriptors = np.sqrt(descriptors / descriptors.sum(1, keepdims=True).clip(min=1e-9))
        rays, valid = camera.unproject(pixels)
        cells = _cells(pixels, camera)
        return SiftFeatures(rays[valid], descriptors[valid], cells[valid], _cells_in_view(frame))

    def count(self, kept: SiftFeatures) -> int:
        return len(kept.rays)

    def agree(self, one: SiftFeatures, other: SiftFeatures) -> MatchAgreement:
        if min(len(one.rays), len(other.rays)) < 8:
            return MatchAgreement(0, 0.0)
        cosine = one.descriptors @ other.descriptors.T
        rows = np.arange(len(cosine))
        best = cosine.argmax(1)
        closest = cosine[rows, best]
        second = np.partition(cosine, -2, axis=1)[:, -2]
        near = 2 - 2 * closest < self.settings.ratio**2 * (2 - 2 * second)  # squared distances of unit vectors
        matched = near & (cosine.argmax(0)[best] == rows)
        inlier = epipolar_inliers(one.rays[matched], other.rays[best[matched]], self.settings.angle)
        cells = np.unique(other.cells[best[matched]][inlier])
        return MatchAgreement(int(inlier.sum()), len(cells) / other.cells_in_view)


def epipolar_inliers(one: np.ndarray, other: np.ndarray, angle: float) -> np.ndarray:
    """Which matched unit rays (n, 3) of two views agree with one rigid motion, (n,) bool.

    The essential matrix is searched on the rays within 80 degrees of the axis, as a plane can hold no more; all are
    judged by their angle [degrees] from the epipolar plane, which treats every part of a wide field alike. On exact
    geometry with 30 % wrong matches USAC_DEFAULT found all of the right ones, USAC_MAGSAC as few as half (OpenCV 5).
    """
    none = np.zeros(len(one), bool)
    ahead = np.minimum(one[:, 2], other[:, 2]) > np.cos(np.deg2rad(80))
    if ahead.sum() < 8:
        return none
    plane, other_plane = (rays[ahead, :2] / rays[ahead, 2:] for rays in (one, other))
    tolerance = np.deg2rad(angle)
    essential, _ = cv2.findEssentialMat(
        plane, other_plane, np.eye(3), cv2.USAC_DEFAULT, 0.999, float(np.tan(tolerance)), 300
    )
    if essential is None:
        return none
    essential = essential[:3]
    lines = np.linalg.norm(one @ essential.T, axis=1), np.linalg.norm(other @ essential, axis=1)
    off = np.abs(np.einsum("ni,ij,nj->n", other, essential, one))
    result: np.ndarray = off < np.sin(tolerance) * np.minimum(*lines)
    return result


class OrientationDescriptor:
    """Gradients by place and direction, 8 x 8 cells of 8 directions, square-rooted: SIFT's idea for the whole image.

    Unlike a thumbnail it changes when a frame blurs, so that blurred frames are not taken for their sharp neighbours.
    """

    def __init__(self, settings: SiftSettings = SiftSettings(width=160)):
        self.settings = settings

    def __call__(self, frame: Frame) -> np.ndarray:
        grey, usable, _ = _prepared(frame, self.settings)
        smooth = cv2.GaussianBlur(grey, (0, 0), 1).astype(np.float32)
        x, y = cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1)
        strength = np.hypot(x, y) * (usable > 0)
        direction = np.arctan2(y, x) * (_CELLS / (2 * np.pi)) % _CELLS
        apart = [np.abs((direction - bin_ + _CELLS / 2) % _CELLS - _CELLS / 2) for bin_ in range(_CELLS)]
        votes = [
            cv2.resize(strength * np.clip(1 - d, 0, 1), (_CELLS, _CELLS), None, 0, 0, cv2.INTER_AREA) for d in apart
        ]
        vector = np.sqrt(np.array(votes, np.float32).ravel())
        return vector / max(float(np.linalg.norm(vector)), 1e-9)


@dataclass(frozen=True)
@checked
class LoftrSettings:
    """LoFTR as ColonMapper runs it: grey, half size, masked."""

    weights: Path | None = None
    """File with LoFTR's weights (.ckpt, .pth or .safetensors), such as kornia's loftr_outdoor.ckpt; --matcher loftr
    needs it, and nothing is downloaded."""
    width: Annotated[int, at_least(16, up_to=10_000)] = 720
    """Width that images are reduced to for matching, pixels; smaller ones stay as they are. A larger one finds finer
    matches and takes longer."""
    confidence: Annotated[float, SHARE] = 0.4
    """Least confidence of a match that counts, a share in [0, 1], as LoFTR gives it. A higher one takes in fewer, surer
    matches."""
    device: str = "cpu"
    """Where the loftr matcher runs, by PyTorch's name: cpu, or cuda for a GPU, which is faster."""


@dataclass(frozen=True)
class _Grey:
    """image (1, 1, H, W) and mask (1, H, W) float tensors, size as LoFTR wants it; and the grid's cells in view."""

    image: Any
    mask: Any
    camera: CameraModel
    cells_in_view: int


class LoftrMatcher:
    """kornia's LoFTR on grey images; `network` takes the place of the one that is read from settings.weights."""

    def __init__(self, settings: LoftrSettings = LoftrSettings(), network: Any = None):
        self.settings = settings
        self._network = network if network is not None else read_loftr(settings)

    def keep(self, frame: Frame) -> _Grey:
        import torch

        width = min(self.settings.width, frame.camera.width) // 8 * 8  # LoFTR's coarse grid
        height = max(8, round(frame.camera.height * width / frame.camera.width / 8) * 8)
        grey = cv2.cvtColor(frame.image, cv2.COLOR_RGB2GRAY)
        grey = cv2.resize(grey, (width, height), interpolation=cv2.INTER_AREA)
        mask = _shrunk(resized_mask(frame.valid, (width, height)).astype(np.uint8), 0.01)
        image = torch.from_numpy(grey * mask)[None, None].float()
        return _Grey(image, torch.from_numpy(mask.astype(bool)), frame.camera, _cells_in_view(frame))

    def count(self, kept: _Grey) -> None:
        return None  # LoFTR has no features of one image

    def agree(self, one: _Grey, other: _Grey) -> MatchAgreement:
        import torch

        device = self.settings.device
        with torch.inference_mode():
            found = self._network({"image0": one.image.to(device), "image1": other.image.to(device)})
        sure = found["confidence"].cpu().numpy() > self.settings.confidence
        places = [found[f"keypoints{i}"].cpu().numpy()[sure].reshape(-1, 2) for i in (0, 1)]
        inside = np.ones(len(places[0]), bool)
        for pixels, kept in zip(places, (one, other), strict=True):
            height, width = kept.mask.shape
            column, row = np.clip(pixels.astype(int), 0, (width - 1, height - 1)).T
            inside &= kept.mask.numpy()[row, column]
        scale = other.camera.width / other.mask.shape[1]
        cells = np.unique(_cells((places[1][inside] + 0.5) * scale, other.camera))
        return MatchAgreement(int(inside.sum()), len(cells) / other.cells_in_view)


def read_loftr(settings: LoftrSettings) -> Any:
    """kornia's LoFTR with the weights of a local file. Raises InputError when there is none, or it is not LoFTR's."""
    from kornia.feature import LoFTR

    path = settings.weights
    if path is None or not path.is_file():
        found = "no weights given" if path is None else f"{path}: no such file"
        raise InputError(
            "--loftr.weights",
            found,
            "give a FILE (kornia's loftr_outdoor.ckpt; nothing is downloaded), or use --matcher sift, which needs none",
        )
    try:
        if path.suffix == ".safetensors":
            from safetensors.torch import load_file

            check_header(path, "use kornia's loftr_outdoor.ckpt")
            state: Any = load_file(path)
        else:
            state = read_pickled(path, "use kornia's loftr_outdoor.ckpt")
        state = state.get("state_dict", state)
        state = {name.removeprefix("matcher."): value for name, value in state.items()}
        network = LoFTR(pretrained=None)
        network.load_state_dict(state)
    except InputError:
        raise
    except (RuntimeError, OSError, ValueError, LookupError, AttributeError) as error:
        raise InputError(
            path, f"not LoFTR's weights ({str(error).splitlines()[0][:200]})", "expected kornia's loftr_outdoor.ckpt"
        ) from error
    return network.eval().to(settings.device)


def _prepared(frame: Frame, settings: SiftSettings) -> tuple[np.ndarray, np.ndarray, float]:
    """Green, which shows vessels best, with its contrast evened out, (h, w) uint8; where features may be, (h, w) uint8
    0 or 1; and the scale from the frame's pixels to these."""
    camera = frame.camera
    scale = min(1.0, settings.width / camera.width)
    size = (max(16, round(camera.width * scale)), max(16, round(camera.height * scale)))
    image = frame.image if scale == 1 else cv2.resize(frame.image, size, interpolation=cv2.INTER_AREA)
    usable = (frame.valid if scale == 1 else resized_mask(frame.valid, size)).astype(np.uint8)
    bright = (image.min(-1) > settings.highlight).astype(np.uint8)
    strip = _strip(settings.border * size[0])
    usable = _shrunk(usable, settings.border) & (1 - cv2.dilate(bright, strip))
    green = np.rint(np.clip(image[..., 1], 0, 1) * 255).astype(np.uint8)
    return cv2.createCLAHE(3.0, (8, 8)).apply(green), usable, scale


def _strip(pixels: float) -> np.ndarray:
    return np.ones((2 * max(1, round(pixels)) + 1,) * 2, np.uint8)


def _shrunk(mask: np.ndarray, border: float) -> np.ndarray:
    """mask (h, w) uint8 without a strip of `border` widths along its edge, the image's own edge included."""
    padded = cv2.copyMakeBorder(mask, 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=0)
    return cv2.erode(padded, _strip(border * mask.shape[1]))[1:-1, 1:-1]


def _cells(pixels: np.ndarray, camera: CameraModel) -> np.ndarray:
    """The grid's cell (n,) of pixels (n, 2)."""
    column, row = np.clip(pixels / (camera.width, camera.height) * _CELLS, 0, _CELLS - 1).astype(int).T
    result: np.ndarray = row * _CELLS + column
    return result


def _cells_in_view(frame: Frame) -> int:
    """How many cells of the grid show tissue in at least half of their area."""
    share = cv2.resize(frame.valid.astype(np.float32), (_CELLS, _CELLS), interpolation=cv2.INTER_AREA)
    return max(1, int((share >= 0.5).sum()))
