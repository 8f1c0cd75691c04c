"""ROOM stand.nodes"""
