"""Parts of the experiment `simulated_sequence.py`."""
