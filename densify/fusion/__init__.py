"""Keyframes into one surface: rectified views, the signed distance volume, marching cubes; the paper's plain fusion."""
