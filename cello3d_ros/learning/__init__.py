"""Pairs, sampling, datasets and the training of Theta."""
