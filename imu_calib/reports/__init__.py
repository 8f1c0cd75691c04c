"""ROOM reports"""
