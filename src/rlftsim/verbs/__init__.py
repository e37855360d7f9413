"""Verbs: a function each, with one signature and one text for Python and the command line, or for one of the two."""
