"""ROOM session"""
