"""Counting operations: matrices and numbers that record what is done to them, and formulas in k for the counts."""
