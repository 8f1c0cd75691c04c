"""ROOM simulation"""
