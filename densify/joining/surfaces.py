"""Whether two surfaces agree, once they are joined: as the cameras of both see them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from densify.joining.join import Join, SurfaceAgreement
from densify.joining.keyframes import moved_keyframe
from densify.joining.side import Side
from densify.similarity import Similarity
from lightdepth.camera import CameraModel


def ray_grid(camera: CameraModel, stride: int) -> np.ndarray:
    """Unit rays (n, 3) of a grid of the camera's pixels."""
    rays, valid = camera.rays()
    result: np.ndarray = rays[stride // 2 :: stride, stride // 2 :: stride][
        valid[stride // 2 :: stride, stride // 2 :: stride]
    ]
    return result


def surfaces_agree(target: Side, source: Side, similarity: Similarity) -> SurfaceAgreement | None:
    """Gap, overlap and occlusion of two joined surfaces along the rays of up to eight keyframes of each; None where no
    camera sees enough of both."""
    rays_seen = []
    own_from = {0: Similarity.identity(), 1: similarity.inverse()}
    for side, sim in ((target, Similarity.identity()), (source, similarity)):
        for keyframe in side.some_keyframes:
            posed = moved_keyframe(keyframe, sim)
            along = ray_grid(keyframe.camera, max(4, keyframe.camera.width // 40)) @ posed.cam_from_map[:3, :3]
            hits = []
            for k, other in enumerate((target, source)):
                to_other = own_from[k]
                origin = to_other.apply(posed.center[None])[0]
                hits.append(other.dense.surface.cast(origin, along @ to_other.rotation.T) / to_other.scale)
            own, far = hits if side is target else hits[::-1]
            rays_seen.append((own, far))
    return _agreement(rays_seen, target.config.min_overlap)


def _agreement(rays_seen: Sequence[tuple[np.ndarray, np.ndarray]], min_overlap: float) -> SurfaceAgreement | None:
    overlap = [np.isfinite(far[np.isfinite(own)]).mean() if np.isfinite(own).any() else 0.0 for own, far in rays_seen]
    chosen = [r for r, share in zip(rays_seen, overlap, strict=True) if share >= min_overlap]
    if not chosen:
        return None
    own, far = (np.concatenate(part) for part in zip(*chosen, strict=True))
    both = np.isfinite(own) & np.isfinite(far)
    ratio = far[both] / own[both]
    return SurfaceAgreement(float(np.median(np.abs(ratio - 1))), float(max(overlap)), float((ratio < 0.75).mean()))


def checked(join: Join, target: Side, source: Side, max_gap: float) -> Join:
    """The join, unless the surfaces contradict it; where either map has none, they cannot."""
    if not join.ok or not len(target.dense.triangles) or not len(source.dense.triangles):
        return join
    assert join.target_from_source is not None
    config, found = target.config, surfaces_agree(target, source, join.target_from_source)
    if found is None:
        if join.by == "points":  # they may have met at their ends
            return join
        return replace(join, reason=f"no camera sees {config.min_overlap:.0%} of one surface on the other")
    join = replace(join, surfaces=found)
    if found.gap > max_gap:
        return replace(join, reason=f"the surfaces are {found.gap:.1%} of the distance apart; at most {max_gap:.0%}")
    if found.through > config.max_through:
        reason = f"one surface stands in the way of {found.through:.0%} of the rays to the other"
        return replace(join, reason=f"{reason}; at most {config.max_through:.0%}")
    return join
