"""Calibration of sensors against each other from one recording."""
