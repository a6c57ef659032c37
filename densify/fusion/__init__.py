"""Keyframes into one surface: rectified views, the signed distance volume, marching cubes; the paper's plain fusion."""

from lightdepth.moved import names_of

__getattr__ = names_of(__name__, "densify.fusion.volume")
