"""Worlds of a few equations in plain JAX, whose best outcomes are known."""
