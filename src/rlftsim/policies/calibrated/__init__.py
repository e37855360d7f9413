"""Calibrated policies: a few named features, each with a weight, on the logits of a policy with a vocabulary."""
