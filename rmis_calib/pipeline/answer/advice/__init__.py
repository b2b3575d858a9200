"""Advice on the next motion."""
