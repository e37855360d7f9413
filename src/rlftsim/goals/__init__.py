"""What is asked: goals of agents."""
