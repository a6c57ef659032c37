"""Depth networks: plain nn.Modules, tensors in, tensors out. They know no trainer."""

from lightdepth.network.model import DepthNetwork, Estimate, NetworkConfig, build_network
from lightdepth.network.pretrained import load_pretrained

__all__ = ["DepthNetwork", "Estimate", "NetworkConfig", "build_network", "load_pretrained"]
