"""Whether to adopt tuned values, and at what risk."""
