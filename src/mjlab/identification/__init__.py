"""Identification of a robot's drives from logs of its joints."""
