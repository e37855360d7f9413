"""Maneuvers that the lanes allow an agent, and the one that it made in the log."""
