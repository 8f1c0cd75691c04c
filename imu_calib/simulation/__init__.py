"""Simulated hardware: a turntable, an IMU on it, and a stand that runs a plan on both."""
