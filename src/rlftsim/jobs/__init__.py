"""Long work: whole files, result folders, processes, shares of machines, buckets, progress."""
