"""Recorded and simulated sequences of scans."""
