"""Scenario files: worlds, sensors, systems and what to tune, as data; and frozen values."""
