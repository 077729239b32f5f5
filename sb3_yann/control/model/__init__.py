"""Linear models about an operating point."""
