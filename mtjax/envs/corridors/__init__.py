"""Mazes of corridors, seen by whoever walks in them."""
