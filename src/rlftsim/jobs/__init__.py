"""Long work: whole files, result folders."""
