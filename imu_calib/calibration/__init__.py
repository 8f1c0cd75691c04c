"""The result: calibrations and their files; what applies, compares and verifies them."""
