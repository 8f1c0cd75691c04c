"""Calibration of strapdown IMUs on a turntable: recordings and live streams to 24 parameters."""

__version__ = '0.1.0'
