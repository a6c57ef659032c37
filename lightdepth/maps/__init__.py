"""Sparse maps on disk.

read_map          any of the formats below, told apart by looking -> SparseMap
colmap            COLMAP models, text and binary, one folder or many; write_text_model
endocartoscope    the multi-map tree of EndoCartoScope and CLiMB; write_multimap, read_trajectory
tum               a TUM trajectory with a point cloud; what a keyframe saw is guessed
sensors           one camera of a map that has several
stella            maps of stella_vslam and OpenVSLAM, .msg and .json; write_stella
convention        what a file's numbers mean: pixel centre, direction of poses; densify_map.json
checks            whether a map's numbers agree with each other, and which other reading of them would
"""

from lightdepth.maps.colmap import write_text_model
from lightdepth.maps.endocartoscope import read_trajectory, write_multimap
from lightdepth.maps.reading import read_map
from lightdepth.maps.stella import write_stella

__all__ = ["read_map", "read_trajectory", "write_multimap", "write_stella", "write_text_model"]
