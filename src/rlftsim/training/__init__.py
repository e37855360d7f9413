"""How it learns: pre-training and closed-loop fine-tuning."""
