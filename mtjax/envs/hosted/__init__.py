"""Environments that live outside JAX, and are stepped on the host by one call a step."""
