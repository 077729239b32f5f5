"""Wrappers that complete theta, set the reward, and cure faults of episodes."""

from sb3_yann.wrappers.episodes import SeededGlobals, TruncateAtTimeLimit
from sb3_yann.wrappers.plant_env import PlantEnv, StageCost
from sb3_yann.wrappers.theta import (
    EstimateState,
    MeasuredDisturbance,
    ObserveDisturbance,
    PastInputs,
    PreviousInput,
    SetPoint,
)

__all__ = [
    "EstimateState",
    "MeasuredDisturbance",
    "ObserveDisturbance",
    "PastInputs",
    "PlantEnv",
    "PreviousInput",
    "SeededGlobals",
    "SetPoint",
    "StageCost",
    "TruncateAtTimeLimit",
]
