"""ROOM model"""
