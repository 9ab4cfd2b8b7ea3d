"""Tuning by gradient: settings, loop, resumable state, TensorBoard."""
