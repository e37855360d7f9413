"""Closed-loop reinforcement-learning fine-tuning of traffic simulation models against the official realism meta-metric."""

__version__ = "0.1.0"
