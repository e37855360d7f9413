"""SMART: next-motion-token prediction."""
