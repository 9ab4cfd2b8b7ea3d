"""Recipes that run step by step: what they declare, and the pure step itself."""
