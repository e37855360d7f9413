"""Planners that ship: the log, constant velocity, the intelligent driver model, and proposals after PDM."""
