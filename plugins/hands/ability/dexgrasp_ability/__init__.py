"""Psyonic Ability hand (right): five fingers, six motors, coupled outer joints."""
