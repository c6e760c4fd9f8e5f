"""`torchspline generate`."""

from torchspline.generate.command import generate

__all__ = ["EXAMPLES", "generate"]

EXAMPLES = """
torchspline generate --config configs/generate.yaml --out DIR
torchspline generate --config configs/generate.yaml --seed 7 --items 100000 --json
torchrun --nproc-per-node 4 -m torchspline.cli generate --config configs/generate.yaml --out DIR
"""
