"""Measurements over time, estimates over time, and the files that hold them."""
