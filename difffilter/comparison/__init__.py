"""Systems beside each other on the same held-out trajectories."""
