"""The command ``sb3-yann``: what needs no script of one's own."""

from sb3_yann.command_line.main import main

__all__ = ["main"]
