"""ROOM stand"""
