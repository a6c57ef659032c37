"""Colons for judging alone: another geometry and another way of light than those that networks are trained on.

A triangle mesh (`wall`) is lit by lamps beside the lens (`lamps`), straight and by way of other wall, which is found by
tracing paths at random (`transport`), through lenses of other makes onto a sensor (`endoscope`). `colons` has the
twelve that stand fixed. Nothing here knows the tube, its radiosity or the image formation of the training, and
nothing that trains may import this (import-linter holds both).

Notation: s arc length along the centre line and phi the angle around it; x a point of the wall, n its unit normal
towards the lumen; rho its reflectance (RGB); E irradiance, L radiance. Lengths in mm, light in units of lamp intensity.
"""

from lightdepth.judge_colons.colons import JUDGE_COLONS, JudgeColon, judge_frames

__all__ = ["JUDGE_COLONS", "JudgeColon", "judge_frames"]
