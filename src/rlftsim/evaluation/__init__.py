"""Measure a policy on a data set: rollouts, realism scores, tables, comparisons, pages."""
