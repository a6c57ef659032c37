"""Surfaces that grow keyframe by keyframe, inside a budget, and a recorded sequence played against the clock."""

from lightdepth.moved import names_of

__getattr__ = names_of(__name__, "densify.live.densifier")
