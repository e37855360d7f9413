"""Calibrated policies: a few named features, each with a weight, on the log-probabilities of decisions."""
