"""ROOM estimation.closed_forms"""
