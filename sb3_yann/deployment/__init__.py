"""A controller for the plant: files of a law or a policy that run without PyTorch, or Python."""

from sb3_yann.deployment.controller import Controller

__all__ = ["Controller"]
