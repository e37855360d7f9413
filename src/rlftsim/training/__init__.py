"""Training: pre-training, closed-loop fine-tuning with rewards, CAT-K and goal relabelling."""
