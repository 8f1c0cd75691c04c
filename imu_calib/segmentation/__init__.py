"""ROOM segmentation"""
