"""A plant's twin, learnt from its own log."""

from sb3_yann.twin.env import TwinEnv
from sb3_yann.twin.log import Episode
from sb3_yann.twin.plant_twin import PlantTwin
from sb3_yann.twin.trust import Trust, UntrustedTwinError

__all__ = ["Episode", "PlantTwin", "Trust", "TwinEnv", "UntrustedTwinError"]
