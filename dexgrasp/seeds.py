"""Random streams that depend on what is made, never on who makes it or in which order."""

import hashlib

import numpy as np
import torch


def stream(seed: int, *keys: str | int) -> np.random.Generator:
    """Return the generator of one piece of work, e.g. ``stream(0, "scene", 17)``.

    Two streams with different keys are independent; the same keys give the same numbers whatever the number of
    workers.
    """
    return np.random.default_rng(np.random.SeedSequence([seed, *map(_word, keys)]))


def torch_stream(seed: int, *keys: str | int) -> torch.Generator:
    """Return the torch generator (CPU) of one piece of work."""
    return torch.Generator().manual_seed(int(stream(seed, *keys).integers(2**63)))


def _word(key: str | int) -> int:
    return int.from_bytes(hashlib.blake2b(repr(key).encode(), digest_size=8).digest(), "little")
