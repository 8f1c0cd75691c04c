"""Apply a calibration: pulses to rates and specific forces, in bulk and live alike."""
