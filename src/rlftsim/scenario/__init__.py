"""Logged scenarios: types, data sources, data sets and the synthetic generator."""
