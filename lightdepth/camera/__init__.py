"""Camera models: which ray of light fell on which pixel.

Notation: pixels (..., 2) as (u right, v down), the centre of the first pixel at (0.5, 0.5); points (..., 3) in camera
axes x right, y down, z into the scene; theta angle between a ray and the optical axis; rho distance from the principal
point.

Every model maps its whole field of view natively; nothing is undistorted. What lies outside the field on which the
model can be inverted (where a distortion polynomial turns over, or 90 degrees from the axis and beyond, where no
endoscope's light reaches) is reported as invalid, with finite numbers in its place.

Points and pixels are numpy arrays, or torch tensors on any device, which can be differentiated through. Where a root is
found by Newton's method its last step alone is differentiated: that is the implicit derivative. On the axis gradients
are right, and where nothing is valid they are finite.

Parameters are in COLMAP's order; SCARAMUZZA's are `cx cy a0 a1 a2 a3 a4 c d e`.
"""

from lightdepth.camera.fisheye import KannalaBrandt, Scaramuzza
from lightdepth.camera.model import CameraModel
from lightdepth.camera.params import CAMERA_MODELS, camera_from_params, camera_of, opencv_camera
from lightdepth.camera.perspective import Brown, FullBrown, Pinhole
from lightdepth.camera.provenance import Provenance

__all__ = [
    "CAMERA_MODELS",
    "Brown",
    "CameraModel",
    "FullBrown",
    "KannalaBrandt",
    "Pinhole",
    "Provenance",
    "Scaramuzza",
    "camera_from_params",
    "camera_of",
    "opencv_camera",
]
