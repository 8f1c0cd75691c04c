"""ROOM stand.web"""
