"""What guards an update: groups of channels, gates, weighing, recovery, local filters."""
