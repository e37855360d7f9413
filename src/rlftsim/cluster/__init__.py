"""Runners for clusters that need a library of their own."""
