"""Submaps that meet: those that see the same tissue are brought into one frame of reference and scale.

Notation: a join is the Sim(3) target_from_source, X_target = s R X_source + t. Each submap has its own unit; its
*reach* is a typical distance from its cameras to what they see, by which submaps of different units are compared.

What two submaps may have in common, the strongest first; each is tried between submaps that are not yet together:

points    map points that both know: seen at the same pixel of the same frame, or of the same id
frames    the same frame in both: its rays meet both surfaces
looks     map points that look alike: the descriptors of their surroundings in the images
surface   the shape of the surfaces alone: FPFH features, then ICP with scale, point to plane both ways

A join that chance could have made is refused: too few of the correspondences agree, shared cameras look elsewhere, or
the surfaces do not lie on each other where they should, or bear other colours. What is joined becomes a submap like any
other, and is made dense like any other: one surface, fused anew from all keyframes, with one scale for each.
"""

from densify.joining.join import MergeConfig
from densify.joining.keyframes import moved_keyframe
from densify.joining.meeting import join_maps
from densify.joining.merged import Merged, joined_name, merge
from densify.joining.submap import joined_submap

__all__ = ["MergeConfig", "Merged", "join_maps", "joined_name", "joined_submap", "merge", "moved_keyframe"]
