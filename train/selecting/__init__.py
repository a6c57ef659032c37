"""Frames worth training on: by covisibility, and the matching that tells it."""
