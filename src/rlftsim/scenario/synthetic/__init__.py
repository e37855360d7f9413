"""Synthetic scenarios in the shape of WOMD: an embedded pack, and its generator, which runs SUMO as a subprocess."""

from rlftsim.scenario.synthetic.pack import pack_path

__all__ = ["pack_path"]
