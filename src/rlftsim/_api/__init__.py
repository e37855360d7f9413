"""Functions behind `import rlftsim as rs` that do more than pass a name on; use them from there."""
