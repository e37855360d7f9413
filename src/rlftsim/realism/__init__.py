"""How real it is: the official realism meta-metric."""
