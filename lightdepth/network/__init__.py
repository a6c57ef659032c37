"""Depth networks: plain nn.Modules, tensors in, tensors out. They know no trainer."""

from lightdepth.network.model import DepthNetwork, NetworkConfig, build_network

__all__ = ["DepthNetwork", "NetworkConfig", "build_network"]
