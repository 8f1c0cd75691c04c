"""ROOM estimation"""
