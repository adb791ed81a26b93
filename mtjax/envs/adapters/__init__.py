"""Environments that other packages step in JAX, one file for each. It imports its package when that is first used."""
