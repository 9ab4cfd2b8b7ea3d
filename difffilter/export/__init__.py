"""Frozen filters as C99: the step's own scalar program, for machines without Python."""
