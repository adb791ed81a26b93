"""Families whose bodies are hands."""
