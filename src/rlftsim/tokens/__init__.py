"""Motion and map tokens: vocabularies, and the tokens of agents and maps."""
