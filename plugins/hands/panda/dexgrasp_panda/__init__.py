"""Franka hand without its arm: a parallel jaw, moved by one joint."""
