"""Synthetic scenarios in the shape of WOMD: an embedded pack, and the generator (with SUMO as a subprocess) that made it."""

from rlftsim.scenario.synthetic.pack import pack_path

__all__ = ["pack_path"]
