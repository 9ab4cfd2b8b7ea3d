"""Plain NumPy reference implementations that share no code with the library."""
