"""Damaged files for readers, and the watch over what readers do with them."""
