"""Benchmark: what a pass costs, by the engines of this library and by others."""
