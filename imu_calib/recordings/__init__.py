"""Bytes to columns: recordings of rosbag2, messages, remote files, text."""
