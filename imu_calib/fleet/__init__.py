"""ROOM fleet"""
