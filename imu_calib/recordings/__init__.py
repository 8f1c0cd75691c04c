"""ROOM recordings"""
