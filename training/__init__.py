"""The experiments of the papers: each regenerates, tunes, compares and judges; a folder each."""
