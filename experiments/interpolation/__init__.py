"""What `survey.py` draws and measures."""
