"""Motion as words: vocabularies and the tokens of agents and maps."""
