"""Rigid transformations and Gaussians on them."""
