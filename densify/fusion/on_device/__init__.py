"""The volume on a GPU, by NVIDIA Warp: the same sums, bit for bit, as the compiled loops of densify.fusion.volume."""
