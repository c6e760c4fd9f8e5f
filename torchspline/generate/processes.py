"""Which of several processes this one is."""

import os

import torch.distributed


def rank_and_world() -> tuple[int, int]:
    """From `torch.distributed` where it is initialised, else from the variables that `torchrun` sets, else (0, 1)."""
    if torch.distributed.is_available() and torch.distributed.is_initialized():
        return torch.distributed.get_rank(), torch.distributed.get_world_size()
    values = []
    for name, default in (("RANK", "0"), ("WORLD_SIZE", "1")):
        text = os.environ.get(name, default)
        if not text.isdigit():
            raise ValueError(
                f"{name}: expected a whole number in this environment variable, as torchrun sets it, got {text!r}"
            )
        values.append(int(text))
    rank, world = values
    if rank >= world:
        raise ValueError(f"RANK: expected a whole number below WORLD_SIZE={world}, got {rank}")
    return rank, world
