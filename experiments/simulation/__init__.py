"""What the throughput of the sensor model is measured with."""
