"""Weight functions of a standardised residual, hard and soft, and their registry."""
