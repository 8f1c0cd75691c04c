"""ROOM calibration"""
