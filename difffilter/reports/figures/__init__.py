"""Figures: drawn on matplotlib figures of their own, never on the global one."""
