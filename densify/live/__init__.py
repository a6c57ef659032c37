"""Surfaces that grow keyframe by keyframe, inside a budget, and a recorded sequence played against the clock."""
