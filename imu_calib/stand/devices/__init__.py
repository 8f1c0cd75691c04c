"""ROOM stand.devices"""
