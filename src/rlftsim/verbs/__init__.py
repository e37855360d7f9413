"""Verbs: each is a function that is `rs.NAME` and `rlftsim NAME`, with one signature and one text for both."""
