"""The parts of `benchmarks.calibration`."""
