"""Descriptor, model and the estimator that joins them with ICP."""
