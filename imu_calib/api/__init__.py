"""ROOM api"""
