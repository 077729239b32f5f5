"""Seeded episodes, tables and pictures."""
