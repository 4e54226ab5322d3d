"""Simulated recordings: worlds, scanners and paths."""
