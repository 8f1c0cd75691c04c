"""Calibration certificates: for people by ISO/IEC 17025, for machines as DCC."""
