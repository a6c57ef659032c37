"""Distance of one endoscope image by an exported network, without the program that trained it.

    python example.py model.onnx IMAGE CAMERA.json OUT.npy [MASK]

Needs numpy and pillow, and onnxruntime (model.onnx) or torch (model.pt2). CAMERA.json is {"model": "PINHOLE", "width":
W, "height": H, "params": [fx, fy, cx, cy]}, pixels with the first one's centre at (0.5, 0.5), or "OPENCV_FISHEYE" with
k1, k2, k3, k4 besides. MASK is an image of the same size, white where tissue shows. OUT.npy is float32 at the rows that
the network works at: distance along the ray up to scale, 0 outside the mask. model.json, beside the model, has the rows
and the light; put your own endoscope's light there.
"""

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image


def averaged(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """(H, W, C) at (width, height): the mean over the pixels, and parts of pixels, that each new one merges."""
    for axis, few in ((0, size[1]), (1, size[0])):
        many = image.shape[axis]
        edges, pixels = np.arange(few + 1) * (many / few), np.arange(many)
        overlap = np.minimum(edges[1:, None], pixels + 1) - np.maximum(edges[:-1, None], pixels)
        image = np.moveaxis(np.tensordot(np.clip(overlap, 0, None) * (few / many), image, (1, axis)), 0, axis)
    return image


def rays_of(camera: dict[str, Any], width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """Unit rays (H, W, 3) through the pixel centres of the camera at this size, and which of them the lens has."""
    fx, fy, cx, cy, *k = camera["params"]
    u, v = np.meshgrid((np.arange(width) + 0.5) / width, (np.arange(height) + 0.5) / height)
    x, y = (u * camera["width"] - cx) / fx, (v * camera["height"] - cy) / fy
    if camera["model"] == "PINHOLE":
        rays, there = np.stack([x, y, np.ones_like(x)], -1), np.ones(x.shape, bool)
    elif camera["model"] == "OPENCV_FISHEYE":
        radius = np.hypot(x, y)
        theta = np.minimum(radius, 1.5)
        for _ in range(20):  # Newton: theta (1 + k1 theta^2 + k2 theta^4 + ...) is the radius
            t2 = theta**2
            value = theta * (1 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3])))) - radius
            slope = 1 + t2 * (3 * k[0] + t2 * (5 * k[1] + t2 * (7 * k[2] + t2 * 9 * k[3])))
            theta = np.clip(theta - value / np.where(np.abs(slope) > 1e-3, slope, 1e-3), 0, np.pi / 2)
        there = (np.abs(value) < 1e-6) & (theta < np.pi / 2)
        across = np.sin(theta) / np.maximum(radius, 1e-12)
        rays = np.stack([x * across, y * across, np.cos(theta)], -1)
    else:
        sys.exit(f"camera model {camera['model']}: expected PINHOLE or OPENCV_FISHEYE")
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True), there


def run(model: Path, inputs: dict[str, np.ndarray]) -> list[np.ndarray]:
    """The outputs of model.onnx or model.pt2 for inputs by name."""
    if model.suffix == ".onnx":
        import onnxruntime

        session = onnxruntime.InferenceSession(model, providers=["CPUExecutionProvider"])
        return [np.asarray(v) for v in session.run(None, inputs)]
    import torch

    with torch.no_grad():
        return [v.numpy() for v in torch.export.load(model).module()(*map(torch.from_numpy, inputs.values()))]


def main(model: str, image_file: str, camera_file: str, out: str, mask_file: str | None = None) -> None:
    settings = json.loads((Path(model).parent / "model.json").read_text(encoding="utf-8"))
    camera = json.loads(Path(camera_file).read_text(encoding="utf-8-sig"))
    image = np.asarray(Image.open(image_file).convert("RGB"), np.float64) / 255
    mask = np.ones(image.shape[:2], bool) if mask_file is None else np.asarray(Image.open(mask_file).convert("L")) > 127
    width, height = settings["size"] or (round(image.shape[1] * settings["rows"] / image.shape[0]), settings["rows"])
    full = rays_of(camera, image.shape[1], image.shape[0])[1]
    rays, there = rays_of(camera, width, height)
    mask = (averaged((mask & full)[..., None].astype(float), (width, height))[..., 0] > 0.999) & there
    planes = [a.transpose(2, 0, 1)[None] for a in (averaged(image, (width, height)), mask[..., None], rays)]
    light = [[settings["light"][name] for name in ("gamma", "mu", "gain", "reflectance")]]
    inputs = {
        "image": planes[0].astype(np.float32),
        "mask": planes[1].copy(),
        "rays": planes[2].astype(np.float32),
        "light": np.array(light, np.float32),
    }
    distance = run(Path(model), inputs)[0][0, 0]
    np.save(out, np.where(mask, distance, 0).astype(np.float32))
    print(f"{out}: {width}x{height}, {100 * mask.mean():.0f} % valid, up to scale")


if __name__ == "__main__":
    if len(sys.argv) not in (5, 6):
        sys.exit(__doc__)
    main(*sys.argv[1:])
