"""Linear models from a plant's log."""
