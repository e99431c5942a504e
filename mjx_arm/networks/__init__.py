"""Q-networks. Any Flax module `observations [B, ...] -> Q-values [B, A]` can take their place."""

from mjx_arm.networks.q_network import FeatureQNetwork, PixelQNetwork, make_network

__all__ = ["FeatureQNetwork", "PixelQNetwork", "make_network"]
