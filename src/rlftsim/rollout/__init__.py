"""The closed loop: the policy interface, simulation, and policies without weights."""
