"""ICP and the overlap of two clouds."""
