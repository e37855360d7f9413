"""A question of the paper, answered by a table."""
