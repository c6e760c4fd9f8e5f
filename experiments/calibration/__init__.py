"""Parts of the experiment `camera_imu.py`."""
