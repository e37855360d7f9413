"""Entries of the Sim Agents challenge: archives that are built resumably and checked before the upload."""
