"""What may be tuned: declarations, their constraints, and sets of values."""
